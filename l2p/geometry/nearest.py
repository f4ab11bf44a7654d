"""Exact nearest-neighbour search among lines and points, blocked, in plain torch.

Every distance is a matrix product of small rank, so the distances of a block of queries to a block of others take a few
fused passes over a tile that fits the cache, followed by a selection of the k smallest. No array grows with
lines x lines: a tile holds ``TILE`` numbers, the result lines x k. From ``MANY`` points on, those nearest to lines are
found by a tree (:mod:`l2p.geometry.tree_search`).

Lines may be distributed over processes (:mod:`l2p.work.shards`): ``work`` selects the lines or points that are queries
of this process; they are compared with all others.

Item i is never a neighbour of query i. Parallel pairs of lines have no distance. Rows are sorted by distance, equal
distances by index; if a query has fewer than k neighbours, the rest is index -1 at distance infinity. With k >= lines
the result has lines - 1 columns; for a single line, none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.geometry.elements import Lines, picked
from l2p.geometry.pairs import PARALLEL, line_line_distance, point_line_distance
from l2p.geometry.points import nearest_neighbors
from l2p.geometry.tree import plant
from l2p.geometry.tree_search import nearest_points
from l2p.work.threads import even_size
from l2p.work.work import ALONE, Work

#: Numbers per tile of distances: 8 MB in single precision, so that a tile and its temporaries about fit the cache.
TILE = 1 << 21
#: Number of points from which a tree is faster than all pairs, if there are also 16 points per neighbour.
MANY = 1 << 12
_COLUMNS = 1 << 16
_GROUP = 8


class Nearest(NamedTuple):
    """Neighbours of each query, nearest first: ``index`` (-1 for none) and ``distance`` (infinite for none)."""

    index: Int[Tensor, "queries k"]
    distance: Float[Tensor, "queries k"]


Kernel = Callable[[slice, slice], Float[Tensor, "rows columns"]]


def nearest_lines_to_lines(lines: Lines, k: int, *, tile: int = TILE, work: Work = ALONE) -> Nearest:
    """Find N_ll: the k lines with the smallest line-line distance to each line.

    Notes
    -----
    O(lines^2) time, O(lines k + tile) memory.
    """
    left = torch.cat([lines.direction, lines.moment], dim=1)
    right = torch.cat([lines.moment, lines.direction], dim=1)

    def squared(rows: slice, columns: slice) -> Float[Tensor, "rows columns"]:
        reciprocal = left[rows] @ right[columns].T
        sine2 = lines.direction[rows] @ lines.direction[columns].T
        sine2.square_().neg_().add_(1)
        parallel = sine2 <= PARALLEL**2
        return reciprocal.square_().div_(sine2).masked_fill_(parallel, torch.inf)

    own = work.own(len(lines.direction))
    index = _search(squared, own, len(lines.direction), k, lines.direction, tile, work, "nearest lines to lines")
    queries = lines.rows(own)
    return _sorted(index, lambda rows, found: line_line_distance(queries.rows(rows), lines, found), tile, work)


def nearest_points_to_lines(
    lines: Lines,
    points: Float[Tensor, "lines 3"],
    k: int,
    *,
    scale: Float[Tensor, " lines"] | None = None,
    tile: int = TILE,
    work: Work = ALONE,
) -> Nearest:
    """Find N_pl: the k points nearest to each line; ``points[i]`` belongs to line i and is not in its row.

    With ``scale``, the distance to point j is in units of ``scale[j]``: then dense places along a line do not crowd out
    the sparse ones.

    Notes
    -----
    O(lines^2) time, O(lines k + tile) memory; from ``MANY`` lines on, nearly O(lines) time for points on surfaces,
    O(lines^(4/3)) for points that fill space, and up to 256 MB per thread besides the result.
    """
    own = work.own(len(points))
    return _points_to_lines(lines, own, points, k, scale, tile, work, apart=False)


def nearest_points_to_other_lines(
    queries: Lines,
    points: Float[Tensor, "points 3"],
    k: int,
    *,
    scale: Float[Tensor, " points"] | None = None,
    tile: int = TILE,
    work: Work = ALONE,
) -> Nearest:
    """Find the k points nearest to each line, where no point belongs to any of the lines.

    Like :func:`nearest_points_to_lines`; all lines are queries of this process, and each has min(k, points) neighbours.
    """
    own = slice(0, len(queries.direction))
    return _points_to_lines(queries, own, points, k, scale, tile, work, apart=True)


def _points_to_lines(
    lines: Lines,
    own: slice,
    points: Float[Tensor, "points 3"],
    k: int,
    scale: Float[Tensor, " points"] | None,
    tile: int,
    work: Work,
    *,
    apart: bool,
) -> Nearest:
    """Find the points nearest to the lines ``own``; unless ``apart``, point i belongs to line i."""
    title = "nearest points to lines"
    unit = torch.ones_like(points[:, 0]) if scale is None else scale
    queries = lines.rows(own)
    if len(points) >= max(MANY, 16 * k) and k > 0:
        index = nearest_points(plant(points, unit), queries, k, work, title, None if apart else own.start)
    else:
        left, right = _residual_factors(lines, points)
        right = right / unit[:, None]

        def squared(rows: slice, columns: slice) -> Float[Tensor, "rows columns"]:
            return _sum_of_squares(left[:, rows], right[:, columns])

        index = _search(squared, own, len(points), k, points, tile, work, title, apart=apart)

    def distance(rows: slice, found: Int[Tensor, "rows k"]) -> Float[Tensor, "rows k"]:
        shape = (*found.shape, 3)
        direction, moment = (part[rows][:, None].expand(shape) for part in queries)
        near = found.clamp_min(0)
        return point_line_distance(picked(points, near), direction, moment) / picked(unit, near)

    return _sorted(index, distance, tile, work)


def nearest_lines_to_points(
    points: Float[Tensor, "lines 3"],
    lines: Lines,
    k: int,
    *,
    tile: int = TILE,
    work: Work = ALONE,
) -> Nearest:
    """Find N_lp: the k lines nearest to each point; line i belongs to ``points[i]`` and is not in its row."""
    left, right = _residual_factors(lines, points)

    def squared(rows: slice, columns: slice) -> Float[Tensor, "rows columns"]:
        return _sum_of_squares(right[:, rows], left[:, columns])

    own = work.own(len(points))
    index = _search(squared, own, len(points), k, points, tile, work, "nearest lines to points")
    queries = points[own]

    def distance(rows: slice, found: Int[Tensor, "rows k"]) -> Float[Tensor, "rows k"]:
        others = lines.rows(found.clamp_min(0).flatten())
        shape = (*found.shape, 3)
        here = queries[rows][:, None].expand(shape)
        return point_line_distance(here, others.direction.view(shape), others.moment.view(shape))

    return _sorted(index, distance, tile, work)


def nearest_points_to_points(points: Float[Tensor, "lines 3"], k: int, *, work: Work = ALONE) -> Nearest:
    """Find the k points nearest to each point.

    Notes
    -----
    O(lines log lines) time by a k-d tree on the CPU.
    """
    own = work.own(len(points))
    near = nearest_neighbors(points.cpu().double().numpy(), k, workers=torch.get_num_threads(), rows=own)
    return Nearest(
        torch.from_numpy(near.index).to(points.device, torch.int32),
        torch.from_numpy(near.distance).to(points.device, points.dtype),
    )


def _residual_factors(
    lines: Lines, points: Float[Tensor, "points 3"]
) -> tuple[Float[Tensor, "3 lines 3"], Float[Tensor, "3 points 3"]]:
    """Factors whose products are the three components of p x d - m, each of rank 3.

    The shorter form |p|^2 - (p . d)^2 ... loses half the digits for points far from the centre.
    """
    left, right = [], []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        left.append(torch.stack([lines.direction[:, b], -lines.direction[:, a], -lines.moment[:, axis]], dim=1))
        right.append(torch.stack([points[:, a], points[:, b], torch.ones_like(points[:, a])], dim=1))
    return torch.stack(left), torch.stack(right)


def _sum_of_squares(
    left: Float[Tensor, "3 rows 3"], right: Float[Tensor, "3 columns 3"]
) -> Float[Tensor, "rows columns"]:
    total = (left[0] @ right[0].T).square_()
    for axis in (1, 2):
        component = left[axis] @ right[axis].T
        total.addcmul_(component, component)
    return total


def _search(
    squared: Kernel,
    own: slice,
    count: int,
    k: int,
    like: Tensor,
    tile: int,
    work: Work,
    title: str,
    *,
    apart: bool = False,
) -> Int[Tensor, "queries k"]:
    """Indices of the k smallest entries of some rows of a virtual matrix with ``count`` columns.

    Unless ``apart``, rows and columns are the same things, and the diagonal is left out.
    """
    k = max(0, min(k, count if apart else count - 1))
    # 32 bits: at 100 000 lines and 500 neighbours this is the largest array.
    index = torch.full((own.stop - own.start, k), -1, dtype=torch.int32, device=like.device)
    if k == 0:
        return index
    columns = max(min(count, _COLUMNS), k)
    rows = max(1, min(tile // columns, count))
    with work.task(title, total=len(index)) as advance:
        for begin in range(own.start, own.stop, rows):
            here = slice(begin, min(begin + rows, own.stop))
            index[begin - own.start : here.stop - own.start] = _search_rows(squared, here, count, k, columns, apart)
            advance(here.stop - begin)
    return index


def _search_rows(squared: Kernel, rows: slice, count: int, k: int, columns: int, apart: bool) -> Int[Tensor, "rows k"]:
    values, index = None, None
    own = torch.arange(0 if apart else rows.start, 0 if apart else rows.stop)
    for begin in range(0, count, columns):
        block = slice(begin, min(begin + columns, count))
        distance = squared(rows, block)
        # The part of the full matrix's diagonal in this block.
        inside = own[(own >= begin) & (own < block.stop)].to(distance.device)
        distance[inside - rows.start, inside - begin] = torch.inf
        chosen = smallest(distance, min(k, distance.shape[1]))
        found = torch.gather(distance, 1, chosen)
        chosen = chosen + begin
        if values is None or index is None:
            values, index = found, chosen
        else:
            values, index = torch.cat([values, found], dim=1), torch.cat([index, chosen], dim=1)
            best = smallest(values, min(k, values.shape[1]))
            values, index = torch.gather(values, 1, best), torch.gather(index, 1, best)
    assert values is not None and index is not None
    return index.masked_fill(values == torch.inf, -1)


def smallest(values: Float[Tensor, "rows columns"], k: int) -> Int[Tensor, "rows k"]:
    """Columns of the k smallest values of each row, in no particular order.

    The k smallest lie in the k groups with the smallest minima, so only these groups are searched instead of the whole
    row; the groups are found the same way. Exact, two to three times faster than one ``topk``.
    """
    rows, columns = values.shape
    groups = columns // _GROUP
    if groups < 2 * k:
        return torch.topk(values, k, dim=1, largest=False, sorted=False).indices
    # Strided groups (columns g, g + groups, ...), so that the minimum runs along contiguous memory.
    body = values[:, : groups * _GROUP].unflatten(1, (_GROUP, groups))
    best = smallest(body.amin(dim=1), k)
    member = (best[:, None, :] + groups * torch.arange(_GROUP, device=values.device)[:, None]).flatten(1)
    tail = torch.arange(groups * _GROUP, columns, device=values.device).expand(rows, -1)
    member = torch.cat([member, tail], dim=1)
    chosen = torch.topk(torch.gather(values, 1, member), k, dim=1, largest=False, sorted=False).indices
    return torch.gather(member, 1, chosen)


def _sorted(
    index: Int[Tensor, "queries k"],
    distance: Callable[[slice, Int[Tensor, "rows k"]], Float[Tensor, "rows k"]],
    tile: int,
    work: Work,
) -> Nearest:
    """Recompute the distances of the chosen pairs, and sort the rows by them."""
    count, k = index.shape
    parts = [torch.empty(0, k, device=index.device)]

    def measured(here: slice, _: Work) -> Float[Tensor, "rows k"]:
        # Equal distances are sorted by index, whatever the order of the search.
        found = index[here].sort(dim=1).values
        part = distance(here, found.long()).masked_fill(found < 0, torch.inf)
        part, order = part.sort(dim=1, stable=True)
        index[here] = torch.gather(found, 1, order).masked_fill(part == torch.inf, -1)
        return part

    # Room for 64 numbers per pair in a tile.
    size = even_size(count, max(1, tile // max(1, 64 * k)))
    parts += [part for _, part in work.over_blocks(measured, count, size, index.device)]
    return Nearest(index, torch.cat(parts[1:] or parts))
