"""Closest points and distances of pairs of lines: right, and as free of the choice of coordinates as they must be."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.pairs import (
    PARALLEL,
    closest_points,
    feet,
    least_squares_points,
    line_line_distance,
    point_line_distance,
)
from l2p.maps.lines import LineCloud

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25, deadline=None)


def draw(seed: int, count: int = 8) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)), rng.normal(size=(count, 3))


def lines_of(point: np.ndarray, direction: np.ndarray) -> Lines:
    cloud = LineCloud.through(point, direction)
    return Lines(torch.tensor(cloud.direction), torch.tensor(cloud.moment))


def everyone(count: int) -> torch.Tensor:
    """All others as the neighbours of each line."""
    return torch.tensor([[j for j in range(count) if j != i] for i in range(count)], dtype=torch.int64)


def closest_places(lines: Lines, neighbors: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Votes of all pairs as points in space, and the sine of each pair's angle."""
    beta = closest_points(lines, lines, neighbors).beta
    place = lines.foot[:, None] + beta[..., None] * lines.direction[:, None]
    cosine = (lines.direction[:, None] * lines.direction[neighbors]).sum(dim=2)
    return place.numpy(), (1 - cosine.square()).sqrt().numpy()


def check_same(place: np.ndarray, expected: np.ndarray, sine: np.ndarray, size: float = 1.0) -> None:
    """Equal up to rounding, which grows as pairs come near to parallel."""
    assert (np.linalg.norm(place - expected, axis=2) * sine**2 < 1e-11 * size).all()


@pytest.mark.parametrize("seed", range(3))
def test_votes_are_where_a_search_along_the_line_finds_the_least_distance(seed):
    lines = lines_of(*draw(seed, 5))
    neighbors = everyone(5)
    votes = closest_points(lines, lines, neighbors)
    distance = line_line_distance(lines, lines, neighbors)
    assert votes.valid.all()
    for i in range(5):
        for slot, j in enumerate(neighbors[i].tolist()):

            def apart(beta: float, i: int = i, j: int = j) -> float:
                place = lines.foot[i].numpy() + beta * lines.direction[i].numpy()
                return float(np.linalg.norm(np.cross(place, lines.direction[j]) - lines.moment[j].numpy()))

            found = minimize_scalar(apart, bounds=(-100, 100), method="bounded", options={"xatol": 1e-10})
            assert votes.beta[i, slot].item() == pytest.approx(found.x, abs=1e-5)  # type: ignore[attr-defined]
            assert distance[i, slot].item() == pytest.approx(found.fun, abs=1e-9)  # type: ignore[attr-defined]


@given(seeds)
@few
def test_the_two_votes_of_a_pair_span_its_distance_at_right_angles(seed):
    lines = lines_of(*draw(seed, 2))
    other = torch.tensor([[1], [0]])
    first, second = lines.at(closest_points(lines, lines, other).beta[:, 0])
    sine = torch.linalg.cross(*lines.direction).norm()
    if sine < 0.01:
        return
    apart = second - first
    assert (lines.direction @ apart).abs().max() < 1e-9
    np.testing.assert_allclose(line_line_distance(lines, lines, other), apart.norm().item(), atol=1e-9)


@given(seeds, st.floats(-3, 3))
@few
def test_a_slid_origin_changes_nothing(seed, slide):
    point, direction = draw(seed)
    place, sine = closest_places(lines_of(point, direction), everyone(8))
    slid, _ = closest_places(lines_of(point + slide * direction, direction), everyone(8))
    check_same(slid, place, sine, 10)


@given(seeds)
@few
def test_a_flipped_direction_negates_its_own_votes_only(seed):
    point, direction = draw(seed)
    sign = np.random.default_rng(seed).choice([-1.0, 1.0], size=8)
    one, other = lines_of(point, direction), lines_of(point, sign[:, None] * direction)
    votes, flipped = (closest_points(lines, lines, everyone(8)).beta.numpy() for lines in (one, other))
    np.testing.assert_allclose(flipped, sign[:, None] * votes, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(
        line_line_distance(other, other, everyone(8)), line_line_distance(one, one, everyone(8)), rtol=1e-12, atol=1e-14
    )


@given(seeds, st.floats(-3, 3))
@few
def test_votes_follow_a_similarity(seed, log_scale):
    point, direction = draw(seed)
    rng = np.random.default_rng(seed)
    scale, shift = 10**log_scale, rng.normal(size=3)
    turn = Rotation.from_rotvec(3 * rng.normal(size=3)).as_matrix()
    one = lines_of(point, direction)
    other = lines_of(scale * point @ turn.T + scale * shift, direction @ turn.T)
    place, sine = closest_places(one, everyone(8))
    moved, _ = closest_places(other, everyone(8))
    check_same(moved / scale, place @ turn.T + shift, sine, 10)
    np.testing.assert_allclose(
        line_line_distance(other, other, everyone(8)) / scale,
        line_line_distance(one, one, everyone(8)),
        atol=1e-11 / sine.min(),
    )


def slow_least_squares(lines: Lines, neighbors: torch.Tensor, weight: torch.Tensor) -> list[float]:
    """The mean of the closest points, weighted by sin^2 of the angle, pair by pair."""
    found = []
    for i, row in enumerate(neighbors.tolist()):
        moved = total = 0.0
        o, d = lines.foot[i].numpy(), lines.direction[i].numpy()
        for slot, j in enumerate(row):
            if j < 0:
                continue
            across = np.cross(d, lines.direction[j].numpy())
            sine2 = across @ across
            # The closest point of l_i to l_j, by the common perpendicular.
            t = np.cross(lines.foot[j].numpy() - o, lines.direction[j].numpy()) @ across / sine2
            moved, total = moved + float(weight[i, slot]) * sine2 * t, total + float(weight[i, slot]) * sine2
        found.append(moved / total if total else 0.0)
    return found


@given(seeds)
@few
def test_least_squares_is_the_mean_of_the_votes_by_the_sine_of_their_angle(seed):
    lines, neighbors = lines_of(*draw(seed)), everyone(8)
    weight = torch.tensor(np.random.default_rng(seed).uniform(size=neighbors.shape))
    neighbors[3, 2:5] = -1
    neighbors[4] = -1
    found = least_squares_points(lines, lines, neighbors, weight)
    np.testing.assert_allclose(found, slow_least_squares(lines, neighbors, weight), rtol=1e-8, atol=1e-10)
    assert found[4] == 0


@pytest.mark.parametrize("seed", range(3))
def test_least_squares_is_where_a_search_along_the_line_finds_them(seed):
    lines, neighbors = lines_of(*draw(seed, 6)), everyone(6)
    found = least_squares_points(lines, lines, neighbors, torch.ones(6, 5).double())
    for i in range(6):

        def off(beta: float, i: int = i) -> float:
            place = lines.foot[i].numpy() + beta * lines.direction[i].numpy()
            apart = np.cross(place, lines.direction[neighbors[i]]) - lines.moment[neighbors[i]].numpy()
            return float(np.square(apart).sum())

        least = minimize_scalar(off, bounds=(-100, 100), method="bounded", options={"xatol": 1e-10})
        assert found[i].item() == pytest.approx(least.x, abs=1e-5)  # type: ignore[attr-defined]


@given(seeds, st.floats(-3, 3))
@few
def test_least_squares_follow_a_similarity_a_slide_and_a_flip(seed, log_scale):
    point, direction = draw(seed)
    rng = np.random.default_rng(seed)
    scale, shift, sign = 10**log_scale, rng.normal(size=3), rng.choice([-1.0, 1.0], size=8)
    turn = Rotation.from_rotvec(3 * rng.normal(size=3)).as_matrix()
    slid = point + rng.normal(size=(8, 1)) * direction
    one = lines_of(point, direction)
    other = lines_of(scale * (slid @ turn.T + shift), sign[:, None] * direction @ turn.T)
    weight = torch.ones(8, 7).double()
    here, there = (lines.at(least_squares_points(lines, lines, everyone(8), weight)) for lines in (one, other))
    _, sine = closest_places(one, everyone(8))
    off = np.linalg.norm(there.numpy() / scale - shift - here.numpy() @ turn.T, axis=1)
    assert (off * np.square(sine).sum(axis=1) < 1e-10).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_least_squares_of_parallel_lines_is_the_foot(dtype):
    point, direction = draw(0, 3)
    direction[:] = direction[0]
    lines = Lines(*(part.to(dtype) for part in lines_of(point, direction)))
    assert (least_squares_points(lines, lines, everyone(3), torch.ones(3, 2, dtype=dtype)) == 0).all()
    assert (least_squares_points(lines, lines, everyone(3)[:, :0], torch.ones(3, 0, dtype=dtype)) == 0).all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_parallel_pairs_have_no_vote_and_no_distance_zero(sign, dtype):
    point, direction = draw(0, 3)
    direction[1] = sign * direction[0]
    lines = Lines(*(part.to(dtype) for part in lines_of(point, direction)))
    neighbors = torch.tensor([[1, 2], [0, 2], [0, 1]])
    votes, distance = closest_points(lines, lines, neighbors), line_line_distance(lines, lines, neighbors)
    expected = [[False, True], [False, True], [True, True]]
    assert votes.valid.tolist() == expected
    assert torch.isfinite(distance).tolist() == expected
    assert (distance > 0).all()
    assert (votes.beta[~votes.valid] == 0).all() and torch.isfinite(votes.beta).all()


def test_a_line_is_parallel_to_itself():
    lines = lines_of(*draw(0))
    own = torch.arange(8)[:, None]
    assert not closest_points(lines, lines, own).valid.any()
    assert (line_line_distance(lines, lines, own) == torch.inf).all()


@pytest.mark.parametrize(("sine", "crosses"), [(0.5 * PARALLEL, False), (2 * PARALLEL, True)])
def test_parallel_begins_at_the_named_angle(sine, crosses):
    direction = np.array([[0, 0, 1.0], [sine, 0, 1]])
    lines = lines_of(np.array([[0.0, 0, 0], [0, 1, 0]]), direction)
    other = torch.tensor([[1], [0]])
    assert closest_points(lines, lines, other).valid.all().item() is crosses
    assert torch.isfinite(line_line_distance(lines, lines, other)).all().item() is crosses


def test_a_missing_neighbour_is_no_vote():
    lines = lines_of(*draw(0, 3))
    neighbors = torch.tensor([[1, -1], [-1, -1], [0, 1]])
    expected = [[True, False], [False, False], [True, True]]
    assert closest_points(lines, lines, neighbors).valid.tolist() == expected
    assert torch.isfinite(line_line_distance(lines, lines, neighbors)).tolist() == expected
    positions = feet(lines, torch.ones(3, 3, dtype=torch.float64), neighbors)
    assert positions.valid.tolist() == expected
    assert (positions.beta[~positions.valid] == 0).all()


@pytest.mark.parametrize("count", [0, 1, 5])
def test_no_neighbours_are_no_votes(count):
    lines = lines_of(*draw(0, count))
    none = torch.zeros(count, 0, dtype=torch.int64)
    assert closest_points(lines, lines, none).beta.shape == (count, 0)
    assert line_line_distance(lines, lines, none).shape == (count, 0)
    assert feet(lines, torch.zeros(count, 3, dtype=torch.float64), none).beta.shape == (count, 0)


@given(seeds)
@few
def test_feet_are_the_nearest_places_on_the_line(seed):
    point, direction = draw(seed)
    lines = lines_of(point, direction)
    others = torch.tensor(draw(seed + 1)[0])
    beta = feet(lines, others, everyone(8)).beta
    foot = lines.foot[:, None] + beta[..., None] * lines.direction[:, None]
    apart = others[everyone(8)] - foot
    assert (apart * lines.direction[:, None]).sum(dim=2).abs().max() < 1e-12
    shape = apart.shape
    distance = point_line_distance(
        others[everyone(8)], lines.direction[:, None].expand(shape), lines.moment[:, None].expand(shape)
    )
    np.testing.assert_allclose(distance, apart.norm(dim=2), atol=1e-12)


def test_single_precision_is_enough_in_the_frame_however_far_the_scene_lies():
    rng = np.random.default_rng(0)
    point, direction = rng.uniform(-1, 1, size=(500, 3)), rng.normal(size=(500, 3))
    spacing = 0.3
    shift = 1e5 * spacing * np.array([0.6, -0.64, 0.48])
    cloud = LineCloud.through(point + shift, direction)
    frame = Frame.of(cloud)
    far, near = frame.enter(cloud), lines_of(point, direction)
    neighbors = torch.tensor(rng.integers(0, 500, size=(500, 50)))
    place, sine = closest_places(near, neighbors)
    usable = (sine > 0.05) & (np.abs(place).max(axis=2) < 3)
    beta = closest_points(far, far, neighbors).beta
    found = np.stack([cloud.at(frame.leave(cloud, column)) - shift for column in beta.T], axis=1)
    assert np.linalg.norm(found - place, axis=2)[usable].max() < 1e-3 * spacing
    gap = frame.unit * line_line_distance(far, far, neighbors) - line_line_distance(near, near, neighbors)
    assert np.abs(gap.numpy())[usable].max() < 1e-3 * spacing
