"""Up from the rotations of cameras: in a tilted world, of cameras that look down, and of ones that tell nothing."""

from __future__ import annotations

import numpy as np
import pytest

from l2p.maps.upright import up_of

UP = np.array([0.0, 0.0, 1.0])


def looking(pitch: float, headings: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """World to camera (rows right, down, forward) of level cameras that look ``pitch`` radians down."""
    found = []
    for heading in headings:
        across = np.array([np.cos(heading), np.sin(heading), 0.0])
        forward = np.cos(pitch) * across - np.sin(pitch) * UP
        right = np.cross(forward, UP)
        right = right / np.linalg.norm(right)
        down = np.cross(forward, right)
        turned = [np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward]
        found.append(np.stack(turned))
    return np.array(found)


def turn(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def degrees(one: np.ndarray | None, other: np.ndarray) -> float:
    assert one is not None and np.linalg.norm(one) == pytest.approx(1)
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


@pytest.mark.parametrize("pitch", [-0.3, 0.0, 0.6, 1.2])
@pytest.mark.parametrize("arc", [0.6, 2 * np.pi])
def test_level_cameras_tell_up_in_any_frame_however_far_they_look_down(pitch, arc, rng):
    cameras = looking(pitch, np.linspace(0, arc, 30, endpoint=False))
    for _ in range(3):
        axes = turn(rng)
        assert degrees(up_of(cameras @ axes.T), axes @ UP) < 0.1


def test_cameras_that_look_straight_down_see_the_ground_before_them(rng):
    there, back = looking(np.pi / 2 - 1e-6, np.linspace(0, 0.2, 10)), looking(np.pi / 2 - 1e-6, np.pi + np.zeros(10))
    sideways = looking(np.pi / 2 - 1e-6, np.full(10, np.pi / 2))
    assert degrees(up_of(np.concatenate([there, back, sideways])), UP) < 1


def test_where_all_look_the_same_way_up_is_their_own(rng):
    assert degrees(up_of(looking(0.0, np.zeros(8))), UP) < 1e-3
    assert degrees(up_of(looking(0.0, np.zeros(1))), UP) < 1e-3


def test_some_cameras_held_upright_do_not_turn_the_map(rng):
    headings = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    both = np.concatenate([looking(0.1, headings), looking(0.1, headings[::2], roll=np.pi / 2)])
    assert degrees(up_of(both), UP) < 5


def test_nothing_is_said_without_cameras_or_of_cameras_that_contradict_each_other():
    assert up_of(np.zeros((0, 3, 3))) is None
    assert up_of(np.full((2, 3, 3), np.nan)) is None
    assert up_of(np.concatenate([looking(0.0, np.zeros(2), roll=roll) for roll in (0.0, np.pi)])) is None
