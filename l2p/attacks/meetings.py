"""Meetings: which line of another release passes through the same point.

A map that is published twice, with fresh directions each time, has two lines through each point. They meet there up to
the noise of the coordinates, while lines of different points meet that closely only by accident. Nobody tells which
lines belong together; the distances do:

1. Candidates: the lines nearest to each line, exactly (:mod:`l2p.geometry.closest_lines`). Accidental meetings are
   spread evenly over the distance, at a rate that the farther candidates of each line give.
2. What exceeds the accidents are pairs of one point: how many there are, and the density of their distance, the
   *noise*, which falls with the distance.
3. A line has at most one partner in a release. The probability of each pair under all such assignments is computed by
   belief propagation among the candidates, whose weights are those of the monomer-dimer model (Zdeborova and Mezard,
   J. Stat. Mech. 2006): exact where the candidates form no circles.
4. Where several lines meet within the noise, the place decides: pairs of one point lie where others do. The ratio of
   the densities of the distance to other meetings, of one point over accidents, is measured on the pairs themselves,
   and so is that of equal descriptors, where both releases have them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from l2p.geometry.closest_lines import NearestLines, nearest_lines
from l2p.geometry.elements import Lines

#: Candidates of a line.
NEAREST = 16
#: Bins of the distance: halves of an octave, from below all rounding of double precision, in units of the frame.
_FINEST, _COARSEST, _OCTAVES_PER_BIN = 2.0**-44, 4.0, 0.5
#: Standard deviations of the number of accidents by which a bin must exceed it to be noise, and pairs besides.
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
    """Pairs of lines that may have a common point, sorted by the row of the first line.

    Attributes
    ----------
    row, other : (pairs,) int64
        Rows of both lines.
    beta : (pairs,) float64
        Position on the first line where the two come closest.
    distance : (pairs,) float64
        How close that is.
    probability : (pairs,) float64
        Of a common point; those of one line sum to at most 1.
    """

    row: Int[np.ndarray, " pairs"]
    other: Int[np.ndarray, " pairs"]
    beta: Float[np.ndarray, " pairs"]
    distance: Float[np.ndarray, " pairs"]
    probability: Float[np.ndarray, " pairs"]

    def best(self, lines: int) -> Int[np.ndarray, " lines"]:
        """Number of the most probable pair of each of so many lines; -1 for none."""
        order = np.lexsort([-self.distance, self.probability])
        best = np.full(lines, -1)
        best[self.row[order]] = order
        return best


def meetings(
    lines: Lines,
    others: Lines | None = None,
    descriptors: tuple[np.ndarray, np.ndarray] | None = None,
) -> Meetings:
    """Find the lines of another release that may share their point with each line.

    Parameters
    ----------
    lines : Lines
        In double precision, in a frame whose unit is about the size of the scene.
    others : Lines, optional
        The other release, in the same frame; None: partners are sought among the lines themselves, some of which are a
        second release.
    descriptors : pair of (lines, length) arrays, optional
        Descriptors of both, of one type and length: an equal one tells the partner, if it also meets.
    """
    within = others is None
    second = lines if others is None else others
    near = nearest_lines(lines, second, NEAREST, itself=not within)
    tables = [near] if within else [near, nearest_lines(second, lines, NEAREST)]
    joined = _joined(descriptors, within)
    estimates = (
        _noise([table.distance.numpy() for table in tables]),
        _told_noise(lines.rows(torch.as_tensor(joined[0])), second.rows(torch.as_tensor(joined[1])), tables),
    )
    noise = max(estimates, key=lambda each: each.pairs)
    pairs, accidents = _candidates(lines, second, tables, noise, joined)
    probability = _probabilities(pairs, noise, estimates[1].pairs, accidents)
    if within:
        columns = (pairs.row, pairs.other), (pairs.other, pairs.row), (pairs.beta, pairs.other_beta)
        row, other, beta = (np.concatenate(column) for column in columns)
        distance, probability = np.tile(pairs.distance, 2), np.tile(probability, 2)
    else:
        row, other, beta, distance = pairs.row, pairs.other, pairs.beta, pairs.distance
    order = np.lexsort([other, row])
    return Meetings(*(column[order] for column in (row, other, beta, distance, probability)))


class _Noise(NamedTuple):
    """Pairs of one point: how many, with what standard deviation, and their density in bins of the distance."""

    pairs: float
    deviation: float
    edges: Float[np.ndarray, " bins"]
    density: Float[np.ndarray, " bins"]

    def of(self, distance: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Density at each distance; 0 beyond the noise."""
        return self.density[np.searchsorted(self.edges, distance).clip(max=len(self.density) - 1)]


def _noise(tables: list[np.ndarray]) -> _Noise:
    """Estimate the noise from the distances of the nearest lines, (lines, k) of each release.

    Given the distance of the farthest, the nearer accidents of a line are uniform below it.
    """
    edges = _edges()
    found, even, rows, others = np.zeros(len(edges)), np.zeros(len(edges)), 0, 0
    for table in tables:
        full = table[np.isfinite(table).all(axis=1)]
        if full.shape[1] < 3:  # a rate needs accidents beside the partner
            continue
        bins = np.searchsorted(edges, full[:, :-1].ravel()).clip(max=len(edges) - 1)
        found += np.bincount(bins, minlength=len(edges))
        even += np.diff(_uniform_below(np.maximum(full[:, -1], _FINEST), edges), prepend=0.0) * (full.shape[1] - 1)
        rows, others = rows + len(full), max(others, full.shape[1] - 1)
    noise = _Noise(0.0, 0.0, edges, np.zeros(len(edges)))
    for _ in range(20):  # the lines that have a partner have an accident less
        noise = _excess(found, even * (1 - noise.pairs / max(rows * others, 1)), rows, edges)
    # Each pair was counted from both of its lines.
    return noise._replace(pairs=noise.pairs / 2, deviation=noise.deviation / 2)


def _told_noise(lines: Lines, others: Lines, tables: list[NearestLines]) -> _Noise:
    """Estimate the noise from pairs that equal descriptors tell."""
    edges = _edges()
    found = np.bincount(
        np.searchsorted(edges, _measured(lines, others)[0].numpy()).clip(max=len(edges) - 1), minlength=len(edges)
    )
    told, all_pairs = len(lines.direction), len(tables[0].index) * len(tables[-1].index)
    rate = float(_rate(tables[0].distance).sum()) / all_pairs
    return _excess(found, told * rate * np.diff(edges, prepend=0.0), told, edges)


def _excess(
    found: Shaped[np.ndarray, " bins"],
    accidents: Float[np.ndarray, " bins"],
    most: int,
    edges: Float[np.ndarray, " bins"],
) -> _Noise:
    """What exceeds the accidents, up to the last bin in which it does so significantly."""
    excess = found - accidents
    beyond = np.flatnonzero(excess > _SIGNIFICANT * np.sqrt(accidents) + _SIGNIFICANT)
    last = beyond[-1] + 1 if len(beyond) else 0
    share = np.where(np.arange(len(edges)) < last, np.maximum(excess, 0) + 1e-3, 0)
    density = _falling(share / max(share.sum(), 1e-300), np.diff(edges, prepend=0.0))
    met, deviation = excess[:last].sum().clip(0, most), np.sqrt(accidents[:last].sum())
    return _Noise(float(met), float(deviation), edges, density)


def _edges() -> Float[np.ndarray, " bins"]:
    return np.exp2(np.arange(np.log2(_FINEST), np.log2(_COARSEST) + 1e-9, _OCTAVES_PER_BIN))


def _uniform_below(last: Float[np.ndarray, " lines"], edges: Float[np.ndarray, " bins"]) -> Float[np.ndarray, " bins"]:
    """Sum of min(edge / last, 1) over the lines, for each edge."""
    ordered = np.sort(last)
    inverse = np.concatenate([np.cumsum(1 / ordered[::-1])[::-1], [0.0]])
    passed = np.searchsorted(ordered, edges)
    return passed + edges * inverse[passed]


class _Pairs(NamedTuple):
    """Candidates within the noise.

    ``accidents`` is the density of accidents of the pair at distance 0, ``equal`` whether both lines have the same
    descriptor; ``nodes`` numbers the lines of both sides among ``count``, and ``sides`` are the lines of each.
    """

    row: Int[np.ndarray, " pairs"]
    other: Int[np.ndarray, " pairs"]
    distance: Float[np.ndarray, " pairs"]
    beta: Float[np.ndarray, " pairs"]
    other_beta: Float[np.ndarray, " pairs"]
    point: Float[np.ndarray, "pairs 3"]
    accidents: Float[np.ndarray, " pairs"]
    equal: Bool[np.ndarray, " pairs"]
    nodes: tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]
    count: int
    sides: tuple[int, int]


def _joined(
    descriptors: tuple[np.ndarray, np.ndarray] | None, within: bool
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Rows of lines whose descriptors are equal, and those of no other line."""
    none = np.zeros(0, dtype=np.int64)
    if descriptors is None:
        return none, none
    every = np.concatenate(descriptors[:1] if within else descriptors)
    _, group, size = np.unique(every, axis=0, return_inverse=True, return_counts=True)
    twice = np.flatnonzero(size[group.ravel()] == 2)
    pair = twice[np.argsort(group.ravel()[twice], kind="stable")].reshape(-1, 2)
    if within:
        return pair[:, 0], pair[:, 1]
    first = len(descriptors[0])
    pair = pair[(pair[:, 0] < first) & (pair[:, 1] >= first)]
    return pair[:, 0], pair[:, 1] - first


def _candidates(
    lines: Lines,
    others: Lines,
    tables: list[NearestLines],
    noise: _Noise,
    joined: tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]],
) -> tuple[_Pairs, Float[np.ndarray, "some 3"]]:
    """Pairs that meet within the noise, and places where others, which do not, come closest."""
    within = len(tables) == 1
    count, many = len(lines.direction), len(others.direction)
    keys, far = [torch.as_tensor(joined[0] * many + joined[1])], []
    for table, turned in zip(tables, (False, True), strict=False):
        own = torch.arange(len(table.index))[:, None].expand_as(table.index)
        key = table.index * many + own if turned else own * many + table.index
        close = torch.as_tensor(noise.of(table.distance.numpy()) > 0)
        keys.append(key[close])
        far.append(key[~close & table.distance.isfinite()])
    key = torch.cat(keys).unique()
    if within:
        key = key[key // many < key % many]
    row, other = key // many, key % many
    distance, beta, other_beta, point = _measured(lines.rows(row), others.rows(other))
    close = torch.as_tensor(noise.of(distance.numpy()) > 0)
    key, row, other = key[close], row[close], other[close]
    rates = [_rate(table.distance) for table in (tables[0], tables[-1])]
    total = float(torch.sqrt(rates[0].sum() * rates[1].sum()))
    accidents = rates[0][row] * rates[1][other] / max(total, 1e-300)
    tensors = (row, other, distance[close], beta[close], other_beta[close], point[close], accidents)
    a, b, c, d, e, f, g = (tensor.numpy() for tensor in tensors)
    equal = np.isin(key.numpy(), joined[0] * many + joined[1])
    nodes = row.numpy(), (other if within else count + other).numpy()
    size = count if within else count + many
    pairs = _Pairs(a, b, c, d, e, f, g, equal, nodes, size, (count, many))
    some = torch.cat(far)
    some = some[:: max(1, len(some) // _ACCIDENTS)]
    return pairs, _measured(lines.rows(some // many), others.rows(some % many))[3].numpy()


def _rate(distance: Float[Tensor, "lines k"]) -> Float[Tensor, " lines"]:
    """Accidental meetings of each line per unit of distance; the nearest line may be its partner."""
    found = distance.isfinite().sum(dim=1)
    last = distance.gather(1, (found - 1).clamp_min(0)[:, None])[:, 0] if distance.shape[1] else distance.sum(dim=1)
    return torch.where(found > 0, (found - 1.5).clamp_min(0.5) / last.clamp_min(_FINEST), 0.0)


def _measured(
    first: Lines, second: Lines
) -> tuple[Float[Tensor, " pairs"], Float[Tensor, " pairs"], Float[Tensor, " pairs"], Float[Tensor, "pairs 3"]]:
    """Distance of each pair, the positions on both lines where they come closest, and the point between."""
    cosine = (first.direction * second.direction).sum(dim=1)
    sine2 = torch.linalg.cross(first.direction, second.direction).square().sum(dim=1)
    # Pairs with equal descriptors may be parallel: they have no distance.
    sine2 = sine2.clamp_min(torch.finfo(sine2.dtype).tiny)
    ahead, back = (second.foot * first.direction).sum(dim=1), (first.foot * second.direction).sum(dim=1)
    beta, other_beta = (ahead + cosine * back) / sine2, (back + cosine * ahead) / sine2
    reciprocal = (first.direction * second.moment).sum(dim=1) + (first.moment * second.direction).sum(dim=1)
    point = (first.at(beta) + second.at(other_beta)) / 2
    return reciprocal.abs() / sine2.sqrt(), beta, other_beta, point


def _probabilities(
    pairs: _Pairs, noise: _Noise, told: float, accidents: Float[np.ndarray, "some 3"]
) -> Float[np.ndarray, " pairs"]:
    """Probability that each pair has a common point, which so many with equal descriptors have."""
    odds = _activity(noise, pairs) * noise.of(pairs.distance) / np.maximum(pairs.accidents, 1e-300)
    equal = int(pairs.equal.sum())
    shares = told / max(equal, 1), max(noise.pairs - told, 0.0) / max(len(odds) - equal, 1)
    probability = _matched(odds * _alike(pairs.equal, np.where(pairs.equal, *shares).clip(0, 1)), pairs)
    for _ in range(_PLACES):
        ratio = _placed(pairs, probability, accidents) * _alike(pairs.equal, probability)
        probability = _matched(odds * ratio, pairs)
    return probability


def _activity(noise: _Noise, pairs: _Pairs) -> float:
    """Odds of a pair before anything is measured: pairs of one point, over all pairs of lines without a partner."""
    first, second = pairs.sides
    if pairs.count == first:  # within one cloud, a pair takes two of its lines
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
    first, second = pairs.nodes
    odds = np.minimum(odds, _MOST)
    # That a line is free, as far as its other candidates tell.
    free, other_free = np.ones(len(odds)), np.ones(len(odds))
    for _ in range(_PASSES):
        to_first, to_second = odds * other_free, odds * free
        total = np.bincount(first, to_first, pairs.count) + np.bincount(second, to_second, pairs.count)
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
    own = np.logical_or(*(node[met] == node[:, None] for node in pairs.nodes))
    found = np.sort(np.where(own, np.inf, found), axis=1)[:, _OTHERS - 1]
    known = found[clear][np.isfinite(found[clear])]
    if not len(known):
        return np.ones(len(probability))
    cuts = np.quantile(known, np.linspace(0, 1, _PLACE_BINS + 1)[1:])
    cuts = np.unique(np.concatenate([cuts, cuts[-1] * 2.0 ** np.arange(1, 5)]))
    bins = np.searchsorted(cuts, found)
    true, false = (np.bincount(bins, part, len(cuts) + 1) + 0.5 for part in (probability, 1 - probability))
    if len(accidents):
        far = np.asarray(tree.query(accidents, _OTHERS)[0])[:, -1]
        false += np.bincount(np.searchsorted(cuts, far), minlength=len(cuts) + 1)
    return _falling(true / true.sum(), false / false.sum())[bins]


def _alike(equal: Bool[np.ndarray, " pairs"], probability: Float[np.ndarray, " pairs"]) -> Float[np.ndarray, " pairs"]:
    """Ratio of the probabilities, in common points and in accidents, that the descriptors are as equal as they are."""
    if not equal.any():
        return np.ones(len(equal))
    true, false = (np.bincount(equal, part, 2) + 0.5 for part in (probability, 1 - probability))
    return ((true / true.sum()) / (false / false.sum()))[equal.astype(np.int64)]
