"""Parts of a map that lie far apart are found from the lines; ordinary maps are one part."""

import numpy as np
import pytest

import l2p
from l2p.geometry.frame import Frame
from l2p.geometry.parts import parts_of
from l2p.schemes.hide import hide


def directions(count: int, seed: int = 0) -> np.ndarray:
    draw = np.random.default_rng(seed).normal(size=(count, 3))
    return draw / np.linalg.norm(draw, axis=1, keepdims=True)


def room(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, size=(count, 3)) * [1, 2, 0.5]


def found(points: np.ndarray) -> list[set[int]]:
    """Rows of the points behind the lines of each part."""
    hidden = hide(points, seed=3)
    return [set(hidden.truth.index[part].tolist()) for part in parts_of(hidden.map)]


@pytest.mark.parametrize("size", [1e4, 1e8])
@pytest.mark.parametrize("share", [0.5, 0.8])
def test_two_rooms_far_apart_are_two_parts(share: float, size: float) -> None:
    count = round(800 * share)
    points = np.concatenate([room(count), room(800 - count, 2) + size * directions(1)])
    assert sorted(map(min, found(points))) == [0, count]
    assert sorted(map(len, found(points))) == sorted([count, 800 - count])


@pytest.mark.parametrize(("far", "size"), [(80, 1e4), (8, 1e3), (1, 1e14)])
def test_far_points_are_a_part_of_their_own(far: int, size: float) -> None:
    points = np.concatenate([room(720), size * directions(far)])
    assert found(points) == [set(range(720)), set(range(720, 720 + far))]


def test_points_at_any_distance_leave_the_room_by_itself() -> None:
    rng = np.random.default_rng(4)
    points = np.concatenate([room(900), 10 ** rng.uniform(0.5, 6, size=(100, 1)) * directions(100)])
    first = found(points)[0]
    assert set(range(900)) <= first and len(first) < 950


@pytest.mark.parametrize("kind", ["room", "object"])
def test_ordinary_maps_are_one_part(kind: str) -> None:
    assert len(parts_of(l2p.lift(l2p.simulate(kind, 500, 1).xyz, seed=0))) == 1


@pytest.mark.parametrize("count", [1, 2, 40])
def test_a_few_lines_are_one_part(count: int) -> None:
    assert [len(part) for part in parts_of(l2p.lift(room(count), seed=0))] == [count]


@pytest.mark.parametrize("size", [1e4, 1e14])
def test_the_frame_is_that_of_the_near_points(size: float) -> None:
    lines = l2p.lift(np.concatenate([room(600), size * directions(3)]), seed=0)
    near = np.linalg.norm(lines.moment, axis=1) < 100
    frame, alone = Frame.of(lines), Frame.of(lines.rows(np.flatnonzero(near)))
    assert near.sum() == 600
    np.testing.assert_allclose(frame.center, alone.center, atol=0.02)
    assert frame.unit == pytest.approx(alone.unit, rel=0.02)
