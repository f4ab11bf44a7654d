"""Lifting keeps every point on its line and shows nothing else of it, not even in the bytes of the file."""

from __future__ import annotations

from pathlib import Path

import jaxtyping
import numpy as np
import pytest
from scipy.stats import kstest

import l2p
from l2p.errors import InputError
from l2p.maps.lines import LineCloud
from l2p.schemes.hide import hide, lift
from l2p.schemes.rounding import lattice_step


@pytest.fixture(scope="module")
def walk() -> np.ndarray:
    """Points in the order of an SfM model: neighbours are stored side by side."""
    rng = np.random.default_rng(0)
    return np.cumsum(rng.normal(size=(4000, 3)), axis=0)


def same_bytes(one: LineCloud, other: LineCloud) -> bool:
    return one.direction.tobytes() == other.direction.tobytes() and one.moment.tobytes() == other.moment.tobytes()


def test_the_index_says_which_point_is_on_which_line(walk):
    hidden = hide(walk, seed=0)
    cloud, index = hidden.map, hidden.truth.index
    assert sorted(index) == list(range(len(walk)))
    apart = np.linalg.norm(np.cross(walk[index], cloud.direction) - cloud.moment, axis=1)
    assert apart.max() < 1e-11


def test_directions_are_uniform_on_the_sphere(walk):
    direction = lift(walk, seed=1).direction
    # Uniform on a half sphere: z uniform in [0, 1], longitude uniform, and the second moments those of a sphere.
    longitude = np.arctan2(direction[:, 1], direction[:, 0]) / (2 * np.pi) + 0.5
    assert kstest(direction[:, 2], "uniform").pvalue > 1e-3
    assert kstest(longitude, "uniform").pvalue > 1e-3
    np.testing.assert_allclose(direction.T @ direction / len(direction), np.eye(3) / 3, atol=0.02)


def test_the_sign_of_a_direction_is_canonical(walk):
    assert (lift(walk, seed=0).direction[:, 2] > 0).all()


def test_the_seed_decides_and_none_is_always_new(walk):
    assert same_bytes(lift(walk, seed=5), lift(walk, seed=5))
    assert not same_bytes(lift(walk, seed=5), lift(walk, seed=6))
    assert not same_bytes(lift(walk), lift(walk))


@pytest.mark.parametrize(("fraction", "lines"), [(1.0, 4000), (0.5, 2000), (0.1, 400), (0.00026, 1), (1e-9, 1)])
def test_a_fraction_of_different_points_is_lifted(walk, fraction, lines):
    hidden = hide(walk, seed=0, fraction=fraction)
    cloud, index = hidden.map, hidden.truth.index
    assert len(cloud) == len(index) == len(set(index)) == lines


def test_a_subset_is_drawn_from_all_points(walk):
    index = hide(walk, seed=0, fraction=0.25).truth.index
    assert kstest(index / len(walk), "uniform").pvalue > 1e-3


def test_colours_follow_their_points(walk):
    rgb = np.random.default_rng(0).integers(0, 256, size=walk.shape).astype(np.uint8)
    hidden = hide(walk, seed=0, fraction=0.5, rgb=rgb)
    cloud, index = hidden.map, hidden.truth.index
    assert cloud.rgb is not None
    np.testing.assert_array_equal(cloud.rgb, rgb[index])
    assert lift(walk, seed=0).rgb is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": np.zeros((0, 3))}, "got a scene without points; expected at least one point to lift"),
        ({"points": np.zeros((5, 2))}, r"got points of shape \(5, 2\); expected \(lines, 3\)"),
        ({"points": np.full((5, 3), np.nan)}, r"got 5 line\(s\) with a points that is NaN, infinite or beyond 1e30"),
        ({"fraction": 0.0}, r"got fraction 0.0; expected a number in \(0, 1\], a share of the points"),
        ({"fraction": 1.1}, r"got fraction 1.1; expected a number in \(0, 1\]"),
        ({"fraction": float("nan")}, r"got fraction nan; expected a number in \(0, 1\]"),
        ({"scheme": "paired"}, "got scheme 'paired'; expected one of uniform"),
        (
            {"rgb": np.zeros((4, 3), dtype=np.uint8)},
            "got rgb of 4 rows for 5 points; expected one row each",
        ),
    ],
)
def test_what_cannot_be_lifted_is_refused(arguments, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(InputError, match=message):
        lift(**{"points": np.ones((5, 3)), **arguments})


# The attack from the bytes: only what is in the saved file is used.


def stored(cloud: LineCloud, folder: Path) -> LineCloud:
    """The line cloud as an attacker gets it."""
    l2p.save(cloud, folder / "lines.npz", overwrite=True)
    with np.load(folder / "lines.npz") as file:
        assert sorted(file) == ["direction", "moment", "scheme", "version"]
        return LineCloud(file["direction"], file["moment"])


def test_the_order_of_the_lines_says_nothing_of_the_order_of_the_points(walk, tmp_path):
    hidden = hide(walk, seed=100)
    cloud, index = hidden.map, hidden.truth.index
    stored(cloud, tmp_path)
    truth = walk[index]
    rng = np.random.default_rng(0)
    consecutive = np.linalg.norm(np.diff(truth, axis=0), axis=1)
    random = np.linalg.norm(truth[rng.integers(0, 4000, 4000)] - truth[rng.integers(0, 4000, 4000)], axis=1)
    assert np.median(consecutive) == pytest.approx(np.median(random), rel=0.1)
    assert np.quantile(consecutive, 0.01) == pytest.approx(np.quantile(random, 0.01), rel=0.4)
    assert abs(np.corrcoef(np.arange(4000), index)[0, 1]) < 0.06
    # The test can fail: side by side in the scene, points are near each other.
    assert np.median(np.linalg.norm(np.diff(walk, axis=0), axis=1)) < 0.1 * np.median(random)


def test_nothing_in_the_file_goes_with_the_position_on_the_line(tmp_path):
    # Another seed than the points': the same one would draw the points once more as directions.
    points = np.random.default_rng(0).normal(size=(20000, 3))
    hidden = hide(points, seed=100)
    cloud, index = hidden.map, hidden.truth.index
    seen = stored(cloud, tmp_path)
    beta = np.sum(points[index] * seen.direction, axis=1)
    written = np.concatenate([seen.direction, seen.moment, seen.origin], axis=1)
    written = np.concatenate([written, np.linalg.norm(seen.moment, axis=1, keepdims=True), np.abs(written)], axis=1)
    # The last bits, too: what is left of each number after single precision, and the failure to be unit and normal.
    rest = written - written.astype(np.float32)
    unit = np.linalg.norm(seen.direction, axis=1) - 1
    normal = np.sum(seen.direction * seen.moment, axis=1)
    columns = [*written.T, *rest.T, unit, normal, np.arange(len(seen), dtype=float)]
    for name, target in {"position": beta, "distance from the foot": np.abs(beta)}.items():
        found = [abs(np.corrcoef(column, target)[0, 1]) for column in columns if column.std() > 0]
        assert max(found) < 5 / np.sqrt(len(seen)), name


def lattice_attack(cloud: LineCloud, truth: np.ndarray, step: float) -> tuple[float, float]:
    """Walk along each line and stop where all three coordinates are nearest to multiples of ``step``.

    Returns the share of lines where that is the true point, and the mean share of all places on the line, within the
    extent of the scene, that lie farther from the lattice than the true point does (0.5 is chance).
    """
    low, high = truth.min(axis=0) - step, truth.max(axis=0) + step
    found, rank = [], []
    for direction, origin, point in zip(cloud.direction, cloud.origin, truth, strict=True):
        axis = int(np.argmax(np.abs(direction)))
        plane = step * np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1)
        place = origin + ((plane - origin[axis]) / direction[axis])[:, None] * direction
        place = place[((place >= low) & (place <= high)).all(axis=1)]
        residual = np.abs(place / step - np.rint(place / step)).max(axis=1)
        own = residual[np.argmin(np.linalg.norm(place - point, axis=1))]
        found.append(np.linalg.norm(place[np.argmin(residual)] - point) < 2 * step)
        rank.append((residual > own).mean())
    return float(np.mean(found)), float(np.mean(rank))


def by_digits(points: np.ndarray, digits: int) -> np.ndarray:
    """As a text file with so many significant digits gives them back, which is what C++ streams write."""
    return np.array([[float(f"{value:.{digits}g}") for value in row] for row in points])


def single(points: np.ndarray) -> np.ndarray:
    return points.astype(np.float32).astype(np.float64)


def rounded_scenes() -> dict[str, tuple[np.ndarray, float]]:
    """Scenes that lost digits, each with the lattice that an attacker would try."""
    rng = np.random.default_rng(0)
    wide = rng.uniform(-4, 4, size=(600, 3))
    # In [1, 2) the numbers of single precision are 2^-23 apart; a small extent keeps the walk short.
    narrow = 1 + rng.uniform(0, 0.004, size=(600, 3))
    # Of one length before the point, so that as many digits are as many decimals.
    even = rng.uniform(1, 2, size=(600, 3))
    strange = np.concatenate([np.round(wide, 3), [[np.pi, np.e, np.sqrt(2)]]])
    return {
        "single precision": (single(narrow), 2.0**-23),
        "three decimals": (np.round(wide, 3), 1e-3),
        "three decimals in single precision": (single(np.round(wide, 3)), 1e-3),
        "five significant digits": (by_digits(even, 5), 1e-4),
        "six significant digits in single precision": (single(by_digits(1 + 0.01 * (even - 1), 6)), 1e-5),
        "three decimals but for one point": (strange, 1e-3),
    }


@pytest.mark.parametrize("name", rounded_scenes())
def test_the_rounding_of_the_scene_does_not_give_its_points_away(name, tmp_path):
    points, step = rounded_scenes()[name]
    hidden = hide(points, seed=100)
    cloud, index = hidden.map, hidden.truth.index
    seen = stored(cloud, tmp_path)
    some = np.random.default_rng(0).permutation(len(points))[:100]
    few = LineCloud(seen.direction[some], seen.moment[some])
    share, rank = lattice_attack(few, points[index[some]], step)
    assert share < 0.05
    assert rank == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize("name", rounded_scenes())
def test_the_lattice_attack_finds_points_that_were_lifted_as_they_are(name):
    points, step = rounded_scenes()[name]
    points = points[:40]
    direction = np.random.default_rng(1).normal(size=points.shape)
    share, rank = lattice_attack(LineCloud.through(points, direction), points, step)
    assert share > 0.8 and rank > 0.99


@pytest.mark.parametrize("name", rounded_scenes())
def test_points_move_less_than_their_lattice_step(name):
    points, step = rounded_scenes()[name]
    hidden = hide(points, seed=0)
    cloud, index = hidden.map, hidden.truth.index
    apart = np.linalg.norm(np.cross(points[index], cloud.direction) - cloud.moment, axis=1)
    assert apart.max() < np.sqrt(3) / 2 * step * 1.001
    assert np.median(apart) > 0.01 * step


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e9])
def test_a_scene_in_double_precision_lies_on_no_lattice(scale):
    points = scale * np.random.default_rng(0).normal(size=(500, 3))
    assert (lattice_step(points) == 0).all()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_the_step_of_single_precision_is_that_of_the_largest_coordinate(scale):
    points = single(scale * np.random.default_rng(0).normal(size=(500, 3)))
    largest = np.abs(points).max(axis=1).astype(np.float32)
    np.testing.assert_array_equal(lattice_step(points), np.repeat(np.spacing(largest)[:, None], 3, axis=1))


def test_far_points_do_not_coarsen_the_rounding_of_near_ones():
    points = single(np.random.default_rng(0).normal(size=(500, 3)))
    points[0] = 1e6
    assert lattice_step(points)[1:].max() < 1e-6


@pytest.mark.parametrize("points", [np.zeros((4, 3)), np.full((3, 3), 1e30 / 3), np.full((3, 3), 1e-320)])
def test_points_of_no_or_of_any_size_can_be_lifted(points):
    hidden = hide(points, seed=0)
    cloud, index = hidden.map, hidden.truth.index
    assert np.isfinite(cloud.moment).all() and len(index) == len(points)
