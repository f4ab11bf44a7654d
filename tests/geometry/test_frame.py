"""The working frame moves, turns and scales with the lines, and exists for any of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2p.geometry.frame import DIGITS, Frame
from l2p.maps.lines import LineCloud

seeds = st.integers(0, 2**32 - 1)


def draw(seed: int, count: int = 50) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)), rng.normal(size=(count, 3))


@given(seeds, st.floats(-2, 3), st.floats(0, 4))
@settings(max_examples=25, deadline=None)
def test_the_frame_follows_a_similarity(seed, log_scale, log_shift):
    point, direction = draw(seed)
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(3 * rng.normal(size=3)).as_matrix()
    scale = 10**log_scale
    shift = scale * 10**log_shift * rng.normal(size=3)
    one = Frame.of(LineCloud.through(point, direction))
    moved = Frame.of(LineCloud.through(scale * point @ turn.T + shift, direction @ turn.T))
    np.testing.assert_allclose(moved.unit, scale * one.unit, rtol=1e-6)
    np.testing.assert_allclose(moved.center, scale * turn @ one.center + shift, atol=1e-6 * scale)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_order_sign_and_slid_origins_do_not_matter(seed):
    point, direction = draw(seed)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(point))
    slid = point + rng.normal(size=(len(point), 1)) * direction
    sign = rng.choice([-1.0, 1.0], size=(len(point), 1))
    one = Frame.of(LineCloud.through(point, direction))
    other = Frame.of(LineCloud.through(slid[order], (sign * direction)[order]))
    np.testing.assert_allclose(other.center, one.center, atol=1e-9)
    np.testing.assert_allclose(other.unit, one.unit, rtol=1e-9)


def test_the_centre_has_the_least_sum_of_distances_and_the_unit_is_their_median():
    cloud = LineCloud.through(*draw(0, 301))
    frame = Frame.of(cloud)

    def distances(point: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.cross(point, cloud.direction) - cloud.moment, axis=1)

    least = distances(frame.center).sum()
    for step in np.concatenate([np.eye(3), -np.eye(3)]) * 1e-2:
        assert distances(frame.center + step).sum() > least
    assert frame.unit == pytest.approx(np.median(distances(frame.center)), rel=1e-9)


def test_the_centre_lies_amid_the_points_whatever_the_outliers():
    point, direction = draw(1, 500)
    point[:50] *= 1000
    frame = Frame.of(LineCloud.through(point + 30, direction))
    assert np.linalg.norm(frame.center - 30) < 0.3
    assert 0.3 < frame.unit < 3


def test_lines_and_points_enter_and_positions_come_back():
    point, direction = draw(2)
    cloud = LineCloud.through(point + 100, direction)
    frame = Frame.of(cloud)
    lines = frame.enter(cloud, dtype=torch.float64)
    inside = frame.enter_points(point + 100, dtype=torch.float64)
    residual = torch.linalg.cross(inside, lines.direction) - lines.moment
    assert residual.abs().max() < 8 * 2.0**-DIGITS
    beta = ((inside - lines.foot) * lines.direction).sum(dim=1)
    np.testing.assert_allclose(cloud.at(frame.leave(cloud, beta)), point + 100, atol=8 * 2.0**-DIGITS * frame.unit)


@given(seeds, st.floats(-2, 3), st.floats(0, 3))
@settings(max_examples=25, deadline=None)
def test_the_same_lines_enter_as_the_same_numbers_however_they_are_written(seed, log_scale, log_shift):
    point, direction = draw(seed, 200)
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(3 * rng.normal(size=3)).as_matrix()
    scale = 10**log_scale
    shift = scale * 10**log_shift * rng.normal(size=3)
    sign = rng.choice([-1.0, 1.0], size=(len(point), 1))
    slid = point + rng.normal(size=(len(point), 1)) * direction
    order = rng.permutation(len(point))
    one = LineCloud.through(point, direction)
    other = LineCloud.through((scale * slid @ turn.T + shift)[order], (sign * direction @ turn.T)[order])
    entered = [Frame.of(cloud).enter(cloud) for cloud in (one, other)]
    for expected, found in zip(*entered, strict=True):
        # Where a number lies on the border of two rounded ones, it may become either.
        assert (found == expected[torch.as_tensor(order)]).all(dim=1).float().mean() >= 0.99


def test_the_axes_turn_with_the_lines_and_know_left_from_right():
    point, direction = draw(5, 300)
    point = np.abs(point) * [1, 2, 4]
    turn = Rotation.from_rotvec([0.3, 2.0, -1.1]).as_matrix()
    one = Frame.of(LineCloud.through(point, direction)).axes
    turned = Frame.of(LineCloud.through(point @ turn.T, direction @ turn.T)).axes
    np.testing.assert_allclose(turned, turn @ one, atol=1e-9)
    mirrored = Frame.of(LineCloud.through(point * [1, 1, -1], direction * [1, 1, -1])).axes
    for axes in (one, turned, mirrored):
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) > 0


def degenerate(kind: str) -> LineCloud:
    point, direction = draw(3, 20)
    return {
        "one line": LineCloud.through(point[:1], direction[:1]),
        "two lines": LineCloud.through(point[:2], direction[:2]),
        "two parallel lines": LineCloud.through(point[:2], direction[[0, 0]]),
        "one line twice": LineCloud.through(point[[0, 0]], direction[[0, 0]]),
        "all parallel": LineCloud.through(point, np.tile(direction[0], (20, 1))),
        "all through one point": LineCloud.through(np.tile(point[0], (20, 1)), direction),
        "all through zero": LineCloud.through(np.zeros((20, 3)), direction),
        "all in a plane": LineCloud.through(point * [1, 1, 0], direction * [1, 1, 0]),
    }[kind]


@pytest.mark.parametrize(
    "kind",
    [
        "one line",
        "two lines",
        "two parallel lines",
        "one line twice",
        "all parallel",
        "all through one point",
        "all through zero",
        "all in a plane",
    ],
)
@pytest.mark.parametrize("shift", [0.0, 1e5])
def test_degenerate_lines_have_a_frame(kind, shift):
    cloud = degenerate(kind)
    cloud = LineCloud.through(cloud.origin + shift, cloud.direction)
    frame = Frame.of(cloud)
    lines = frame.enter(cloud)
    assert np.isfinite(frame.center).all() and np.isfinite(frame.unit) and frame.unit > 0
    assert torch.isfinite(lines.moment).all()
    assert np.isfinite(frame.leave(cloud, torch.zeros(len(cloud)))).all()


def test_lines_through_one_point_meet_at_the_centre():
    cloud = degenerate("all through one point")
    np.testing.assert_allclose(Frame.of(cloud).center, draw(3, 20)[0][0], atol=1e-12)


def test_two_lines_are_centred_between_them():
    cloud = LineCloud.through(np.array([[0.0, 0, 0], [0, 0, 2]]), np.array([[1.0, 0, 0], [0, 1, 0]]))
    frame = Frame.of(cloud)
    np.testing.assert_allclose(frame.center, [0, 0, 1], atol=1e-9)
    assert frame.unit == pytest.approx(1)
