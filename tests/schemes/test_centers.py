"""Rays go to the centres that the rules say: at random, by voxel, by the side of a plane."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

import l2p
from l2p.maps.appearance import NO_APPEARANCE
from l2p.schemes.centers import two_centers
from l2p.schemes.half_space import HalfSpace
from l2p.schemes.rays import Rays
from l2p.schemes.rays_voxel import RaysVoxel, cell_of
from l2p.schemes.rounding import within_lattice


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.concatenate([rng.normal(size=(200, 3)), rng.normal((6, 1, 0), size=(150, 3))])


def centers_and_rng(points: np.ndarray, seed: int) -> tuple[np.ndarray, np.random.Generator]:
    """Centres that a scheme finds with this seed, and its generator after that."""
    rng = np.random.default_rng(seed)
    return two_centers(within_lattice(points, np.arange(len(points)), rng), rng), rng


def misses(lines: l2p.LineCloud, point: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.cross(point, lines.direction) - lines.moment, axis=1)


def through(hidden: l2p.Hiding, centers: np.ndarray) -> np.ndarray:
    """Number of the centre of each point, in the order of the map."""
    apart = np.stack([misses(hidden.map, center) for center in centers])
    assert apart.min(axis=0).max() < 1e-12, "centres are exact"
    which = np.empty(len(hidden.truth), dtype=np.int64)
    which[hidden.truth.index] = apart.argmin(axis=0)[hidden.truth.element]
    return which


def test_centres_are_the_means_of_their_points(points: np.ndarray) -> None:
    centers = two_centers(points, np.random.default_rng(0))
    nearest = [min((0, 1), key=lambda k: math.dist(centers[k], each)) for each in points]
    for k in (0, 1):
        own = [each for each, of in zip(points, nearest, strict=True) if of == k]
        np.testing.assert_allclose(np.mean(own, axis=0), centers[k], atol=1e-6)
    other = two_centers(points, np.random.default_rng(1))
    np.testing.assert_allclose(np.sort(centers[:, 0]), np.sort(other[:, 0]), atol=1e-6)


def test_a_coin_decides_for_rays(points: np.ndarray) -> None:
    hidden = Rays().hide(points, np.arange(350), np.random.default_rng(4), NO_APPEARANCE)
    centers, rng = centers_and_rng(points, 4)
    np.testing.assert_array_equal(through(hidden, centers), rng.integers(2, size=350))


@pytest.mark.parametrize("cell", [None, 0.5])
def test_voxels_alternate(points: np.ndarray, cell: float | None) -> None:
    hidden = RaysVoxel(cell).hide(points, np.arange(350), np.random.default_rng(4), NO_APPEARANCE)
    centers, _ = centers_and_rng(points, 4)
    low, side = points.min(axis=0), cell or cell_of(points)
    expected = [sum(math.floor((each[k] - low[k] + side / 2) / side) for k in range(3)) % 2 for each in points]
    np.testing.assert_array_equal(through(hidden, centers), expected)
    assert 0.3 < np.mean(expected) < 0.7


def test_the_default_cell_is_a_twentieth_of_the_map(points: np.ndarray) -> None:
    sides = [np.quantile(points[:, k], 0.99) - np.quantile(points[:, k], 0.01) for k in range(3)]
    assert cell_of(points) == pytest.approx(0.05 * max(sides))
    far = np.concatenate([points, [[1e5, 0, 0]]])
    assert cell_of(far) < 2 * cell_of(points)
    assert cell_of(np.array([[0.0, 0, 0]] * 500 + [[1.0, 0, 0]])) == 0.05


def test_cells_are_given_in_scene_units(points: np.ndarray) -> None:
    one, two = (l2p.hide(points, seed=0, scheme="rays-voxel", cell=cell) for cell in (0.5, 0.7))
    assert (one.map.direction != two.map.direction).any()
    same = l2p.lift(points, seed=0, scheme="rays-voxel", cell=0.5)
    np.testing.assert_array_equal(one.map.direction, same.direction)


def test_each_side_of_the_plane_has_its_centre(points: np.ndarray) -> None:
    hidden = HalfSpace().hide(points, np.arange(350), np.random.default_rng(4), NO_APPEARANCE)
    centers, _ = centers_and_rng(points, 4)
    nearest = [min((0, 1), key=lambda k: math.dist(centers[k], each)) for each in points]
    np.testing.assert_array_equal(through(hidden, centers), nearest)


@pytest.mark.parametrize("name", ["rays", "half-space", "rays-voxel"])
def test_the_sign_of_a_direction_does_not_tell_the_side(points: np.ndarray, name: str) -> None:
    """Also in a flat map, where z tells nothing."""
    for each in (points, points * [1, 1, 0]):
        hidden = l2p.hide(each, seed=0, scheme=name)
        centers = centers_of(hidden.map)
        own = hidden.map.rows(hidden.truth.element)
        which = np.stack([misses(own, center) for center in centers]).argmin(axis=0)
        side = np.sum((hidden.truth.xyz - np.array(centers)[which]) * own.direction, axis=1) > 0
        assert (own.direction[:, 2] >= 0).all()
        assert np.mean(side) == pytest.approx(0.5, abs=0.15)


def centers_of(lines: l2p.LineCloud) -> list[np.ndarray]:
    """Both centres, from the lines alone: points where many pairs of lines meet."""
    found: list[np.ndarray] = []
    for i, j in pairwise(range(len(lines))):
        few = lines.rows(np.array([i, j]))
        across = 2 * np.eye(3) - few.direction.T @ few.direction
        meet = np.linalg.solve(across, few.origin.sum(axis=0))
        if np.sum(misses(lines, meet) < 1e-9) > len(lines) / 5 and all(math.dist(meet, c) > 1e-6 for c in found):
            found.append(meet)
    assert len(found) == 2
    return found
