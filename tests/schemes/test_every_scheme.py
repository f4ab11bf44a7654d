"""What holds of every scheme: points lie on their elements, order and digits tell nothing, files keep it all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import l2p
from l2p.cli.main import main
from l2p.errors import InputError
from l2p.schemes.rounding import directions, lattice_step
from l2p.schemes.scheme import MEANINGS, SCHEMES, Scheme, published_by, scheme_of

#: Schemes whose random numbers do not depend on the axes of the map.
TURNED = ("ppl", "ppl+", "rays", "half-space", "sphere", "decoys")
#: Fewest points that can be hidden, and fewer.
FEWEST = {"permuted": 2, "ppl": 2, "ppl+": 200, "ppl+published": 200, "rays": 2, "rays-voxel": 2, "half-space": 2}
FEWEST |= {"sphere": 2, "sphere-50": 2, "sphere-33": 3, "sphere-25": 4, "decoys": 2, "through-dense": 2}


@pytest.fixture(scope="module")
def walk() -> np.ndarray:
    """Points in the order of an SfM model, neighbours side by side."""
    return np.cumsum(np.random.default_rng(0).normal(size=(2001, 3)), axis=0)


@pytest.fixture(scope="module")
def scene(walk: np.ndarray) -> l2p.Scene:
    rng = np.random.default_rng(1)
    descriptor = rng.integers(0, 256, (len(walk), 16)).astype(np.uint8)
    rgb = rng.integers(0, 256, (len(walk), 3)).astype(np.uint8)
    return l2p.Scene(walk, rgb, ids=np.arange(5, 5 + len(walk)), descriptor=descriptor, descriptor_kind="sift")


def off(hidden: l2p.Hiding) -> np.ndarray:
    """Distance of each true point from its element; of a stored point, the second largest difference of an axis."""
    cloud, truth = hidden.map, hidden.truth
    if isinstance(cloud, l2p.LineCloud):
        own = cloud.rows(truth.element)
        return np.linalg.norm(np.cross(truth.xyz, own.direction) - own.moment, axis=1)
    own = cloud.rows(truth.element)
    if isinstance(cloud, l2p.PlaneCloud):
        return np.abs(own.distance(truth.xyz))
    return np.sort(np.abs(own.xyz - truth.xyz), axis=1)[:, 1]


def test_every_scheme_has_its_few_words() -> None:
    assert list(MEANINGS) == list(SCHEMES)


@pytest.mark.parametrize("name", SCHEMES)
def test_points_lie_on_their_elements_and_have_their_appearance(name: str, scene: l2p.Scene) -> None:
    way = scheme_of(name)
    assert isinstance(way, Scheme) and way.name == name
    hidden = l2p.hide(scene, seed=3, fraction=0.5, scheme=name, rgb=True, descriptor=True)
    cloud, truth = hidden.map, hidden.truth
    assert type(cloud) is published_by(name) and cloud.scheme == name
    assert off(hidden).max() < 1e-10
    np.testing.assert_array_equal(truth.xyz, scene.xyz[truth.index])
    assert scene.ids is not None and truth.ids is not None
    np.testing.assert_array_equal(truth.ids, scene.ids[truth.index])
    assert np.bincount(truth.element).max() == way.answers
    sides = [cloud.appearance] if way.answers == 1 else [cloud.appearance, cloud.second]
    for attribute in ("rgb", "descriptor"):
        own = np.stack([getattr(side, attribute)[truth.element] for side in sides])
        assert (own == getattr(scene, attribute)[truth.index]).all(axis=2).any(axis=0).all()


@pytest.mark.parametrize("name", SCHEMES)
def test_the_seed_decides(name: str, scene: l2p.Scene) -> None:
    one, two, other = (l2p.hide(scene, seed=seed, scheme=name).truth for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.index, two.index)
    assert len(one) != len(other) or (one.index != other.index).any()


@pytest.mark.parametrize("name", SCHEMES)
def test_the_order_of_the_elements_says_nothing_of_the_points(name: str, walk: np.ndarray) -> None:
    truth = l2p.hide(walk, seed=3, scheme=name).truth
    some = truth.rows(truth.index % 3 == 0)  # rows of pooled planes repeat
    for told in (some.index, *some.xyz.T):
        assert abs(np.corrcoef(some.element, told)[0, 1]) < 5 / np.sqrt(len(some) / 3)


@pytest.mark.parametrize("name", SCHEMES)
def test_larger_and_moved_maps_are_hidden_alike(name: str, walk: np.ndarray) -> None:
    scale, move = 7.0, np.array([3.0, -40.0, 11.0])
    one, two = (l2p.hide(points, seed=3, scheme=name) for points in (walk, scale * walk + move))
    np.testing.assert_array_equal(one.truth.index, two.truth.index)
    np.testing.assert_array_equal(one.truth.element, two.truth.element)
    first, second = one.map, two.map
    if isinstance(first, l2p.LineCloud):
        np.testing.assert_allclose(first.direction, second.direction, atol=1e-9)
        np.testing.assert_allclose(np.cross(scale * first.origin + move, first.direction), second.moment, atol=1e-6)
    elif isinstance(first, l2p.PlaneCloud):
        np.testing.assert_array_equal(first.normal, second.normal)
        np.testing.assert_allclose(scale * first.offset + first.normal @ move, second.offset, atol=1e-9)
    else:
        np.testing.assert_allclose(scale * first.xyz + move, second.xyz, atol=1e-9)


@pytest.mark.parametrize("name", TURNED)
def test_turned_maps_are_hidden_alike(name: str, walk: np.ndarray) -> None:
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    one, two = (l2p.hide(points, seed=3, scheme=name) for points in (walk, walk @ turn.T))
    np.testing.assert_array_equal(one.truth.index, two.truth.index)
    along = np.sum((one.map.direction @ turn.T) * two.map.direction, axis=1)
    np.testing.assert_allclose(along if name == "sphere" else np.abs(along), 1, atol=1e-9)


@pytest.mark.parametrize("name", FEWEST)
def test_too_few_points_are_refused(name: str, walk: np.ndarray) -> None:
    for fraction in (1.0, 0.5):
        points = walk[: round(FEWEST[name] / fraction)]
        assert len(l2p.hide(points, seed=0, fraction=fraction, scheme=name).truth) > 0
    with pytest.raises(InputError, match=r"^got .*; expected "):
        l2p.hide(walk[: FEWEST[name] - 1], seed=0, scheme=name)


@pytest.mark.parametrize("name", [name for name in FEWEST if not name.startswith(("ppl", "permuted"))])
def test_centres_of_one_place_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=r"got 9 point\(s\) at one place.*; expected two different ones"):
        l2p.hide(np.full((9, 3), 2.5), seed=0, scheme=name)


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("size", [1e-320, 1e-9, 1e25])
def test_maps_of_any_size_are_hidden(name: str, size: float) -> None:
    points = size * np.random.default_rng(0).normal(size=(400, 3))
    if name.startswith("ppl+") and size < 1e-300:
        pytest.skip("products of such numbers are 0, so there are no local planes")
    assert off(l2p.hide(points, seed=0, scheme=name)).max() < 1e-10 * max(size, 1e-300)


@pytest.mark.parametrize("name", SCHEMES)
def test_points_of_one_place_among_others_are_hidden(name: str, walk: np.ndarray) -> None:
    assert off(l2p.hide(np.repeat(walk[:300], 2, axis=0), seed=0, scheme=name)).max() < 1e-10


def test_a_direction_does_not_tell_the_last_digit_of_its_ends() -> None:
    """In coordinates of a projection, 1e6 m from the origin: which distances give multiples of the last digit?"""
    rng = np.random.default_rng(0)
    points, origins = 1e6 + rng.uniform(0, 8, (2, 4000, 3))
    distance, digit = np.linalg.norm(points - origins, axis=1, keepdims=True), np.spacing(1e6)

    def uneven(direction: np.ndarray) -> np.ndarray:
        multiple = direction * distance / digit
        return np.abs(multiple - np.rint(multiple))

    told = (points - origins) / distance
    assert uneven(told).max() < 0.01, "the test can fail"
    assert uneven(directions(points, origins, rng)).mean() > 0.18, "0.25 by chance"


@pytest.mark.parametrize("name", SCHEMES)
def test_rounded_maps_are_moved_within_their_last_digit(name: str, walk: np.ndarray) -> None:
    if name == "permuted":
        pytest.skip("whole coordinates are stored; see test_permuted.py")
    rounded = np.round(walk, 2)
    hidden = l2p.hide(rounded, seed=0, scheme=name)
    step = lattice_step(rounded)[hidden.truth.index].max(axis=1)
    assert (off(hidden) < np.sqrt(3) / 2 * step * 1.001).all()
    assert np.median(off(hidden) / step) > 0.01


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("described", [True, False])
def test_files_keep_everything(name: str, described: bool, scene: l2p.Scene, tmp_path: Path) -> None:
    hidden = l2p.hide(scene, seed=3, scheme=name, rgb=described, descriptor=described)
    l2p.save(hidden.map, tmp_path / "map.npz")
    again: Any = l2p.load(tmp_path / "map.npz", type(hidden.map))
    assert type(l2p.load(tmp_path / "map.npz")) is type(again)
    for name_, value in vars(hidden.map).items():
        if name_ == "second":
            assert (value is None) == (again.second is None)
            for side in ("rgb", "descriptor", "descriptor_kind"):
                np.testing.assert_array_equal(getattr(again.second, side, None), getattr(value, side, None))
        else:
            np.testing.assert_array_equal(getattr(again, name_), value)
    l2p.save(replace(hidden.truth, spacing=1.0), tmp_path / "truth.npz")
    truth = l2p.load(tmp_path / "truth.npz", l2p.Truth)
    np.testing.assert_array_equal(truth.element, hidden.truth.element)
    perfect = l2p.Recovery(truth.xyz, np.ones(len(truth), np.float32), np.zeros(len(truth)), element=truth.element)
    scores = l2p.evaluate(perfect, truth)
    assert scores.lines == len(truth) and scores.median == 0 and scores.mean == 0


@pytest.mark.parametrize("name", SCHEMES)
def test_the_command_takes_every_scheme(name: str, scene: l2p.Scene, tmp_path: Path, capsys: Any) -> None:
    l2p.save(scene, tmp_path / "scene.npz")
    words = ["lift", str(tmp_path / "scene.npz"), "--scheme", name, "--rgb", "--descriptors", "--seed", "1"]
    assert main([*words, "-o", str(tmp_path / "map.npz"), "--truth", str(tmp_path / "truth.npz")]) == 0
    said = capsys.readouterr().out
    cloud, truth = l2p.load(tmp_path / "map.npz"), l2p.load(tmp_path / "truth.npz", l2p.Truth)
    what = {l2p.LineCloud: "lines", l2p.PlaneCloud: "planes", l2p.PermutedCloud: "permuted points"}[type(cloud)]
    assert f"{len(cloud)} {what} of 2001 points" in said
    assert truth.element.max() < len(cloud)
    assert main(["info", str(tmp_path / "map.npz")]) == 0
    told = capsys.readouterr().out
    assert name in told and what in told and ("two, each with its own" in told) == name.startswith("ppl")
    if what != "lines":
        assert main(["view", str(tmp_path / "map.npz"), "-o", str(tmp_path / "page.html")]) == 2
        told = capsys.readouterr().err
        assert "map.npz is a p" in told and "; expected " in told and told.count("\n") == 1
        ignored = ["recover", str(tmp_path / "map.npz"), "-o", str(tmp_path / "out.npz"), "--ignore", "rgb,descriptor"]
        assert main(ignored) == 0 and len(l2p.load(tmp_path / "out.npz", l2p.Recovery)) == len(cloud)
        assert main([*ignored, "--method", "tomography", "--force"]) == 2
        assert "expected" in capsys.readouterr().err
        assert main([*words, "-o", str(tmp_path / "map.ply")]) == 2
        assert "expected" in capsys.readouterr().err and not (tmp_path / "map.ply").exists()


def test_only_voxels_have_cells(walk: np.ndarray) -> None:
    with pytest.raises(InputError, match="got a cell for rays; expected none, as only rays-voxel has cells"):
        l2p.hide(walk, seed=0, scheme="rays", cell=0.5)
    for cell in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match=r"got cell .*; expected the side of a cube"):
            l2p.hide(walk, seed=0, scheme="rays-voxel", cell=cell)
