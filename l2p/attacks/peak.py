"""The densest position among the votes along each line, by Kuiper's statistic applied recursively.

The empirical distribution function F of the votes (weighted by affinity if given) is compared with the uniform
distribution U between the lowest and the highest vote. A peak begins where F - U is least and ends where it is
greatest; the difference of the two extremes is Kuiper's statistic V. The search is repeated inside the peak until the
votes in it look uniform, V < threshold; the answer is the median of the votes left (Chelani et al., CVPR 2021,
section 4.2 and appendix).

If the spread of each vote is known, an M-estimate refines the median (:func:`settled`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

#: Difference of two statistics below which they count as equal: rounding.
_EQUAL = 1e-6


@dataclass(frozen=True)
class PeakConfig:
    """Settings of the peak search.

    Attributes
    ----------
    threshold : float
        Stop when Kuiper's statistic falls below this (0.4 in the paper's text, 0.3-0.4 in its appendix).
    minimum : int
        Stop when at most this many votes are left.
    trim : int
        Number of lowest and of highest votes that are dropped first, since near-parallel neighbours vote far outside
        the scene; fewer if less than ``minimum`` votes would be left.
    """

    threshold: float = 0.3
    minimum: int = 5
    trim: int = 5


class _Votes(NamedTuple):
    """Votes sorted along each line: ``count`` of them, then padding of weight 0."""

    beta: Float[Tensor, "lines k"]
    weight: Float[Tensor, "lines k"]
    count: Int[Tensor, " lines"]


def find_peak(
    beta: Float[Tensor, "lines k"],
    weight: Float[Tensor, "lines k"] | None = None,
    config: PeakConfig | None = None,
) -> Float[Tensor, " lines"]:
    """Find the peak of the votes of each line; return the weighted median of its votes, NaN without a valid vote.

    Parameters
    ----------
    beta : (lines, k)
        Votes, positions along the line. NaN and infinite votes count as absent.
    weight : (lines, k), optional
        Weight of each vote, at least 0; 0 is absent. Default: equal weights.

    Notes
    -----
    O(k log k) per line. A single vote is its own peak, and so are equal votes.
    """
    config = config or PeakConfig()
    weight = torch.ones_like(beta) if weight is None else weight
    votes = _trimmed(_packed(beta, weight), config)
    lines = beta.shape[0]
    first = torch.zeros(lines, dtype=torch.int64, device=beta.device)
    count = votes.count.clone()

    active = torch.nonzero(count > config.minimum).flatten()
    inner = _slice(votes, active, first[active], count[active])
    while len(active):
        low, high, value = _interval(inner)
        length = high - low + 1
        # The interval is used even if its statistic ends the search, as in the published code.
        again = (value >= config.threshold) & (length > config.minimum) & (length < inner.count)
        first[active] += low
        count[active] = length
        rows = torch.nonzero(again).flatten()
        active, low, length = active[again], low[again], length[again]
        inner = _slice(inner, rows, low, length)
    return _median(votes, first, count)


def settled(
    beta: Float[Tensor, " lines"],
    place: Float[Tensor, "lines k"],
    weight: Float[Tensor, "lines k"],
    spread: Float[Tensor, "lines k"],
    steps: int,
) -> Float[Tensor, " lines"]:
    """Refine peaks by an M-estimate of location, for votes with Cauchy errors of scale ``spread``.

    Minimises sum_k w_k log(1 + ((beta - p_k) / s_k)^2), starting at the peak, by iteratively reweighted least squares
    (Holland and Welsch, Communications in Statistics 6, 1977). Votes of other peaks have little weight.

    Parameters
    ----------
    beta : (lines,)
        Peaks, positions along the line.
    place, weight, spread : (lines, k)
        Votes, at least one per line with ``weight`` above 0, and their scales, above 0.
    steps : int
        Number of reweightings.
    """
    variance = spread.square()
    for _ in range(steps):
        away = place - beta[:, None]
        pull = weight / (variance + away.square())
        beta = beta + torch.linalg.vecdot(pull, away) / pull.sum(dim=1)
    return beta


def _packed(beta: Float[Tensor, "lines k"], weight: Float[Tensor, "lines k"]) -> _Votes:
    """Sort the votes; absent ones go to the end."""
    absent = ~torch.isfinite(beta) | ~(weight > 0)
    beta = beta.masked_fill(absent, torch.inf)
    order = _order(beta)
    weight = torch.gather(weight.masked_fill(absent, 0), 1, order)
    return _Votes(torch.gather(beta, 1, order), weight, (~absent).sum(dim=1))


def _order(beta: Float[Tensor, "lines k"]) -> Int[Tensor, "lines k"]:
    """Indices that sort the votes of each line; equal votes in any order."""
    if beta.device.type != "cpu":
        return beta.argsort(dim=1)
    # NumPy sorts with vector instructions, several times faster than torch.
    return torch.from_numpy(np.argsort(beta.detach().numpy(), axis=1))


def _trimmed(votes: _Votes, config: PeakConfig) -> _Votes:
    """Drop the lowest and the highest votes."""
    if config.trim == 0:
        return votes
    trim = ((votes.count - config.minimum) // 2).clamp(0, config.trim)
    rows = torch.arange(len(votes.count), device=votes.count.device)
    return _slice(votes, rows, trim, votes.count - 2 * trim)


def _slice(
    votes: _Votes, rows: Int[Tensor, " some"], first: Int[Tensor, " some"], count: Int[Tensor, " some"]
) -> _Votes:
    """Votes first ... first + count - 1 of the lines ``rows``, with the least padding."""
    width = int(count.max()) if len(count) else 0
    position = torch.arange(width, device=count.device)
    absent = position >= count[:, None]
    index = (first[:, None] + position).clamp_max_(max(votes.beta.shape[1] - 1, 0))
    beta, weight = votes.beta, votes.weight
    if len(rows) < len(beta):
        beta, weight = beta.index_select(0, rows), weight.index_select(0, rows)
    beta, weight = torch.gather(beta, 1, index), torch.gather(weight, 1, index)
    return _Votes(beta.masked_fill_(absent, torch.inf), weight.masked_fill_(absent, 0), count)


def _interval(votes: _Votes) -> tuple[Int[Tensor, " lines"], Int[Tensor, " lines"], Float[Tensor, " lines"]]:
    """First and last vote of the peak of each line, and its Kuiper statistic."""
    absent = torch.arange(votes.beta.shape[1], device=votes.beta.device) >= votes.count[:, None]
    last = votes.count[:, None] - 1
    start, end = votes.beta[:, :1], torch.gather(votes.beta, 1, last)
    span = end - start
    uniform = ((votes.beta - start) / span.clamp_min(torch.finfo(votes.beta.dtype).tiny)).masked_fill_(absent, 1)
    cumulative = votes.weight.cumsum(dim=1)
    total = torch.gather(cumulative, 1, last)
    after = cumulative / total - uniform
    before = (cumulative - votes.weight) / total - uniform
    before, after = before.masked_fill_(absent, torch.inf), after.masked_fill_(absent, -torch.inf)
    low, high, value = _best_segment(before, after)
    # If all votes are equal, F - U has no meaning.
    return low, high, value.masked_fill(span[:, 0] <= 0, 0).clamp(0, 1)


def _best_segment(
    before: Float[Tensor, "lines k"], after: Float[Tensor, "lines k"]
) -> tuple[Int[Tensor, " lines"], Int[Tensor, " lines"], Float[Tensor, " lines"]]:
    """Cut the line where U overtakes F between two votes; the segment of greatest statistic is the peak."""
    cut = (after[:, :-1] > 0) & (before[:, 1:] <= 0)
    segment = torch.nn.functional.pad(cut.cumsum(dim=1), (1, 0))
    segments = int(segment.max()) + 1
    shape = (before.shape[0], segments)
    lowest = before.new_full(shape, torch.inf).scatter_reduce(1, segment, before, "amin")
    highest = before.new_full(shape, -torch.inf).scatter_reduce(1, segment, after, "amax")
    value = highest - lowest
    greatest = value.amax(dim=1)
    # Evenly spaced votes give one-vote segments of equal statistic: the interval spans all the best segments, so that
    # it does not depend on the sign of the line.
    best = torch.gather(value >= greatest[:, None] - _EQUAL, 1, segment)
    starts = best & (before == torch.gather(lowest, 1, segment))
    ends = best & (after == torch.gather(highest, 1, segment))
    low, last = starts.int().argmax(dim=1), ends.flip(1).int().argmax(dim=1)
    return low, before.shape[1] - 1 - last, greatest


def _median(votes: _Votes, first: Int[Tensor, " lines"], count: Int[Tensor, " lines"]) -> Float[Tensor, " lines"]:
    """Weighted median of each line's interval; the mean of the two middle votes in case of a tie."""
    everything = torch.arange(len(count), device=count.device)
    inner = _slice(votes, everything, first, count)
    if inner.beta.shape[1] == 0:
        return inner.beta.new_full((len(count),), torch.nan)
    cumulative = inner.weight.cumsum(dim=1)
    last = (count - 1).clamp_min(0)[:, None]
    half = torch.gather(cumulative, 1, last) / 2
    middle = torch.minimum((cumulative < half).sum(dim=1, keepdim=True), last)
    upper = torch.minimum((cumulative <= half).sum(dim=1, keepdim=True), last)
    beta = (torch.gather(inner.beta, 1, middle) + torch.gather(inner.beta, 1, upper))[:, 0] / 2
    return beta.masked_fill(count == 0, torch.nan)
