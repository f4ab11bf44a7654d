"""Exact search of the points nearest to each line, by a tree of boxes.

For a block of lines at a time,

1. a sample of all points gives a radius per line that most likely holds its k nearest points (:func:`_guess`);
2. leaves of the tree farther from a line than its radius are left out (:func:`l2p.geometry.tree.reach`);
3. a sample of the points in the remaining leaves gives a smaller radius, and fewer leaves (:func:`_tighten`);
4. distances of all points in these leaves are computed, and the k nearest are chosen (:func:`_measure`,
   :func:`_choose`).

The radius is a guess, but the answer is exact: lines with fewer than k points within their radius are searched again
with a larger one. Distances are in units of the points' scale throughout.
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

#: Most lines per block, and most line-leaf pairs and line-point pairs; a block with more pairs is halved.
_BLOCK, _PAIRS = 1 << 14, 1 << 22
#: Bytes of temporaries per line and per pair, doubled because both live at once.
_LINE_BYTES, _PAIR_BYTES = 3200, 80
#: Most pairs of lines and points of the tree; up to these, a block is compared with all points and not halved.
_ALL = 1 << 26
#: Distances per tile, which fits the cache.
_TILE = 1 << 17
#: Lines per matrix product at a leaf: products smaller than 32 x 4 x 4 are slow in torch. A multiple of 8, as
#: :func:`_nonzero` needs.
_GROUP = 32
#: Points per leaf in the sample that tightens the radius, and number of radii that are tried.
_SAMPLE, _STEPS = 4, 64
#: Quantile of a sample that is used as radius: the expected rank plus this many standard deviations.
_DEVIATIONS = 2.0
#: Factors on the radius of lines that found too few points; after the last, they are compared with all points.
_GROWTH = (1.5, 2.0, 4.0, 16.0, 256.0)


class _Hits(NamedTuple):
    """Points within the radius of lines, in runs of the same line.

    ``line`` and ``length`` are per run; ``place`` is the index of a point in the flattened leaves, ``square`` is
    (distance / radius)^2.
    """

    line: Int[Tensor, " runs"]
    length: Int[Tensor, " runs"]
    place: Int[Tensor, " hits"]
    square: Float[Tensor, " hits"]


class _Found(NamedTuple):
    """The k nearest points of each line, where ``enough`` of them are within its ``radius``.

    ``pairs`` and ``hits`` count the leaves and the points within the radius.
    """

    index: Int[Tensor, "lines k"]
    enough: Bool[Tensor, " lines"]
    radius: Float[Tensor, " lines"]
    pairs: int = 0
    hits: int = 0


def nearest_points(
    tree: PointTree, lines: Lines, k: int, work: Work, title: str, first: int | None = 0
) -> Int[Tensor, "lines k"]:
    """Find the k points nearest to each line, in no order, without the own point ``first + i`` of line i.

    With ``first`` None, no point is a line's own. The tree must have more than k points.
    """
    count = len(lines.direction)
    index = torch.empty(count, k, dtype=torch.int32, device=lines.direction.device)
    rows = torch.arange(count, device=index.device)
    with work.task(title, total=count) as advance:
        # One more than k, for the line's own point.
        more = k if first is None else k + 1
        radius = _guess(tree, lines, more, work)
        for growth in (1.0, *_GROWTH):
            missed = [rows[:0]]
            search = partial(_search, tree, lines, rows, growth * radius, more, tighten=growth == 1)
            for block, found in work.over_blocks(search, len(rows), even_size(len(rows), _BLOCK), index.device):
                searched = rows[block]
                index[searched] = found.index if first is None else _without_own(found.index, searched + first)
                radius[searched] = found.radius
                missed.append(searched[~found.enough])
                advance(len(searched) - len(missed[-1]))
            rows = torch.cat(missed)
        if len(rows):
            found = _among_all(tree, lines.rows(rows), more).index
            index[rows] = found if first is None else _without_own(found, rows + first)
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
    """Search for the lines of a block of ``rows``, in halves if they have too many pairs."""
    searched = rows[block]
    some = lines.rows(searched)
    found = _in_pieces(tree, some, radius[searched], k, work, tighten=tighten)
    if found is not None:
        return found
    if len(searched) == 1 or len(searched) * tree.index.numel() <= _ALL:
        return _among_all(tree, some, k)
    middle = (block.start + block.stop) // 2
    halves = slice(block.start, middle), slice(middle, block.stop)
    return _joined([_search(tree, lines, rows, radius, k, half, work, tighten=tighten) for half in halves])


def _joined(results: list[_Found]) -> _Found:
    """Join the results of consecutive lines."""
    index, enough, radius = (torch.cat(column) for column in list(zip(*results, strict=True))[:3])
    return _Found(index, enough, radius)


def _without_own(found: Int[Tensor, "rows more"], own: Int[Tensor, " rows"]) -> Int[Tensor, "rows k"]:
    """Drop each line's own point, or the last point if those that coincide with the own one displaced it."""
    same = found == own[:, None]
    last = found[:, -1:].clone()
    column = torch.where(same.any(dim=1), same.byte().argmax(dim=1), found.shape[1] - 1)
    return found.scatter_(1, column[:, None], last)[:, :-1]


def _projection(lines: Lines) -> Float[Tensor, "lines 8"]:
    """(e, a, f, b) such that a point p projects to (e . p + a, f . p + b) in the plane orthogonal to each line."""
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
    """Rank in a sample of this share that is most likely at least as far as rank k among all points."""
    return math.ceil(k * share + _DEVIATIONS * math.sqrt(k * share))


def _guess(tree: PointTree, lines: Lines, k: int, work: Work) -> Float[Tensor, " lines"]:
    """A radius that most likely holds k points, from the sample of the whole tree."""
    size = tree.sample.shape[1]
    rank = min(_rank(k, size / tree.index.numel()), size)

    def guessed(block: slice, _: Work) -> Float[Tensor, " rows"]:
        square = _squares(_projection(lines.rows(block)), tree.sample)
        # Minima of groups: the nearest points are mostly in different groups, and topk has fewer candidates.
        while square.shape[1] >= 16 * rank:
            half = square.shape[1] // 2
            square = torch.minimum(square[:, :half], square[:, half : 2 * half])
        return torch.topk(square, rank, dim=1, largest=False, sorted=False).values.amax(dim=1)

    tiles = work.over_blocks(guessed, len(lines.direction), max(1, _TILE // size), lines.direction.device)
    radius = torch.cat([lines.direction[:0, 0], *(square for _, square in tiles)]).sqrt()
    # A floor, since points on the line have a distance of 0 or of rounding alone; the same for all lines and processes.
    rounding = 1e-6 * tree.sample[:3].norm(dim=0).median()
    return radius * (1 + 1e-5) + rounding + torch.finfo(radius.dtype).tiny ** 0.25


def _in_pieces(
    tree: PointTree, lines: Lines, radius: Float[Tensor, " lines"], k: int, work: Work, *, tighten: bool
) -> _Found | None:
    """Search a block by :func:`_within`, as many of its lines at a time as fit the memory.

    None if the whole block has too many pairs: whether all points are compared must not depend on the memory.
    """
    most = work.fitting(_PAIRS, _PAIR_BYTES)
    stack = list(torch.arange(len(radius), device=radius.device).split(work.fitting(_BLOCK, _LINE_BYTES)))[::-1]
    results: list[_Found] = []
    while stack:
        rows = stack.pop()
        limit = most if len(rows) > 1 else _PAIRS
        found = _within(tree, lines.rows(rows), radius[rows], k, limit, tighten=tighten)
        if found is not None:
            results.append(found)
            if max(sum(result.pairs for result in results), sum(result.hits for result in results)) > _PAIRS:
                return None
        elif limit < _PAIRS:
            stack += rows.split((len(rows) + 1) // 2)[::-1]
        else:
            return None
    return _joined(results)


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
        pairs = Pairs(*(column.index_select(0, keep) for column in pairs))
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
    """Yield, tile by tile, the line and the leaf of each row, and squared distances of the leaf's points from the line.

    Lines that share a leaf are grouped; groups are padded with a line far from everything.
    """
    leaves, width = len(points), points.shape[2]
    size = torch.bincount(pairs.leaf, minlength=leaves)
    groups = (size + _GROUP - 1) // _GROUP
    # Position of the first pair of each leaf in the padded groups, minus its position in ``pairs``.
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
    """Share of the radius (1 in units of the projection) that most likely holds k points."""
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
    """Find the points within the radius (1 in units of the projection); None for more than ``most``."""
    width = tree.points.shape[2]
    tiles = [_Hits(pairs.line[:0], pairs.line[:0].long(), pairs.line[:0], projection[:0, 0])]
    count = 0
    for line, leaf, square in _tiles(tree.points, projection, pairs):
        near = _nonzero(square < 1)
        row = torch.div(near.int(), width, rounding_mode="floor")
        length = torch.bincount(row, minlength=len(line))
        run = torch.nonzero(length).flatten()
        shift = (leaf - torch.arange(len(leaf), device=leaf.device)) * width
        place = shift.index_select(0, row).add_(near).int()
        square = square.view(-1).index_select(0, near)
        tiles.append(_Hits(line.index_select(0, run), length.index_select(0, run), place, square))
        count += len(near)
        if count > most:
            return None
    return _Hits(*map(torch.cat, zip(*tiles, strict=True)))


def _nonzero(mask: Bool[Tensor, "rows width"]) -> Int[Tensor, " true"]:
    """Indices of True in a flattened mask that is mostly False: first tests 8 entries at a time, as one int64.

    The size of the mask must be a multiple of 8.
    """
    word = mask.view(-1).view(torch.int64)
    some = torch.nonzero(word).flatten()
    place = torch.nonzero(word.index_select(0, some).view(torch.bool)).flatten()
    shift = (some - torch.arange(len(some), device=some.device)) * 8
    return place.add_(shift.index_select(0, place >> 3))


def _choose(hits: _Hits, k: int, lines: int) -> tuple[Int[Tensor, "lines k"], Bool[Tensor, " lines"]]:
    """``place`` of the k nearest hits of each line, in no order, and whether there are as many."""
    # 16-bit keys are sorted in half the time.
    order = torch.sort(hits.line.short() if lines <= 1 << 15 else hits.line, stable=True).indices
    length = hits.length.index_select(0, order)
    begin = (hits.length.cumsum(0) - hits.length).index_select(0, order)
    shift = begin - (length.cumsum(0) - length)
    # Row of each hit, sorted by line.
    hit = shift.repeat_interleave(length, output_size=len(hits.place))
    hit += torch.arange(len(hit), device=hit.device)
    square = hits.square.index_select(0, hit)
    number = torch.zeros(lines, dtype=torch.long, device=hit.device).index_add_(0, hits.line, hits.length)
    first = number.cumsum(0) - number
    place = torch.zeros(lines, k, dtype=torch.int32, device=hit.device)
    # Lines with similar numbers of hits are padded to one rectangle.
    rows = number.argsort(descending=True)
    widths = number.index_select(0, rows).tolist()
    done = 0
    while done < lines and widths[done] >= k:
        width = widths[done]
        block = rows[done : done + max(1, 2 * _TILE // width)]
        column = torch.arange(width, device=hit.device)
        candidate = (first[block, None] + column).clamp_max_(len(square) - 1)
        near = picked(square, candidate)
        near.masked_fill_(column >= number[block, None], torch.inf)
        best = torch.gather(candidate, 1, torch.topk(near, k, dim=1, largest=False, sorted=False).indices)
        place[block] = hits.place.index_select(0, hit.index_select(0, best.view(-1))).view(-1, k)
        done += len(block)
    return place, number >= k


def _among_all(tree: PointTree, lines: Lines, k: int) -> _Found:
    """Search by comparing each line with all points."""
    points = tree.points.transpose(0, 1).reshape(4, -1)
    tiles = []
    for tile in _projection(lines).split(max(1, 16 * _TILE // points.shape[1])):
        square = _squares(tile, points).nan_to_num_(nan=torch.inf)
        tiles.append(torch.topk(square, k, dim=1, largest=False, sorted=False).indices)
    index = tree.index.view(-1)[torch.cat(tiles)]
    radius = torch.full_like(lines.direction[:, 0], torch.inf)
    return _Found(index, torch.ones_like(radius, dtype=torch.bool), radius)
