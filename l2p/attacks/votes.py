"""Votes of neighbours: the closest points of lines, their peak, and its support."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l2p.attacks.attack import Estimate
from l2p.attacks.peak import PeakConfig, find_peak
from l2p.geometry.elements import Lines
from l2p.geometry.pairs import closest_points, least_squares_points
from l2p.work.work import ALONE, Work

#: Most votes per block of the peak search, and bytes of temporaries per vote.
VOTES, _VOTE_BYTES = 1 << 21, 60


def vote(
    lines: Lines,
    neighbors: Int[Tensor, "own k"],
    affinity: Float[Tensor, "own k"] | None = None,
    peak: PeakConfig | None = None,
    work: Work = ALONE,
) -> Estimate:
    """Estimate the point of each line by the peak of its closest points to the neighbours.

    The confidence is the support of the peak. Affinities weight the votes; without them all weights are equal.
    """
    weight = equal_weights(lines, neighbors) if affinity is None else affinity
    beta = peaks(lines, neighbors, weight, peak, work)
    return Estimate(beta, support(lines, neighbors, weight, beta, work), neighbors, weight)


def equal_weights(lines: Lines, neighbors: Int[Tensor, "own k"]) -> Float[Tensor, "own k"]:
    """Weight 1 for each neighbour, 0 where there is none."""
    return (neighbors >= 0).to(lines.direction.dtype)


def peaks(
    lines: Lines,
    neighbors: Int[Tensor, "own k"],
    affinity: Float[Tensor, "own k"],
    peak: PeakConfig | None = None,
    work: Work = ALONE,
) -> Float[Tensor, " own"]:
    """Find the peak of the neighbours' votes on each line, in blocks; 0, the foot, where there is no vote."""
    own = lines.rows(work.own(len(lines.direction)))
    beta = lines.direction.new_zeros(len(neighbors))
    with work.task("peaks of the votes", total=len(neighbors)) as advance:
        for here in _blocks(neighbors, work):
            votes = closest_points(own.rows(here), lines, neighbors[here])
            beta[here] = find_peak(votes.beta, affinity[here] * votes.valid, peak).nan_to_num(nan=0.0)
            advance(here.stop - here.start)
    return beta


def least_squares(lines: Lines, neighbors: Int[Tensor, "own k"], work: Work = ALONE) -> Estimate:
    """Estimate the point of each line by its least squared distance to the neighbours' lines, all of equal weight.

    The rule of Chelani et al. (3DV 2025); unlike :func:`vote`, it does not suppress outliers. The confidence is the
    support of the point.
    """
    own, weight = lines.rows(work.own(len(lines.direction))), equal_weights(lines, neighbors)
    beta = lines.direction.new_zeros(len(neighbors))
    with work.task("least squares of the votes", total=len(neighbors)) as advance:
        for here in _blocks(neighbors, work):
            beta[here] = least_squares_points(own.rows(here), lines, neighbors[here], weight[here])
            advance(here.stop - here.start)
    return Estimate(beta, support(lines, neighbors, weight, beta, work), neighbors, weight)


def support(
    lines: Lines,
    neighbors: Int[Tensor, "own k"],
    affinity: Float[Tensor, "own k"],
    beta: Float[Tensor, " own"],
    work: Work = ALONE,
) -> Float[Tensor, " own"]:
    """Fraction of a line's possible votes that are near the estimate, in [0, 1].

    Near is within the median, over the lines, of the median distance of a line's votes from its estimate. The support
    ranks lines (column ``confidence_auc`` of ``python -m eval``); Kuiper's statistic does not: it separates sharp
    peaks, right or wrong, from blunt ones.
    """
    own = lines.rows(work.own(len(lines.direction)))
    distance = lines.direction.new_full((len(neighbors),), torch.nan)
    near = torch.zeros_like(distance)
    for here in _blocks(neighbors, work):
        distance[here] = _apart(own, lines, neighbors, affinity, beta, here).nanmedian(dim=1).values
    radius = work.gather(distance, len(lines.direction)).nanmedian()
    for here in _blocks(neighbors, work):
        inside = _apart(own, lines, neighbors, affinity, beta, here) <= radius
        near[here] = (affinity[here] * inside).sum(dim=1)
    return (near / max(neighbors.shape[1], 1)).clamp(0, 1)


def _apart(
    own: Lines,
    lines: Lines,
    neighbors: Int[Tensor, "own k"],
    affinity: Float[Tensor, "own k"],
    beta: Float[Tensor, " own"],
    rows: slice,
) -> Float[Tensor, "rows k"]:
    """Distance of each vote from the estimate, NaN where there is no vote."""
    votes = closest_points(own.rows(rows), lines, neighbors[rows])
    apart = (votes.beta - beta[rows, None]).abs()
    return apart.masked_fill(~votes.valid | (affinity[rows] <= 0), torch.nan)


def _blocks(neighbors: Int[Tensor, "lines k"], work: Work) -> list[slice]:
    """Slices of lines, each with at most about ``VOTES`` votes."""
    count, k = neighbors.shape
    rows = max(1, work.fitting(VOTES, _VOTE_BYTES) // max(k, 1))
    return [slice(begin, min(begin + rows, count)) for begin in range(0, count if k else 0, rows)]


def member(values: Int[Tensor, "lines k"], sets: Int[Tensor, "lines m"]) -> Bool[Tensor, "lines k"]:
    """Test whether each value of a line is in its set; -1 is in none."""
    if sets.shape[1] == 0:
        return torch.zeros_like(values, dtype=torch.bool)
    ordered = sets.sort(dim=1).values
    place = torch.searchsorted(ordered, values).clamp_max(sets.shape[1] - 1)
    return (torch.gather(ordered, 1, place) == values) & (values >= 0)
