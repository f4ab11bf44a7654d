"""Regions: what is in a box, and that what is left out leaves with all that belongs to it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import l2p
from l2p.maps.region import Box, kept_rows


def scene_of(rng: np.random.Generator, points: int = 200) -> l2p.Scene:
    """A scene with every attribute, each other in each row."""
    return l2p.Scene(
        rng.normal(size=(points, 3)),
        rgb=rng.integers(0, 256, (points, 3), dtype=np.uint8),
        error=rng.random(points).astype(np.float32),
        track_length=rng.integers(2, 9, points).astype(np.int32),
        ids=rng.permutation(10 * points)[:points],
        camera_centers=rng.normal(size=(4, 3)),
        descriptor=rng.normal(size=(points, 5)).astype(np.float32),
        descriptor_kind="toy",
    )


def test_a_box_holds_what_a_loop_finds(rng):
    points = rng.uniform(-2, 2, size=(500, 3))
    box = Box((-1.0, -0.5, -2.0), (0.5, 1.5, 1.0))
    one_by_one = [
        all(low <= value <= high for low, value, high in zip(box.low, point, box.high, strict=True)) for point in points
    ]
    assert 0 < sum(one_by_one) < 500
    assert box.contains(points).tolist() == one_by_one


def test_corners_may_come_in_any_order(rng):
    points = rng.uniform(-2, 2, size=(300, 3))
    sides = [(-1.0, 0.5), (-0.5, 1.5), (-2.0, 1.0)]
    straight = Box.of([side[0] for side in sides] + [side[1] for side in sides])
    for turned in itertools.product((0, 1), repeat=3):
        box = Box.of(
            [s[t] for s, t in zip(sides, turned, strict=True)] + [s[1 - t] for s, t in zip(sides, turned, strict=True)]
        )
        assert box == straight
        np.testing.assert_array_equal(box.contains(points), straight.contains(points))


def test_sides_belong_to_the_box():
    box = Box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    corners = np.array(list(itertools.product((0.0, 1.0), (0.0, 2.0), (0.0, 3.0))))
    assert box.contains(corners).all()
    assert not box.contains(np.nextafter(corners, np.where(corners > 0, np.inf, -np.inf))).any()
    assert Box((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)).contains(np.ones((1, 3))).all()


def test_sides_may_have_no_end(rng):
    points = rng.normal(size=(100, 3))
    above = Box.of([-np.inf, -np.inf, 0.3, np.inf, np.inf, np.inf])
    np.testing.assert_array_equal(above.contains(points), points[:, 2] >= 0.3)


@pytest.mark.parametrize("numbers", [[0, 0, 0, 1, 1], [0, 0, 0, 1, 1, 1, 1], [], [0, 0, np.nan, 1, 1, 1]])
def test_what_is_no_box_is_refused(numbers):
    with pytest.raises(l2p.InputError, match=r"expected (six, x0 y0 z0 x1 y1 z1|two corners)"):
        Box.of(numbers)


@pytest.mark.parametrize(
    ("drop", "words"),
    [
        (np.zeros(4, dtype=bool), "none of the 4 points"),
        (np.ones(4, dtype=bool), "all 4 points"),
        (np.ones(3, dtype=bool), r"shape \(3,\); expected booleans, one for each of the 4 points"),
        (np.array([0, 1, 0, 1]), "type int64"),
        (np.ones((4, 1), dtype=bool), "expected booleans"),
        ("all", "expected booleans"),
    ],
)
def test_what_is_no_choice_of_points_is_refused(drop, words):
    with pytest.raises(l2p.InputError, match=words):
        kept_rows(drop, 4)


def test_rows_of_a_scene_have_all_that_belongs_to_them(rng):
    scene = scene_of(rng)
    mask = rng.random(200) < 0.3
    for some in (mask, np.flatnonzero(mask), rng.permutation(200)[:40]):
        part = scene.rows(some)
        assert len(part) == len(scene.xyz[some])
        for name in ("xyz", "rgb", "error", "track_length", "ids", "descriptor"):
            np.testing.assert_array_equal(getattr(part, name), getattr(scene, name)[some])
        assert part.descriptor_kind == "toy" and part.camera_centers is scene.camera_centers
    assert len(l2p.Scene(scene.xyz).rows(mask)) == mask.sum()


@pytest.mark.parametrize("fraction", [1.0, 0.4])
def test_lines_are_those_of_a_scene_that_never_had_the_points(rng, fraction):
    scene = scene_of(rng)
    drop = Box((-0.5, -0.5, -0.5), (2.0, 2.0, 2.0)).contains(scene.xyz)
    hidden = l2p.hide(scene, 3, fraction, rgb=True, descriptor=True, drop=drop)
    other = l2p.hide(scene.rows(~drop), 3, fraction, rgb=True, descriptor=True)
    for name in ("direction", "moment", "rgb", "descriptor"):
        np.testing.assert_array_equal(getattr(hidden.map, name), getattr(other.map, name))
    truth = hidden.truth
    assert truth.ids is not None and scene.ids is not None and scene.rgb is not None and hidden.map.rgb is not None
    assert not drop[truth.index].any(), "rows are those of the whole scene"
    np.testing.assert_array_equal(truth.xyz, scene.xyz[truth.index])
    np.testing.assert_array_equal(truth.ids, scene.ids[truth.index])
    np.testing.assert_array_equal(hidden.map.rgb, scene.rgb[truth.index])
    assert not set(truth.ids.tolist()) & set(scene.ids[drop].tolist())
    np.testing.assert_array_equal(l2p.lift(scene, 3, fraction, drop=drop).moment, hidden.map.moment)


def test_points_left_out_do_not_change_the_lines(rng):
    """Neither where they are nor how many digits they have."""
    scene = scene_of(rng)
    rounded = l2p.Scene(np.round(scene.xyz, 3))
    drop = np.arange(200) % 3 == 0
    moved = np.where(drop[:, None], rng.normal(size=(200, 3)) * 50, rounded.xyz)
    lines = [l2p.lift(points, 1, drop=drop) for points in (rounded, l2p.Scene(moved))]
    np.testing.assert_array_equal(lines[0].moment, lines[1].moment)


def test_given_colours_are_dropped_as_those_of_a_scene(rng):
    scene = scene_of(rng)
    drop = scene.xyz[:, 0] > 0.5
    given = l2p.lift(scene.xyz, 2, rgb=scene.rgb, drop=drop)
    np.testing.assert_array_equal(given.rgb, l2p.lift(scene, 2, rgb=True, drop=drop).rgb)
    assert len(given) == (~drop).sum()
