"""The facts that the attack rests on, as Chelani et al. (CVPR 2021) state them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from l2p.attacks.run import run
from l2p.geometry.elements import Lines
from l2p.geometry.pairs import closest_points, line_line_distance
from l2p.judging.accuracy import errors, spacing
from l2p.judging.references import Oracle
from l2p.schemes.hide import hide

DRAWS = 1_000_000


@pytest.fixture(scope="module")
def pairs() -> tuple[Lines, Lines, torch.Tensor]:
    """A million pairs of lines of random direction: the first through zero, the other through a point 1 away."""
    generator = torch.Generator().manual_seed(0)

    def unit() -> torch.Tensor:
        drawn = torch.randn(DRAWS, 3, generator=generator, dtype=torch.float64)
        return drawn / drawn.norm(dim=1, keepdim=True)

    first = Lines(unit(), torch.zeros(DRAWS, 3, dtype=torch.float64))
    neighbor, direction = unit(), unit()
    second = Lines(direction, torch.linalg.cross(neighbor, direction))
    return first, second, torch.arange(DRAWS)[:, None]


def test_the_closest_point_is_nearer_than_the_neighbour_in_four_of_five_draws(pairs):
    votes = closest_points(*pairs)
    # The first point is at position 0 of its line and its neighbour at distance 1. The exact share is pi / 4.
    nearer = (votes.valid & (votes.beta.abs() < 1)).double().mean().item()
    assert nearer == pytest.approx(0.785, abs=0.003)


def test_the_line_line_distance_of_neighbours_is_uniform_up_to_their_distance(pairs):
    distance = line_line_distance(*pairs)[:, 0]
    distance = distance[torch.isfinite(distance)].numpy()
    assert len(distance) > 0.9999 * DRAWS
    assert kstest(distance, "uniform").statistic < 0.003


@pytest.fixture(scope="module")
def room(on_walls) -> np.ndarray:
    return on_walls(4000)


def oracle_errors(points: np.ndarray, k: int, outliers: float = 0.0) -> np.ndarray:
    """Errors in spacings."""
    hidden = hide(points, seed=1)
    lines, index = hidden.map, hidden.truth.index
    truth = points[index]
    return errors(run(lines, Oracle(truth, k, outliers)).xyz, truth) / spacing(points)


def test_fewer_true_neighbours_are_more_accurate(room):
    median = [np.median(oracle_errors(room, k)) for k in (10, 25, 50, 100)]
    assert median == sorted(median)
    assert median[0] < 0.15 and median[2] < 0.25
    assert median[3] > 1.5 * median[0]


def test_half_of_the_neighbours_may_be_wrong_but_not_nine_of_ten(room):
    none, half, most = (oracle_errors(room, 50, outliers) for outliers in (0.0, 0.5, 0.9))
    assert (none < 1).mean() > 0.9
    assert (half < 1).mean() > 0.8 and np.median(half) < 2 * np.median(none)
    assert (most < 1).mean() < 0.6 and np.median(most) > 3 * np.median(none)
