"""Meetings: which line of another release passes through the same point, by geometry alone.

A map that is published twice, with fresh directions each time, has two lines through each point. They meet there up to
the noise of the coordinates, while lines of different points meet that closely only by accident. Nobody tells which
lines belong together; the distances do. The steps:

1. Candidates: the lines nearest to each line, exactly (:mod:`l2p.geometry.closest_lines`). Accidental meetings have a
   constant density in the distance, which the farther candidates give for each line.
2. A pair is of one point or an accident. The density of the distance in pairs of one point, the *noise*, falls with the
   distance; it is estimated from the meetings themselves (expectation maximisation on bins, Dempster et al. 1977).
3. A line has at most one partner in a release. The probability of each pair under all such assignments is computed by
   belief propagation on the candidates (Bayati, Shah and Sharma, IEEE Trans. Inf. Theory 2008; the weights are those of
   the monomer-dimer model), exact where the candidates form no circles.
4. Where several lines meet within the noise, the place decides: meetings of one point lie where others do. The ratio of
   both densities of the distance to other meetings is measured on the clear pairs, and multiplied.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l2p.geometry.closest_lines import nearest_lines
from l2p.geometry.elements import Lines

#: Candidates of a line.
_NEAREST = 16
#: Bins of the distance: halves of an octave, from below all rounding of double precision, in units of the frame.
_FINEST, _COARSEST, _OCTAVES_PER_BIN = 2.0**-44, 4.0, 0.5
#: Standard deviations of the number of accidents by which a bin must exceed it to be noise of common points.
_SIGNIFICANT = 4.0
#: Times that the place of other meetings is measured.
_PLACES = 4
#: Passes of belief propagation, and the share of the old message that each keeps.
_PASSES, _KEPT = 24, 0.4
#: Largest odds of one pair.
_MOST = 1e9
#: Pairs of at least this probability are the places of meetings.
_CLEAR = 0.5
#: Bins of the distance to other meetings, which of these is measured, the fewest from which it is learned, and the most
#: accidents among which it is measured.
_PLACE_BINS, _OTHERS, _FEWEST, _ACCIDENTS = 16, 3, 50, 20_000


class Meetings(NamedTuple):
    """The best partner of each line.

    ``partner`` is the row of the other line, -1 without a candidate. ``beta`` is the position on the line where the
    two come closest, ``sine`` that of their angle, ``distance`` how close. ``probability`` is that of one common point.
    """

    partner: Int[np.ndarray, " lines"]
    beta: Float[np.ndarray, " lines"]
    distance: Float[np.ndarray, " lines"]
    sine: Float[np.ndarray, " lines"]
    probability: Float[np.ndarray, " lines"]


class _Pairs(NamedTuple):
    """Candidates: rows of the two lines, how close they come, where, and the density of accidents at distance 0."""

    row: Int[np.ndarray, " pairs"]
    other: Int[np.ndarray, " pairs"]
    distance: Float[np.ndarray, " pairs"]
    beta: Float[np.ndarray, " pairs"]
    other_beta: Float[np.ndarray, " pairs"]
    sine: Float[np.ndarray, " pairs"]
    point: Float[np.ndarray, "pairs 3"]
    accidents: Float[np.ndarray, " pairs"]
    #: Number of the two nodes of each pair, of this many, and of lines on either side.
    nodes: tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"], int]
    sides: tuple[int, int]

    def some(self, rows: Bool[np.ndarray, " pairs"]) -> _Pairs:
        columns = [column[rows] for column in self[:8]]
        first, second, count = self.nodes
        return _Pairs(*columns, (first[rows], second[rows], count), self.sides)


def meetings(lines: Lines, others: Lines | None = None, *, room: int | None = None) -> Meetings:
    """Find the line of another release that shares its point with each line.

    Parameters
    ----------
    lines : Lines
        In double precision, in a frame whose unit is about the size of the scene.
    others : Lines, optional
        The other release, in the same frame; None: the partner is sought among the lines themselves, of which some
        are a second release.
    room : int, optional
        Bytes for the temporaries of the search.
    """
    count = len(lines.direction)
    pairs, tables = _candidates(lines, others, room)
    noise = _noise(tables, pairs.nodes[2] == count)
    near = noise.near(pairs.distance)
    if not near.any():
        nothing = np.zeros(count)
        return Meetings(np.full(count, -1), nothing, nothing + np.inf, nothing + 1, nothing)
    probability = _probabilities(pairs.some(near), noise, _accident_points(pairs, ~near))
    pairs = pairs.some(near)
    if others is None:
        pairs, probability = _both_ways(pairs), np.tile(probability, 2)
    return _best(pairs, probability, count)


class _Noise(NamedTuple):
    """Pairs of a common point: how many, with what standard deviation, and their density in bins of the distance."""

    pairs: float
    deviation: float
    edges: Float[np.ndarray, " bins"]
    density: Float[np.ndarray, " bins"]

    def of(self, distance: Float[np.ndarray, " pairs"]) -> Float[np.ndarray, " pairs"]:
        return self.density[np.searchsorted(self.edges, distance).clip(max=len(self.density) - 1)]

    def near(self, distance: Float[np.ndarray, " pairs"]) -> Bool[np.ndarray, " pairs"]:
        return self.of(distance) > 0


def _noise(tables: list[Float[np.ndarray, "lines k"]], within: bool) -> _Noise:
    """Estimate the noise from the distances of the nearest lines, by what exceeds the accidents.

    Accidents are spread evenly over the distance: given that of the farthest, the others are uniform below it.
    """
    edges = np.exp2(np.arange(np.log2(_FINEST), np.log2(_COARSEST) + 1e-9, _OCTAVES_PER_BIN))
    found, even, lines = np.zeros(len(edges)), np.zeros(len(edges)), 0
    partners = 0.0
    usable = [table[np.isfinite(table).all(axis=1)] for table in tables if table.shape[1] > 2]
    for table in usable:
        last = np.maximum(table[:, -1], _FINEST)
        found += np.bincount(np.searchsorted(edges, table[:, :-1].ravel()).clip(max=len(edges) - 1), minlength=len(edges))
        below = np.minimum(edges[:, None] / np.sort(last), 1).sum(axis=1)
        even += np.diff(below, prepend=0.0)
        lines += len(table)
    others = max((table.shape[1] - 1 for table in usable), default=0)
    for _ in range(20):
        accidents = even * (others - partners)
        excess = found - accidents
        significant = np.flatnonzero(excess > _SIGNIFICANT * np.sqrt(accidents) + _SIGNIFICANT)
        last = significant[-1] + 1 if len(significant) else 0
        met = excess[:last].sum()
        partners = min(1.0, met / max(lines, 1))
    widths = np.diff(edges, prepend=0.0)
    share = np.where(np.arange(len(edges)) < last, np.maximum(excess, 0) + 1e-3, 0)
    directions = 2 if within or len(tables) == 2 else 1
    pairs = max(met, 0.0) / directions
    deviation = np.sqrt(accidents[:last].sum()) / directions
    return _Noise(pairs, deviation, edges, _falling(share / max(share.sum(), 1e-300), widths))


def _candidates(lines: Lines, others: Lines | None, room: int | None) -> tuple[_Pairs, list]:
    """Pairs of lines of which one is among the nearest of the other, and the distances of these nearest."""
    within = others is None
    second = lines if others is None else others
    counts = len(lines.direction), len(second.direction)
    near = nearest_lines(lines, second, _NEAREST, itself=not within, room=room)
    back = near if within else nearest_lines(second, lines, _NEAREST, room=room)
    rates = [_rate(each.distance) for each in (near, back)]
    keys = [
        _key(torch.arange(counts[0])[:, None], near.index, counts[1])[near.distance.isfinite()],
        _key(back.index, torch.arange(counts[1])[:, None], counts[1])[back.distance.isfinite()],
    ]
    key = torch.cat(keys).unique()
    row, other = key // counts[1], key % counts[1]
    if within:
        row, other = row[row < other], other[row < other]
    pairs = _Pairs(
        *_measured(lines.rows(row), second.rows(other), row, other), *_shared(rates, row, other, counts, within)
    )
    return pairs, [near.distance.numpy()] if within else [near.distance.numpy(), back.distance.numpy()]


def _key(row: Int[Tensor, "..."], other: Int[Tensor, "..."], count: int) -> Int[Tensor, "..."]:
    return row * count + other


def _rate(distance: Float[Tensor, "lines k"]) -> Float[np.ndarray, " lines"]:
    """Accidental meetings of each line per unit of distance; the nearest line may be its partner."""
    found = distance.isfinite().sum(dim=1)
    last = distance.gather(1, (found - 1).clamp_min(0)[:, None])[:, 0]
    rate = (found - 1.5).clamp_min(0.5) / last.clamp_min(_FINEST)
    return torch.where(found > 0, rate, 0.0).numpy()


def _shared(
    rates: list[Float[np.ndarray, " lines"]],
    row: Int[Tensor, " pairs"],
    other: Int[Tensor, " pairs"],
    counts: tuple[int, int],
    within: bool,
) -> tuple:
    """Density of accidents of each pair at distance 0, in proportion to both rates; the nodes; the lines."""
    first, second = rates
    total = np.sqrt(first.sum() * second.sum())
    node = other.numpy() if within else counts[0] + other.numpy()
    size = counts[0] if within else sum(counts)
    return first[row.numpy()] * second[other.numpy()] / total, (row.numpy(), node, size), counts


def _measured(first: Lines, second: Lines, row: Int[Tensor, " pairs"], other: Int[Tensor, " pairs"]) -> tuple:
    """Distance of the pairs, where they come closest, and the sine of the angle."""
    cosine = (first.direction * second.direction).sum(dim=1)
    sine2 = torch.linalg.cross(first.direction, second.direction).square().sum(dim=1)
    foot, other_foot = first.foot, second.foot
    ahead = (other_foot * first.direction).sum(dim=1)
    back = (foot * second.direction).sum(dim=1)
    beta, other_beta = (ahead + cosine * back) / sine2, (back + cosine * ahead) / sine2
    reciprocal = (first.direction * second.moment).sum(dim=1) + (first.moment * second.direction).sum(dim=1)
    sine = sine2.sqrt()
    point = (first.at(beta) + second.at(other_beta)) / 2
    columns = (row, other, reciprocal.abs() / sine, beta, other_beta, sine, point)
    return tuple(column.numpy() for column in columns)


def _accident_points(pairs: _Pairs, rows: Bool[np.ndarray, " pairs"]) -> Float[np.ndarray, "some 3"]:
    """Where some pairs come closest that are surely accidents."""
    points = pairs.point[rows]
    return points[:: max(1, len(points) // _ACCIDENTS)]


def _probabilities(
    pairs: _Pairs, noise: _Noise, accidents: Float[np.ndarray, "some 3"]
) -> Float[np.ndarray, " pairs"]:
    """Probability that each pair has a common point."""
    odds = _activity(noise, pairs) * noise.of(pairs.distance) / np.maximum(pairs.accidents, 1e-300)
    probability = _matched(odds, pairs)
    for _ in range(_PLACES):
        probability = _matched(odds * _placed(pairs, probability, accidents), pairs)
    return probability


def _activity(noise: _Noise, pairs: _Pairs) -> float:
    """Odds of a pair before anything is measured: matched pairs over pairs of unmatched lines."""
    first, second = pairs.sides
    if pairs.nodes[2] == first:  # within one cloud, a pair takes two of its lines
        return 2 * noise.pairs / (max(first - 2 * noise.pairs, 0.0) + 1 + noise.deviation) ** 2
    free = [max(lines - noise.pairs, 0.0) + 1 + noise.deviation for lines in (first, second)]
    return noise.pairs / (free[0] * free[1])


def _falling(share: Float[np.ndarray, " bins"], widths: Float[np.ndarray, " bins"]) -> Float[np.ndarray, " bins"]:
    """Density in each bin of the falling density nearest to these shares: adjacent violators are pooled."""
    pooled: list[list[float]] = []
    for mass, width in zip(share, widths, strict=True):
        pooled.append([mass, width, 1])
        while len(pooled) > 1 and pooled[-1][0] * pooled[-2][1] > pooled[-2][0] * pooled[-1][1]:
            last = pooled.pop()
            pooled[-1] = [a + b for a, b in zip(pooled[-1], last, strict=True)]
    return np.repeat([mass / width for mass, width, _ in pooled], [int(many) for *_, many in pooled])


def _matched(odds: Float[np.ndarray, " pairs"], pairs: _Pairs) -> Float[np.ndarray, " pairs"]:
    """Probability of each pair, if every line has at most one partner."""
    first, second, count = pairs.nodes
    odds = np.minimum(odds, _MOST)
    free, other_free = np.ones(len(odds)), np.ones(len(odds))
    for _ in range(_PASSES):
        to_first, to_second = odds * other_free, odds * free
        total = np.bincount(first, to_first, count) + np.bincount(second, to_second, count)
        # That a line is free, as far as its other candidates tell.
        new = 1 / (1 + np.maximum(total[first] - to_first, 0))
        other_new = 1 / (1 + np.maximum(total[second] - to_second, 0))
        free, other_free = _KEPT * free + (1 - _KEPT) * new, _KEPT * other_free + (1 - _KEPT) * other_new
    joint = odds * free * other_free
    return joint / (1 + joint)


def _placed(
    pairs: _Pairs, probability: Float[np.ndarray, " pairs"], accidents: Float[np.ndarray, "some 3"]
) -> Float[np.ndarray, " pairs"]:
    """Ratio of the densities, in common points and in accidents, of how near other clear meetings are to each pair."""
    from scipy.spatial import KDTree

    clear = np.flatnonzero(probability >= _CLEAR)
    if len(clear) < _FEWEST:
        return np.ones(len(probability))
    tree = KDTree(pairs.point[clear])
    found, index = tree.query(pairs.point, _OTHERS + 2)
    met = clear[index]
    own = (pairs.nodes[0][met] == pairs.nodes[0][:, None]) | (pairs.nodes[1][met] == pairs.nodes[1][:, None])
    found = np.sort(np.where(own, np.inf, found), axis=1)[:, _OTHERS - 1]
    known = found[clear][np.isfinite(found[clear])]
    cuts = np.quantile(known, np.linspace(0, 1, _PLACE_BINS + 1)[1:])
    cuts = np.unique(np.concatenate([cuts, cuts[-1] * 2.0 ** np.arange(1, 5)]))
    bins = np.searchsorted(cuts, found)
    true, false = (np.bincount(bins, part, len(cuts) + 1) + 0.5 for part in (probability, 1 - probability))
    if len(accidents):
        far = tree.query(accidents, [_OTHERS])[0][:, 0]
        false += np.bincount(np.searchsorted(cuts, far), minlength=len(cuts) + 1)
    return _falling(true / true.sum(), false / false.sum())[bins]


def _both_ways(pairs: _Pairs) -> _Pairs:
    """The pairs of one cloud, each also from its second line."""
    columns = [np.concatenate(both) for both in zip(pairs[:8], _swapped(pairs), strict=True)]
    return _Pairs(*columns, pairs.nodes, pairs.sides)


def _swapped(pairs: _Pairs) -> tuple:
    return (pairs.other, pairs.row, pairs.distance, pairs.other_beta, pairs.beta, *pairs[5:8])


def _best(pairs: _Pairs, probability: Float[np.ndarray, " pairs"], count: int) -> Meetings:
    """The most probable partner of each line."""
    order = np.lexsort([-pairs.distance, probability])
    best = np.full(count, -1)
    best[pairs.row[order]] = order
    none = best < 0
    return Meetings(
        np.where(none, -1, pairs.other[best]),
        np.where(none, 0.0, pairs.beta[best]),
        np.where(none, np.inf, pairs.distance[best]),
        np.where(none, 1.0, pairs.sine[best]),
        np.where(none, 0.0, probability[best]),
    )
