"""A line cloud holds lines: unit directions, perpendicular moments, and nothing of where on a line a point was."""

from __future__ import annotations

import jaxtyping
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2p.errors import InputError
from l2p.maps.lines import LineCloud

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25, deadline=None)


@pytest.fixture
def unchecked(monkeypatch):
    """Wrong shapes and types reach l2p's own checks, as they do for users, who run without the jaxtyping hook."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def draw(seed: int, count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-3, 3), rng.normal(size=(count, 3))


@given(seeds)
@few
def test_points_lie_on_their_lines_and_directions_are_unit(seed):
    point, direction = draw(seed)
    cloud = LineCloud.through(point, direction)
    size = np.abs(point).max()
    np.testing.assert_allclose(np.linalg.norm(cloud.direction, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(np.cross(point, cloud.direction), cloud.moment, atol=1e-14 * size)
    along = np.sum((point - cloud.origin) * cloud.direction, axis=1)
    np.testing.assert_allclose(cloud.at(along), point, atol=1e-14 * size)


@given(seeds)
@few
def test_the_origin_is_the_foot_of_the_perpendicular_from_zero(seed):
    cloud = LineCloud.through(*draw(seed))
    size = np.abs(cloud.moment).max()
    np.testing.assert_allclose(np.sum(cloud.origin * cloud.direction, axis=1), 0, atol=1e-14 * size)
    np.testing.assert_allclose(np.sum(cloud.moment * cloud.direction, axis=1), 0, atol=1e-14 * size)
    distance = np.linalg.norm(cloud.at(np.zeros(len(cloud))), axis=1)
    for step in (-0.1, 0.1):
        assert (np.linalg.norm(cloud.at(np.full(len(cloud), step * size)), axis=1) > distance).all()


@given(seeds, st.floats(-5, 5))
@few
def test_a_slid_point_and_a_direction_of_another_length_give_the_same_line(seed, slide):
    point, direction = draw(seed)
    one = LineCloud.through(point, direction)
    other = LineCloud.through(point + slide * direction, 7 * direction)
    np.testing.assert_allclose(other.direction, one.direction, atol=1e-14)
    np.testing.assert_allclose(other.moment, one.moment, atol=1e-12 * (1 + np.abs(point).max()))


@given(seeds)
@few
def test_a_flipped_direction_keeps_the_origin(seed):
    point, direction = draw(seed)
    one, other = LineCloud.through(point, direction), LineCloud.through(point, -direction)
    np.testing.assert_array_equal(other.direction, -one.direction)
    np.testing.assert_array_equal(other.moment, -one.moment)
    np.testing.assert_array_equal(other.origin, one.origin)


def test_a_line_through_zero_has_moment_and_origin_zero():
    cloud = LineCloud.through(np.array([[0.0, 0, 5]]), np.array([[0.0, 0, -2]]))
    assert (cloud.moment == 0).all() and (cloud.origin == 0).all()


def test_lines_cannot_be_changed_and_do_not_share_their_input():
    direction, moment = np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]])
    cloud = LineCloud(direction, moment)
    with pytest.raises(ValueError, match="read-only"):
        cloud.direction[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        cloud.moment[0, 0] = 1
    direction[0, 2] = 5
    assert cloud.direction[0, 2] == 1


def test_single_precision_input_is_made_unit_and_perpendicular():
    cloud = LineCloud.through(*draw(3, 1000))
    rounded = LineCloud(
        cloud.direction.astype(np.float32).astype(np.float64), cloud.moment.astype(np.float32).astype(np.float64)
    )
    np.testing.assert_allclose(np.linalg.norm(rounded.direction, axis=1), 1, atol=1e-15)
    assert np.abs(np.sum(rounded.direction * rounded.moment, axis=1)).max() < 1e-13 * np.abs(cloud.moment).max()


@given(seeds, st.sampled_from([np.float32, np.float64]))
@few
def test_a_line_cloud_made_of_its_own_arrays_is_the_same_to_the_last_bit(seed, precision):
    drawn = LineCloud.through(*draw(seed, 200))
    direction, moment = (part.astype(precision).astype(np.float64) for part in (drawn.direction, drawn.moment))
    once = LineCloud(direction, moment)
    again = LineCloud(once.direction, once.moment)
    np.testing.assert_array_equal(again.direction, once.direction)
    np.testing.assert_array_equal(again.moment, once.moment)


def test_no_lines_are_a_line_cloud():
    cloud = LineCloud(np.zeros((0, 3)), np.zeros((0, 3)))
    assert len(cloud) == 0
    assert cloud.origin.shape == cloud.at(np.zeros(0)).shape == (0, 3)


def replaced(value: float, row: int = 2) -> np.ndarray:
    rows = np.tile([0.0, 0, 1], (4, 1))
    rows[row, 0] = value
    return rows


UP, SIDE = np.tile([0.0, 0, 1], (4, 1)), np.tile([1.0, 0, 0], (4, 1))


@pytest.mark.parametrize(
    ("direction", "moment", "message"),
    [
        (UP, SIDE[:3], r"got 4 directions and 3 moments; expected one moment"),
        (UP[:, :2], SIDE, r"got direction of shape \(4, 2\); expected \(lines, 3\)"),
        (UP, SIDE.ravel(), r"got moment of shape \(12,\); expected \(lines, 3\)"),
        (replaced(np.nan), SIDE, r"1 line\(s\) with a direction that is NaN, infinite or beyond 1e30, first at line 2"),
        (UP, replaced(np.inf), r"1 line\(s\) with a moment that is NaN, infinite or beyond 1e30, first at line 2"),
        (UP * 0, SIDE, r"4 line\(s\) with a direction of length other than 1, first at line 0; normalise"),
        (replaced(0.1), SIDE, r"1 line\(s\) with a direction of length other than 1, first at line 2"),
        (UP, UP, r"4 line\(s\) with a moment that is not perpendicular to its direction, first at line 0; store p x d"),
        (UP.astype(object), SIDE, r"got direction of type object; expected numbers"),
        (UP, SIDE.astype(complex), r"got moment of type complex128; expected numbers"),
        (UP.astype(str), SIDE, r"got direction of type <U\d+; expected numbers"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_line_is_refused_in_one_sentence(direction, moment, message):
    with pytest.raises(InputError, match=message):
        LineCloud(direction, moment)


@pytest.mark.usefixtures("unchecked")
def test_colours_must_match_the_lines():
    with pytest.raises(InputError, match="got rgb of 3 rows for 4 lines; expected one row each"):
        LineCloud(UP, SIDE, np.zeros((3, 3), dtype=np.uint8))


def test_the_first_bad_line_is_counted_from_zero():
    with pytest.raises(InputError, match=r"first at line 2; .* \(lines are counted from 0\)$"):
        LineCloud(replaced(np.nan), SIDE)


@pytest.mark.usefixtures("unchecked")
def test_lines_through_points_need_a_direction_each():
    with pytest.raises(InputError, match="got 4 points and 3 directions; expected one direction a point"):
        LineCloud.through(SIDE, UP[:3])
    with pytest.raises(InputError, match=r"got 4 line\(s\) with a direction of length 0, first at line 0; remove"):
        LineCloud.through(SIDE, UP * 0)
    with pytest.raises(InputError, match=r"got 1 line\(s\) with a point that is NaN, infinite or .*, first at line 2"):
        LineCloud.through(replaced(np.nan), UP)
