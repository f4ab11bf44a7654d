"""The points nearest to each line by a tree of boxes: exact, without a look at every pair.

For a block of lines at a time,

1. the radius that most likely holds the k nearest points of each line is read off a sample of all points
   (:func:`_guess`);
2. leaves of the tree farther from a line than its radius are left out (:func:`l2p.geometry.tree.reach`);
3. a sample of the points in the leaves that remain gives a smaller radius, which leaves fewer of them
   (:func:`_tighten`);
4. all points of these are measured, and the k nearest are chosen (:func:`_measure`, :func:`_choose`).

The radius is a guess, the answer is not: a line that finds fewer than k points within its radius is searched again
with a larger one. Distances are counted in units of the points' scale throughout.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l2p.geometry.elements import Lines, crosswise, picked
from l2p.geometry.tree import Pairs, PointTree, reach
from l2p.work.threads import even_size
from l2p.work.work import Work

#: Most lines of a block, and most pairs of its lines with leaves, and with points; where there are more, blocks become
#: smaller.
_BLOCK, _PAIRS = 1 << 14, 1 << 22
#: Bytes of temporaries of a line and of a pair, each twice what it takes: both are there together.
_LINE_BYTES, _PAIR_BYTES = 3200, 80
#: A block with no more pairs of lines and points than this is measured whole rather than made smaller.
_ALL = 1 << 26
#: Distances in a tile, which fits the cache.
_TILE = 1 << 17
#: Lines in one matrix product at a leaf. Products smaller than 32 x 4 x 4 are slow in torch.
_GROUP = 32
#: Points of each leaf in the sample that makes the radius smaller, and the steps in which it does.
_SAMPLE, _STEPS = 4, 64
#: Samples are read at the rank that is due to them, and this many standard deviations more.
_DEVIATIONS = 2.0
#: Factors on the radius of lines that found too few points; what is left after these is measured against all points.
_GROWTH = (1.5, 2.0, 4.0, 16.0, 256.0)


class _Hits(NamedTuple):
    """Points within the radius of lines, in runs of the same line.

    ``line`` and ``length`` belong to the runs. ``place`` is where in the leaves a point is, ``square`` its
    (distance / radius)^2.
    """

    line: Int[Tensor, " runs"]
    length: Int[Tensor, " runs"]
    place: Int[Tensor, " hits"]
    square: Float[Tensor, " hits"]


class _Found(NamedTuple):
    """The k nearest points of each line where there are ``enough`` within its ``radius``.

    ``pairs`` and ``hits`` are the numbers of leaves and of points that were reached.
    """

    index: Int[Tensor, "lines k"]
    enough: Bool[Tensor, " lines"]
    radius: Float[Tensor, " lines"]
    pairs: int = 0
    hits: int = 0


def nearest_points(
    tree: PointTree, lines: Lines, k: int, work: Work, title: str, first: int = 0
) -> Int[Tensor, "lines k"]:
    """The k points nearest to each line in no order, point ``first + i`` being left out for line i.

    There are more than k points.
    """
    count = len(lines.direction)
    index = torch.empty(count, k, dtype=torch.int32, device=lines.direction.device)
    rows = torch.arange(count, device=index.device)
    with work.task(title, total=count) as advance:
        # One more than k, for the line's own point.
        radius = _guess(tree, lines, k + 1, work)
        for growth in (1.0, *_GROWTH):
            missed = [rows[:0]]
            search = partial(_search, tree, lines, rows, growth * radius, k + 1, tighten=growth == 1)
            for block, found in work.over_blocks(search, len(rows), even_size(len(rows), _BLOCK), index.device):
                part = rows[block]
                index[part] = _without_own(found.index, part + first)
                radius[part] = found.radius
                missed.append(part[~found.enough])
                advance(len(part) - len(missed[-1]))
            rows = torch.cat(missed)
        if len(rows):
            index[rows] = _without_own(_among_all(tree, lines.rows(rows), k + 1).index, rows + first)
            advance(len(rows))
    return index


def _search(
    tree: PointTree,
    lines: Lines,
    rows: Int[Tensor, " rows"],
    radius: Float[Tensor, " lines"],
    k: int,
    block: slice,
    work: Work,
    *,
    tighten: bool,
) -> _Found:
    """The points nearest to a block of rows, which are some of the lines."""
    part = rows[block]
    some = lines.rows(part)
    found = _in_pieces(tree, some, radius[part], k, work, tighten=tighten)
    if found is not None:
        return found
    if len(part) == 1 or len(part) * tree.index.numel() <= _ALL:
        return _among_all(tree, some, k)
    middle = (block.start + block.stop) // 2
    halves = slice(block.start, middle), slice(middle, block.stop)
    return _joined([_search(tree, lines, rows, radius, k, half, work, tighten=tighten) for half in halves])


def _joined(parts: list[_Found]) -> _Found:
    """What was found for parts of a block."""
    index, enough, radius = (torch.cat(column) for column in list(zip(*parts, strict=True))[:3])
    return _Found(index, enough, radius)


def _without_own(found: Int[Tensor, "rows more"], own: Int[Tensor, " rows"]) -> Int[Tensor, "rows k"]:
    """All but a line's own point; all but one where points that coincide with its own have crowded that out."""
    same = found == own[:, None]
    last = found[:, -1:].clone()
    at = torch.where(same.any(dim=1), same.byte().argmax(dim=1), found.shape[1] - 1)
    return found.scatter_(1, at[:, None], last)[:, :-1]


def _projection(lines: Lines) -> Float[Tensor, "lines 8"]:
    """(e, a, f, b) so that a point p lies at (e . p + a, f . p + b) in the plane across each line."""
    direction, moment = lines
    first = torch.nn.functional.normalize(torch.linalg.cross(direction, crosswise(direction)), dim=1)
    second = torch.linalg.cross(direction, first)
    offset = torch.linalg.vecdot(second, moment), -torch.linalg.vecdot(first, moment)
    return torch.cat([first, offset[0][:, None], second, offset[1][:, None]], dim=1)


def _squares(
    projection: Float[Tensor, "*groups rows 8"], points: Float[Tensor, "*groups 4 columns"]
) -> Float[Tensor, "*groups rows columns"]:
    """Squared distances of points from lines."""
    square = (projection[..., :4] @ points).square_()
    other = projection[..., 4:] @ points
    return square.addcmul_(other, other)


def _rank(k: int, share: float) -> int:
    """The rank in a sample of this share that is most likely no nearer than rank k of all."""
    return math.ceil(k * share + _DEVIATIONS * math.sqrt(k * share))


def _guess(tree: PointTree, lines: Lines, k: int, work: Work) -> Float[Tensor, " lines"]:
    """A distance that most likely holds k points, by the sample of all."""
    size = tree.sample.shape[1]
    rank = min(_rank(k, size / tree.index.numel()), size)

    def guessed(block: slice, _: Work) -> Float[Tensor, " rows"]:
        square = _squares(_projection(lines.rows(block)), tree.sample)
        # Minima of a few each: most of the nearest are in different ones, and there is less to choose from.
        while square.shape[1] >= 16 * rank:
            half = square.shape[1] // 2
            square = torch.minimum(square[:, :half], square[:, half : 2 * half])
        return torch.topk(square, rank, dim=1, largest=False, sorted=False).values.amax(dim=1)

    tiles = work.over_blocks(guessed, len(lines.direction), max(1, _TILE // size), lines.direction.device)
    radius = torch.cat([lines.direction[:0, 0], *(part for _, part in tiles)]).sqrt()
    # Where points coincide on a line, the distance is rounding alone, or 0. The same for all lines, whoever searches.
    rounding = 1e-6 * tree.sample[:3].norm(dim=0).median()
    return radius * (1 + 1e-5) + rounding + torch.finfo(radius.dtype).tiny ** 0.25


def _in_pieces(
    tree: PointTree, lines: Lines, radius: Float[Tensor, " lines"], k: int, work: Work, *, tighten: bool
) -> _Found | None:
    """What ``_within`` finds for a block, by as many of its lines at a time as there is room for.

    None where the whole block has too many pairs: whether all points are measured must not depend on the room.
    """
    most = work.fitting(_PAIRS, _PAIR_BYTES)
    left = list(torch.arange(len(radius), device=radius.device).split(work.fitting(_BLOCK, _LINE_BYTES)))[::-1]
    parts: list[_Found] = []
    while left:
        rows = left.pop()
        limit = most if len(rows) > 1 else _PAIRS
        found = _within(tree, lines.rows(rows), radius[rows], k, limit, tighten=tighten)
        if found is not None:
            parts.append(found)
            if max(sum(part.pairs for part in parts), sum(part.hits for part in parts)) > _PAIRS:
                return None
        elif limit < _PAIRS:
            left += rows.split((len(rows) + 1) // 2)[::-1]
        else:
            return None
    return _joined(parts)


def _within(
    tree: PointTree, lines: Lines, radius: Float[Tensor, " lines"], k: int, most: int, *, tighten: bool
) -> _Found | None:
    """The k nearest points within a radius, which ``tighten`` may make smaller; None for more than ``most`` pairs."""
    count = len(radius)
    pairs = reach(tree, lines, radius, most)
    if pairs is None:
        return None
    reached = len(pairs.line)
    projection = _projection(lines)
    if tighten:
        smaller = radius * _tighten(tree, projection / radius[:, None], pairs, k)
        keep = torch.nonzero(pairs.margin >= (radius - smaller).index_select(0, pairs.line)).flatten()
        pairs = Pairs(*(part.index_select(0, keep) for part in pairs))
        radius = smaller
    hits = _measure(tree, projection / radius[:, None], pairs, most)
    if hits is None:
        return None
    place, enough = _choose(hits, k, count)
    index = picked(tree.index.view(-1), place)
    return _Found(index, enough, radius, reached, len(hits.place))


def _tiles(
    points: Float[Tensor, "leaves 4 width"], projection: Float[Tensor, "lines 8"], pairs: Pairs
) -> Iterator[tuple[Int[Tensor, " rows"], Int[Tensor, " rows"], Float[Tensor, "rows width"]]]:
    """Lines, leaves, and the squared distances of the points of each pair's leaf from its line, a tile at a time.

    Lines that share a leaf come in groups, padded with a line far from everything.
    """
    leaves, width = len(points), points.shape[2]
    size = torch.bincount(pairs.leaf, minlength=leaves)
    groups = (size + _GROUP - 1) // _GROUP
    # Where the first pair of each leaf goes, less where it comes from.
    shift = (groups.cumsum(0) - groups) * _GROUP - (size.cumsum(0) - size)
    place = shift.index_select(0, pairs.leaf).add_(torch.arange(len(pairs.leaf), device=shift.device))
    leaf = torch.repeat_interleave(groups)
    line = pairs.line.new_full((len(leaf) * _GROUP,), len(projection)).scatter_(0, place, pairs.line)
    nowhere = torch.zeros_like(projection[:1])
    nowhere[:, 3] = 1e18
    projection = torch.cat([projection, nowhere])
    step = max(1, _TILE // (_GROUP * width))
    for here, there in zip(line.split(step * _GROUP), leaf.split(step), strict=True):
        grouped = projection.index_select(0, here).view(-1, _GROUP, 8)
        square = _squares(grouped, points.index_select(0, there))
        yield here, there.repeat_interleave(_GROUP), square.view(-1, width)


def _tighten(tree: PointTree, projection: Float[Tensor, "lines 8"], pairs: Pairs, k: int) -> Float[Tensor, " lines"]:
    """The share of the radius, which is 1 in the projection's units, that most likely holds k points."""
    points = tree.points[:, :, :_SAMPLE].contiguous()
    width = points.shape[2]
    steps = [pairs.line[:0]]
    for line, _, square in _tiles(points, projection, pairs):
        square = square.view(-1)
        near = torch.nonzero(square < 1).flatten()
        line = line.index_select(0, torch.div(near, width, rounding_mode="floor"))
        steps.append(line * _STEPS + (square.index_select(0, near).sqrt() * _STEPS).int())
    number = torch.bincount(torch.cat(steps), minlength=len(projection) * _STEPS).view(-1, _STEPS)
    below = number.cumsum(dim=1) < _rank(k, width / tree.points.shape[2])
    return ((below.sum(dim=1) + 1) / _STEPS).clamp_max(1).to(projection.dtype)


def _measure(tree: PointTree, projection: Float[Tensor, "lines 8"], pairs: Pairs, most: int) -> _Hits | None:
    """The points within the radius, which is 1 in the projection's units; None where these are more than ``most``."""
    width = tree.points.shape[2]
    parts = [_Hits(pairs.line[:0], pairs.line[:0].long(), pairs.line[:0], projection[:0, 0])]
    found = 0
    for line, leaf, square in _tiles(tree.points, projection, pairs):
        near = _nonzero(square < 1)
        row = torch.div(near.int(), width, rounding_mode="floor")
        length = torch.bincount(row, minlength=len(line))
        run = torch.nonzero(length).flatten()
        shift = (leaf - torch.arange(len(leaf), device=leaf.device)) * width
        place = shift.index_select(0, row).add_(near).int()
        square = square.view(-1).index_select(0, near)
        parts.append(_Hits(line.index_select(0, run), length.index_select(0, run), place, square))
        found += len(near)
        if found > most:
            return None
    return _Hits(*map(torch.cat, zip(*parts, strict=True)))


def _nonzero(mask: Bool[Tensor, "rows width"]) -> Int[Tensor, " true"]:
    """Places in a flattened mask of which most is False in long stretches: looks at 8 at a time first."""
    word = mask.view(-1).view(torch.int64)
    some = torch.nonzero(word).flatten()
    place = torch.nonzero(word.index_select(0, some).view(torch.bool)).flatten()
    shift = (some - torch.arange(len(some), device=some.device)) * 8
    return place.add_(shift.index_select(0, place >> 3))


def _choose(hits: _Hits, k: int, lines: int) -> tuple[Int[Tensor, "lines k"], Bool[Tensor, " lines"]]:
    """Places of the k nearest hits of each line, in no order, and whether there are so many."""
    # Keys of 16 bits are sorted in half the time.
    order = torch.sort(hits.line.short() if lines <= 1 << 15 else hits.line, stable=True).indices
    length = hits.length.index_select(0, order)
    begin = (hits.length.cumsum(0) - hits.length).index_select(0, order)
    shift = begin - (length.cumsum(0) - length)
    # Line after line, where its hits are.
    hit = shift.repeat_interleave(length, output_size=len(hits.place))
    hit += torch.arange(len(hit), device=hit.device)
    square = hits.square.index_select(0, hit)
    number = torch.zeros(lines, dtype=torch.long, device=hit.device).index_add_(0, hits.line, hits.length)
    first = number.cumsum(0) - number
    place = torch.zeros(lines, k, dtype=torch.int32, device=hit.device)
    # Lines with similar numbers of hits make a rectangle together.
    rows = number.argsort(descending=True)
    widths = number.index_select(0, rows).tolist()
    done = 0
    while done < lines and widths[done] >= k:
        width = widths[done]
        part = rows[done : done + max(1, 2 * _TILE // width)]
        column = torch.arange(width, device=hit.device)
        at = (first[part, None] + column).clamp_max_(len(square) - 1)
        near = picked(square, at)
        near.masked_fill_(column >= number[part, None], torch.inf)
        best = torch.gather(at, 1, torch.topk(near, k, dim=1, largest=False, sorted=False).indices)
        place[part] = hits.place.index_select(0, hit.index_select(0, best.view(-1))).view(-1, k)
        done += len(part)
    return place, number >= k


def _among_all(tree: PointTree, lines: Lines, k: int) -> _Found:
    """The k nearest of all points."""
    points = tree.points.transpose(0, 1).reshape(4, -1)
    parts = []
    for part in _projection(lines).split(max(1, 16 * _TILE // points.shape[1])):
        square = _squares(part, points).nan_to_num_(nan=torch.inf)
        parts.append(torch.topk(square, k, dim=1, largest=False, sorted=False).indices)
    index = tree.index.view(-1)[torch.cat(parts)]
    radius = torch.full_like(lines.direction[:, 0], torch.inf)
    return _Found(index, torch.ones_like(radius, dtype=torch.bool), radius)
