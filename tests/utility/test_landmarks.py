"""Landmarks: residuals, their derivatives, poses of minimal samples, and what none of them may depend on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import l2p
from l2p.utility.landmarks import Gravity, Landmarks, LineLandmarks, PointLandmarks
from l2p.utility.queries import Pose

KINDS = ("points", "lines")


def poses_near(pose: Pose, count: int, seed: int = 1) -> list[Pose]:
    """The pose, some near it, and some that look away."""
    rng, found = np.random.default_rng(seed), [pose]
    for number in range(count):
        vector = rng.normal(size=3) * (0.02 if number % 2 else 2)
        turn = Rotation.from_rotvec(vector).as_matrix()
        found.append(Pose(turn @ pose.rotation, turn @ pose.translation + 0.1 * rng.normal(size=3)))
    return found


def entered(landmarks: Landmarks, poses: list[Pose]) -> np.ndarray:
    return np.array([landmarks.enter(pose) for pose in poses])


def residual_of_point(pose: Pose, bearing: np.ndarray, point: np.ndarray) -> float:
    """Chord of the angle between the bearing and the ray to the point."""
    place = pose.rotation @ point + pose.translation
    angle = math.atan2(np.linalg.norm(np.cross(bearing, place)), bearing @ place)
    return 2 * math.sin(angle / 2) if angle < math.pi / 2 else math.pi / 2


def residual_of_line(pose: Pose, bearing: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    """Sine of the angle to the plane through the line; the bearing, moved into the plane, has to meet the line."""
    one, other = (pose.rotation @ (origin + step * direction) + pose.translation for step in (0, 1))
    normal = np.cross(one, other)
    normal /= np.linalg.norm(normal)
    inside = bearing - (bearing @ normal) * normal
    # distance * inside = one + step * (other - one)
    distance, _ = np.linalg.lstsq(np.column_stack([inside, one - other]), one, rcond=None)[0]
    return abs(float(bearing @ normal)) if distance > 0 else math.pi / 2


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_equal_a_loop_over_the_geometry(view, kind):
    seen = view(noise=3.0)
    landmarks, poses = seen.landmarks(kind), poses_near(seen.pose, 6)
    found = landmarks.residuals(entered(landmarks, poses), seen.bearing, seen.rows)
    for pose, row in zip(poses, found, strict=True):
        for number, bearing in enumerate(seen.bearing):
            if kind == "points":
                expected = residual_of_point(pose, bearing, seen.xyz[number])
            else:
                expected = residual_of_line(pose, bearing, seen.lines.origin[number], seen.lines.direction[number])
            assert row[number] == pytest.approx(expected, abs=1e-9)
    behind = found == math.pi / 2
    assert behind.any() and not behind[0].any()


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_of_the_true_pose_are_zero(view, kind):
    seen = view()
    landmarks = seen.landmarks(kind)
    assert landmarks.residuals(entered(landmarks, [seen.pose]), seen.bearing, seen.rows).max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
def test_matches_may_be_in_any_order_and_repeat(view, rng, kind):
    seen = view(noise=1.0)
    landmarks, some = seen.landmarks(kind), rng.integers(0, 80, 50)
    poses = entered(landmarks, poses_near(seen.pose, 3))
    whole = landmarks.residuals(poses, seen.bearing, seen.rows)
    assert np.allclose(landmarks.residuals(poses, seen.bearing[some], some), whole[:, some], rtol=0, atol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_linearized_residuals_have_the_numeric_derivatives(view, kind):
    seen = view(noise=3.0)
    landmarks, step = seen.landmarks(kind), 1e-6
    for pose in entered(landmarks, poses_near(seen.pose, 1)[:2]):
        residual, slope = landmarks.linearized(pose, seen.bearing, seen.rows)
        assert slope.shape == (*residual.shape, 6)
        for column, vector in enumerate(np.eye(6)):
            sides = []
            for sign in (1, -1):
                turn = Rotation.from_rotvec(sign * step * vector[:3]).as_matrix()
                moved = np.column_stack([turn @ pose[:, :3], pose[:, 3] + sign * step * vector[3:]])
                sides.append(landmarks.linearized(moved, seen.bearing, seen.rows)[0])
            numeric = (sides[0] - sides[1]) / (2 * step)
            assert np.allclose(slope[..., column], numeric, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_linearized_residuals_are_the_small_residuals(view, kind):
    seen = view(noise=3.0)
    landmarks = seen.landmarks(kind)
    pose = landmarks.enter(seen.pose)
    signed, _ = landmarks.linearized(pose, seen.bearing, seen.rows)
    whole = landmarks.residuals(pose[None], seen.bearing, seen.rows)[0]
    assert np.allclose(np.linalg.norm(signed, axis=1), whole, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("known", [False, True], ids=["", "gravity"])
@pytest.mark.parametrize("kind", KINDS)
def test_poses_of_a_sample_without_noise_contain_the_true_one(view, kind, known):
    world = np.array([0.3, -2.0, 0.7])
    for seed in range(10):
        seen = view(seed, count=6)
        landmarks = seen.landmarks(kind)
        gravity = Gravity(seen.pose.rotation @ world, world) if known else None
        size = landmarks.upright_sample if known else landmarks.sample
        assert (known and size < landmarks.sample) or not known
        poses = landmarks.poses(seen.bearing[:size], seen.rows[:size], gravity)
        assert poses.shape[1:] == (3, 4)
        assert min(seen.error(landmarks.leave(pose)) for pose in poses) < 1e-5


def test_poses_of_an_impossible_sample_are_an_empty_array(view, rng):
    seen = view()
    for kind in KINDS:
        landmarks = seen.landmarks(kind)
        counts = set()
        for _ in range(20):
            bearing = rng.normal(size=(landmarks.sample, 3))
            bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
            poses = landmarks.poses(bearing, rng.choice(80, landmarks.sample, replace=False), None)
            assert poses.shape[1:] == (3, 4)
            counts.add(len(poses))
        assert 0 in counts


@pytest.mark.parametrize("kind", KINDS)
def test_enter_and_leave_are_inverse(view, kind):
    seen = view()
    landmarks = seen.landmarks(kind)
    for pose in poses_near(seen.pose, 5):
        back = landmarks.leave(landmarks.enter(pose))
        assert np.allclose(back.rotation, pose.rotation) and np.allclose(back.translation, pose.translation)


@pytest.mark.parametrize("kind", KINDS)
def test_residuals_do_not_depend_on_position_rotation_and_scale_of_the_scene(view, kind):
    seen = view(noise=3.0)
    turn, move, scale = Rotation.from_rotvec([1.0, -2.0, 0.4]).as_matrix(), np.array([4e3, -7e3, 1e3]), 250.0
    other = replace(
        seen,
        xyz=scale * seen.xyz @ turn.T + move,
        lines=l2p.LineCloud.through(scale * seen.xyz @ turn.T + move, seen.lines.direction @ turn.T),
    )
    poses = poses_near(seen.pose, 4)
    moved = []
    for pose in poses:
        rotation = pose.rotation @ turn.T
        moved.append(Pose(rotation, scale * pose.translation - rotation @ move))
    one, two = seen.landmarks(kind), other.landmarks(kind)
    first = one.residuals(entered(one, poses), seen.bearing, seen.rows)
    second = two.residuals(entered(two, moved), seen.bearing, seen.rows)
    assert np.allclose(first, second, rtol=0, atol=1e-9)


def test_signs_and_origins_of_lines_have_no_meaning(view, rng):
    seen = view(noise=3.0)
    sign = rng.choice([-1.0, 1.0], (80, 1))
    along = seen.lines.at(rng.uniform(-30, 30, 80))
    turned = l2p.LineCloud.through(along, sign * seen.lines.direction)
    one, two = LineLandmarks(seen.lines), LineLandmarks(turned)
    poses = poses_near(seen.pose, 4)
    first, second = (each.residuals(entered(each, poses), seen.bearing, seen.rows) for each in (one, two))
    assert np.allclose(first, second, rtol=0, atol=1e-9)
    # The poses of a sample are the same, too, in any order.
    for seed in range(5):
        seen = view(seed, count=6)
        flipped = l2p.LineCloud.through(seen.xyz, -seen.lines.direction)
        found = []
        for landmarks in (LineLandmarks(seen.lines), LineLandmarks(flipped)):
            poses = landmarks.poses(seen.bearing, seen.rows, None)
            found.append(min(seen.error(landmarks.leave(pose)) for pose in poses))
        assert max(found) < 1e-5


def test_points_at_one_place_have_a_frame(rng):
    landmarks = PointLandmarks(np.ones((5, 3)))
    assert landmarks.unit == 1 and len(landmarks) == 5
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 5.0]))
    assert np.isfinite(landmarks.residuals(landmarks.enter(pose)[None], np.eye(3)[:1], np.arange(1))).all()


def test_a_camera_on_a_line_is_no_error(view):
    """Every bearing then lies in a plane through the line: there is no residual, but nothing may break."""
    seen = view()
    landmarks = LineLandmarks(seen.lines)
    on = seen.lines.at(np.array([0.5] * 80))[0]
    pose = Pose(seen.pose.rotation, -seen.pose.rotation @ on)
    found = landmarks.residuals(landmarks.enter(pose)[None], seen.bearing, seen.rows)
    assert np.isfinite(found).all()


def test_gravity_is_a_direction(view):
    """Its length does not count, and it is turned to the axis of the solvers in the camera and in the map."""
    seen, world = view(), np.array([0.0, 0.0, -9.81])
    gravity = Gravity(seen.pose.rotation @ world, world)
    for turn, vector in ((gravity.camera, seen.pose.rotation @ world), (gravity.world, world)):
        assert np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) == pytest.approx(1)
        assert np.allclose(turn @ vector, [0, 9.81, 0])
    longer = Gravity(0.1 * (seen.pose.rotation @ world), 3 * world)
    one, two = (seen.landmarks("points").poses(seen.bearing[:2], seen.rows[:2], each) for each in (gravity, longer))
    assert np.allclose(one, two)
