"""Schemes that choose directions by the points: what each promises, against plain loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.schemes.aimed import near_points, unit_size
from l2p.schemes.decoys import false_points
from l2p.schemes.recognition import recognise
from l2p.schemes.spread_votes import spread_directions, votes_nearby
from l2p.schemes.through_dense import dense_directions, points_along

NAMES = ("spread-votes", "decoys", "through-dense")


@pytest.fixture(scope="module")
def room() -> np.ndarray:
    return l2p.simulate("room", points=300, seed=0).xyz


def nearest_on(point: np.ndarray, direction: np.ndarray, other: np.ndarray, along: np.ndarray) -> float:
    """Signed distance from a point to where its line is nearest to another line, by least squares."""
    matrix = np.stack([direction, -along], axis=1)
    return float(np.linalg.lstsq(matrix, other - point, rcond=None)[0][0])


def test_votes_are_those_of_the_nearest_places_of_two_lines() -> None:
    rng = np.random.default_rng(0)
    point, others = rng.normal(size=(4, 3)), rng.normal(size=(4, 5, 3))
    tried, along = (each / np.linalg.norm(each, axis=2, keepdims=True) for each in rng.normal(size=(2, 4, 5, 3)))
    reach, other_reach = rng.uniform(0.1, 2, 4), rng.uniform(0.1, 2, (4, 5))
    found = votes_nearby(others - point[:, None], tried, along, reach, other_reach)
    for i in range(4):
        for c in range(5):
            votes = 0.0
            for j in range(5):
                own = nearest_on(point[i], tried[i, c], others[i, j], along[i, j])
                theirs = nearest_on(others[i, j], along[i, j], point[i], tried[i, c])
                votes += 1 / (1 + (own / reach[i]) ** 2) + 1 / (1 + (theirs / other_reach[i, j]) ** 2)
            assert found[i, c] == pytest.approx(votes)


def test_parallel_lines_do_not_vote() -> None:
    up = np.array([[[0.0, 0, 1]]])
    for apart in ([[[1.0, 2, 3]]], [[[0.0, 0, 1]]], [[[0.0, 0, 0]]]):
        assert votes_nearby(np.array(apart), up, up, np.ones(1), np.ones((1, 1))) == 0


def median_vote(xyz: np.ndarray, direction: np.ndarray) -> float:
    """Median distance of the votes of the 16 nearest points from their points, over that of the farthest of them."""
    near, distance = near_points(xyz, 16)
    votes = [
        abs(nearest_on(xyz[i], direction[i], xyz[j], direction[j])) / distance[i, -1]
        for i in range(0, len(xyz), 5)
        for j in near[i]
    ]
    return float(np.median(votes))


def test_votes_of_neighbours_fall_far_from_the_points(room: np.ndarray) -> None:
    xyz = unit_size(room)
    apart = [median_vote(xyz, spread_directions(xyz, np.random.default_rng(0), sweeps)) for sweeps in (0, 8)]
    assert apart[0] < 0.7 and apart[1] > 1.5


def test_lines_pass_through_copies_of_pieces_of_the_map(room: np.ndarray) -> None:
    count = len(room)
    false = false_points(room, np.random.default_rng(4))
    rng = np.random.default_rng(4)
    for group in np.array_split(rng.permutation(count), math.ceil(count / 50)):
        copied, one, other = rng.integers(count, size=3)
        order = sorted(range(count), key=lambda k: math.dist(room[k], room[copied]))
        for member, k in zip(group, order, strict=False):
            expected = (room[one] + room[other]) / 2 + (room[k] - room[copied]) / 2
            np.testing.assert_allclose(false[member], expected, atol=1e-12)
    hidden = l2p.hide(room, seed=4, scheme="decoys")
    rng = np.random.default_rng([4, 0x11FE])
    rng.uniform(size=room.shape)  # the shift within the lattice
    lines = hidden.map
    met = false_points(room, rng)[hidden.truth.index]
    assert np.linalg.norm(np.cross(met, lines.direction) - lines.moment, axis=1).max() < 1e-9


def test_points_along_a_line_are_counted_beyond_its_own_place() -> None:
    rng = np.random.default_rng(0)
    xyz, counted = rng.uniform(-1, 1, (3, 3)), rng.uniform(-1, 1, (200, 3))
    direction = rng.normal(size=(3, 4, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    found = points_along(xyz, direction, counted, 0.2)
    for i in range(3):
        for c in range(4):
            number = 0
            for other in counted:
                along = float((other - xyz[i]) @ direction[i, c])
                number += abs(along) > 0.6 and math.dist(other, xyz[i] + along * direction[i, c]) <= 0.2
            assert found[i, c] == number
    assert found.max() > 3


def test_lines_pass_more_points_elsewhere_than_random_ones(room: np.ndarray) -> None:
    xyz, rng = unit_size(room), np.random.default_rng(0)
    width = float(np.median(near_points(xyz, 50)[1][:, -1]))
    random = rng.normal(size=xyz.shape)
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    means = [points_along(xyz, each[:, None], xyz, width).mean() for each in (dense_directions(xyz, rng), random)]
    assert means[0] > 2 * means[1]


def test_no_line_meets_another_in_its_point(room: np.ndarray) -> None:
    for name in NAMES:
        lines, truth = (hidden := l2p.hide(room, seed=0, scheme=name)).map, hidden.truth
        for k in range(0, len(truth), 25):
            apart = np.linalg.norm(np.cross(truth.xyz[k], lines.direction) - lines.moment, axis=1)
            assert np.delete(apart, k).min() > 1e-9 * np.ptp(room)


@pytest.mark.parametrize("name", NAMES)
def test_no_probability_is_stated(name: str, room: np.ndarray) -> None:
    """Whatever the directions look like, since the file names the scheme."""
    lines = l2p.lift(room, seed=0, fraction=0.4, scheme=name)
    assert not recognise(lines).expected
    assert not l2p.recover(lines, method="tomography").calibrated


def test_lines_that_aim_need_two_places() -> None:
    for name in ("decoys", "through-dense"):
        with pytest.raises(InputError, match=rf"got 9 point\(s\) at one place for {name}; expected two different ones"):
            l2p.hide(np.full((9, 3), 2.5), seed=0, scheme=name)
    assert len(l2p.lift(np.full((9, 3), 2.5), seed=0, scheme="spread-votes")) == 9
    assert len(l2p.lift(np.ones((1, 3)), seed=0, scheme="spread-votes")) == 1
