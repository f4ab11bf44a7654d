"""PPL and PPL+ pair the points as their rules say, each step against a plain loop."""

from __future__ import annotations

import math

import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.io.open3d import load_open3d
from l2p.maps.appearance import NO_APPEARANCE
from l2p.schemes.cleaning import without_outliers
from l2p.schemes.ppl import Ppl
from l2p.schemes.ppl_plus import PplPlus, PplPlusPublished, _scatter, accepted_pairs


@pytest.fixture(scope="module")
def room() -> np.ndarray:
    return l2p.simulate("room", points=601, seed=0).xyz


def pairs_of(hidden: l2p.Hiding) -> np.ndarray:
    """Rows of both points of each line."""
    order = np.argsort(hidden.truth.element, kind="stable")
    return hidden.truth.index[order].reshape(-1, 2)


def angle_to_plane(xyz: np.ndarray, pair: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Degrees between the line of each pair and the plane of its first point."""
    along = xyz[pair[:, 1]] - xyz[pair[:, 0]]
    sine = np.abs(np.sum(along * normal[pair[:, 0]], axis=1)) / np.linalg.norm(along, axis=1)
    return np.degrees(np.arcsin(np.minimum(sine, 1)))


def test_cleaning_is_that_of_open3d(rng: np.random.Generator) -> None:
    points = np.concatenate([rng.normal(size=(500, 3)), rng.normal(size=(6, 3)) * 300, np.zeros((30, 3))])
    points = points[rng.permutation(len(points))]
    open3d, expected = load_open3d(), np.arange(len(points))
    for _ in range(2):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[expected]))
        expected = expected[np.asarray(cloud.remove_statistical_outlier(20, 10.0)[1])]
    kept = without_outliers(points)
    np.testing.assert_array_equal(kept, expected)
    assert 480 < len(kept) < 506


def test_cleaning_against_a_loop(rng: np.random.Generator) -> None:
    points = np.concatenate([rng.normal(size=(60, 3)), [[1e6, 0, 0]]])
    kept = list(range(61))
    for _ in range(2):
        mean = []
        for i in kept:
            near = sorted(math.dist(points[i], points[j]) for j in kept)[:20]
            mean.append(sum(near) / len(near))
        limit = np.mean(mean) + 10 * np.std(mean, ddof=1)
        kept = [i for i, each in zip(kept, mean, strict=True) if 0 < each <= limit]
    np.testing.assert_array_equal(without_outliers(points), kept)


def test_pairs_are_consecutive_in_a_random_order_without_the_odd_one(room: np.ndarray) -> None:
    hidden = Ppl().hide(room, np.arange(601), np.random.default_rng(5), NO_APPEARANCE)
    kept = [int(row) for row in without_outliers(room)]
    kept = kept[: len(kept) // 2 * 2]
    shuffled = np.random.default_rng(5).permutation(kept)
    expected = {frozenset((int(shuffled[i]), int(shuffled[i + 1]))) for i in range(0, len(kept), 2)}
    assert {frozenset(pair) for pair in pairs_of(hidden).tolist()} == expected
    assert len(hidden.map) == len(kept) // 2


def test_the_first_appearance_is_that_of_either_point(room: np.ndarray) -> None:
    rgb = np.zeros((601, 3), dtype=np.uint8)
    rgb[:, 0] = np.arange(601) % 256
    hidden = l2p.hide(room, seed=2, scheme="ppl", rgb=rgb)
    pair = pairs_of(hidden)
    first, second = hidden.map.rgb[:, 0], hidden.map.second.rgb[:, 0]
    np.testing.assert_array_equal(np.sort(rgb[pair, 0], axis=1), np.sort(np.stack([first, second], axis=1), axis=1))
    swapped = np.mean(rgb[pair.min(axis=1), 0] == first)
    assert swapped == pytest.approx(0.5, abs=0.12)


def test_normals_against_a_loop(room: np.ndarray) -> None:
    xyz, neighbors = room[:60], 6
    scatter = _scatter(xyz, neighbors)
    plain, published = PplPlus.normals(scatter), PplPlusPublished.normals(scatter)
    for i, point in enumerate(xyz):
        nearest = sorted(range(60), key=lambda j: math.dist(point, xyz[j]))[1 : neighbors + 1]
        vector = np.array([xyz[j] - point for j in nearest])
        transposed = np.linalg.svd(vector)[2]
        assert abs(transposed[2] @ plain[i]) == pytest.approx(1, abs=1e-9)
        # The signs of the axes are free; one of the four products is what the code has.
        found = []
        for signs in ((1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)):
            first_row_of_v = transposed[:, 0] * signs
            found.append(np.linalg.svd(np.cross(first_row_of_v, vector))[2][0])
        assert max(abs(each @ published[i]) for each in found) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("scheme", [PplPlus, PplPlusPublished])
def test_pairing_against_a_loop(room: np.ndarray, scheme: type[PplPlus]) -> None:
    xyz = room[:400]
    normal = scheme.normals(_scatter(xyz, 4))
    rng = np.random.default_rng(3)
    left, accepted, counts = list(range(400)), [], []
    for _ in range(1000):
        order, flat = rng.permutation(left), []
        for i in range(0, len(order), 2):
            a, b = order[i], order[i + 1]
            along = xyz[b] - xyz[a]
            from_normal = math.degrees(math.acos(min(1.0, abs(along @ normal[a]) / math.sqrt(along @ along))))
            if from_normal >= 70:
                flat += [a, b]
            else:
                accepted.append((a, b))
        left = flat
        counts.append(len(flat) // 2)
        if counts[-1] < 10 or (len(counts) > 100 and counts[-50:] == [counts[-1]] * 50):
            break
    np.testing.assert_array_equal(accepted_pairs(xyz, normal, np.random.default_rng(3)), accepted)
    assert (angle_to_plane(xyz, np.array(accepted), normal) > 20).all()


def test_lines_leave_the_plane_of_one_of_their_points(room: np.ndarray) -> None:
    hidden = l2p.hide(room, seed=1, scheme="ppl+")
    kept = without_outliers(room)
    kept = kept[: len(kept) // 2 * 2]
    normal = np.zeros_like(room)
    normal[kept] = PplPlus.normals(_scatter(room[kept], 6 if len(kept) >= 600 else 4))
    pair = pairs_of(hidden)
    angle = np.maximum(angle_to_plane(room, pair, normal), angle_to_plane(room, pair[:, ::-1], normal))
    assert (angle > 20).all()
    assert 0 < 2 * len(pair) <= len(kept) and 2 * len(pair) > len(kept) - 20
    unfiltered = pairs_of(l2p.hide(room, seed=1, scheme="ppl"))
    assert (angle_to_plane(room, unfiltered, normal) < 20).mean() > 0.1, "the test can fail"


def test_a_flat_map_has_no_lines_that_leave_it(rng: np.random.Generator) -> None:
    flat = rng.normal(size=(600, 3)) * [1, 1, 0]
    with pytest.raises(InputError, match=r"no two points leave a local plane; take ppl"):
        l2p.hide(flat, seed=0, scheme="ppl+")
