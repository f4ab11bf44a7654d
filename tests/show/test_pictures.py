"""The geometry behind the picture."""

from __future__ import annotations

import numpy as np
import pytest

from l2p.maps.lines import LineCloud
from l2p.maps.scene import Scene
from l2p.schemes.hide import lift
from l2p.show.pictures import Box, Camera, Captions, draw_attack

CAPTIONS = Captions("title", ("a", "b"), ("c", "d"), ("e", "f"), "g")


@pytest.fixture
def box() -> Box:
    return Box(np.array([-1.0, -2.0, 0.0]), np.array([1.0, 2.0, 3.0]))


def test_segments_end_on_the_box(box, rng):
    inside = rng.uniform(box.low, box.high, size=(200, 3))
    ends = box.segments(LineCloud.through(inside, rng.normal(size=(200, 3))))
    assert ends.shape == (200, 2, 3)
    gap = np.minimum(np.abs(ends - box.low), np.abs(ends - box.high)).min(axis=2)
    np.testing.assert_allclose(gap, 0, atol=1e-12)
    assert np.all((ends >= box.low - 1e-12) & (ends <= box.high + 1e-12))


def test_segments_hold_the_points(box, rng):
    inside = rng.uniform(box.low, box.high, size=(200, 3))
    begin, end = box.segments(LineCloud.through(inside, rng.normal(size=(200, 3)))).swapaxes(0, 1)
    length = np.linalg.norm(end - begin, axis=1)
    detour = np.linalg.norm(inside - begin, axis=1) + np.linalg.norm(end - inside, axis=1)
    np.testing.assert_allclose(detour, length, rtol=1e-9)


def test_lines_beside_the_box_have_no_segment(box):
    lines = LineCloud.through(np.array([[5.0, 0, 0], [0, 0, 4.0]]), np.array([[0.0, 0, 1], [1.0, 0, 0]]))
    assert box.segments(lines).shape == (0, 2, 3)


def test_axis_parallel_lines_cross_the_box(box):
    lines = LineCloud.through(np.array([[0.5, 0.5, 1.0]] * 3), np.eye(3))
    ends = np.sort(box.segments(lines), axis=1)
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], np.diag(box.high - box.low), atol=1e-12)


def test_camera_looks_at_the_middle_of_the_box(box):
    place, depth = Camera.above(box).project((box.low + box.high) / 2)
    np.testing.assert_allclose(place, 0, atol=1e-12)
    assert depth > 0


def test_camera_axes_are_a_right_handed_frame(box):
    axes = Camera.above(box).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    # Image x right, image y up, z forward: a left-handed triple, as the image is seen from behind.
    assert np.linalg.det(axes) == pytest.approx(-1)


def test_up_is_up(box):
    camera = Camera.above(box)
    low, _ = camera.project(np.array([0.0, 0, 0]))
    high, _ = camera.project(np.array([0.0, 0, 1]))
    assert high[1] > low[1]
    assert high[0] == pytest.approx(low[0], abs=1e-9)


def test_nearest_walls_are_left_open(box):
    edges = box.edges()
    assert edges.shape == (9, 2, 3)
    # The edge between the two walls that would hide the room is not drawn.
    near = np.array([box.high[0], box.low[1], box.high[2]])
    assert not np.any(np.all(edges == near, axis=2))


def test_box_of_room_leaves_out_the_view_from_the_window(rng):
    room = rng.uniform(size=(4000, 3))
    room[np.arange(4000), rng.integers(0, 3, 4000)] = rng.integers(0, 2, 4000)
    outside = rng.normal((20, 0, 0), 1, size=(1000, 3))
    scene = Scene(np.concatenate([room * (6, 4, 2.5), outside]), camera_centers=np.array([[3.0, 2, 1.5]]))
    box = Box.of_room(scene)
    np.testing.assert_allclose(box.low, 0, atol=0.11)
    np.testing.assert_allclose(box.high, (6, 4, 2.5), atol=0.11)


@pytest.mark.parametrize("count", [1, 300])
def test_picture_is_written(count, rng):
    xyz = rng.uniform(size=(count, 3)) * (4, 3, 2)
    picture = draw_attack(Scene(xyz), lift(xyz, seed=0), xyz, np.zeros(count), CAPTIONS)
    assert picture.startswith(b"\x89PNG")
