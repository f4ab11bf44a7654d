"""Points in the leaves of a k-d tree, and the leaves that lines reach.

A line reaches a box if its distance from it, in units of the largest scale of the points inside, is at most the line's
radius: only then may a point inside be within the radius, in units of its own scale. The children of a box are tested
against all lines that reach the box, by matrix products.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.geometry.elements import Lines

#: Most points per leaf; each holds at least half as many.
LEAF = 32
#: Most children per box: leaves at the last level, boxes above it.
_LEAVES, _BOXES = 32, 16
#: Most points in the sample of the whole tree.
_SAMPLE = 2048
#: Products of boxes and lines per tile, which fits the cache.
_TILE = 1 << 16
#: Least sine between a line and an axis for a test across both; below it, rounding errors are too large.
_ALONG = 1e-2
#: Relative rounding error of a few operations, in units of the machine epsilon.
_ROUNDING = 32


class PointTree(NamedTuple):
    """Points in the leaves of a k-d tree.

    ``points`` are (x, y, z, 1) / scale, NaN for padding, in random order within a leaf; ``index`` are their rows.
    ``boxes`` has, per level from the root's children to the leaves, the children of each box: (centre, 1, half sides)
    / largest scale, then 1. ``sample`` holds points drawn evenly from the whole tree.
    """

    index: Int[Tensor, "leaves leaf"]
    points: Float[Tensor, "leaves 4 leaf"]
    boxes: tuple[Float[Tensor, "_ _ 8"], ...]
    sample: Float[Tensor, "4 sample"]


class Pairs(NamedTuple):
    """Pairs of a line and a leaf that it reaches, sorted by leaf; ``margin`` is its radius minus its distance."""

    line: Int[Tensor, " pairs"]
    leaf: Int[Tensor, " pairs"]
    margin: Float[Tensor, " pairs"]


def plant(points: Float[Tensor, "points 3"], scale: Float[Tensor, " points"]) -> PointTree:
    """Build the tree of points; distances are in units of each point's ``scale``. O(points log^2 points) time."""
    count = len(points)
    depth = max(0, math.ceil(math.log2(count / LEAF)))
    leaf = -(-count >> depth)
    generator = torch.Generator().manual_seed(0)
    # Leaves have one size, so some points are repeated; the copies become padding.
    repeated = torch.randperm(count, generator=generator)[: (leaf << depth) - count]
    index = torch.cat([torch.arange(count), repeated]).to(points.device)
    order = _halve(points[index], depth, generator)
    index, padding = index[order], order >= count
    position, unit = points[index], scale[index]
    factor = torch.cat([position, torch.ones_like(position[:, :1])], dim=1) / unit[:, None]
    stride = -(-len(index) // _SAMPLE)
    begin = torch.arange(0, len(index) - stride + 1, stride)
    drawn = begin + torch.randint(0, stride, begin.shape, generator=generator)
    sample = factor[drawn.to(index.device)].T.contiguous()
    factor[padding] = torch.nan
    leaves = factor.view(-1, leaf, 4).mT.contiguous()
    return PointTree(index.view(-1, leaf).int(), leaves, _boxes(position, unit, leaf), sample)


def _halve(points: Float[Tensor, "points 3"], depth: int, generator: torch.Generator) -> Int[Tensor, " points"]:
    """Order of the points, leaf by leaf, in a k-d tree that halves each box across its longest side."""
    order = torch.arange(len(points), device=points.device)[None]
    for _ in range(depth):
        position = points[order]
        side = position.amax(dim=1) - position.amin(dim=1)
        longest = side.argmax(dim=1)[:, None, None].expand(-1, position.shape[1], 1)
        along = torch.gather(position, 2, longest).squeeze(2)
        order = torch.gather(order, 1, along.argsort(dim=1)).view(-1, order.shape[1] // 2)
    shuffled = torch.rand(order.shape, generator=generator).argsort(dim=1).to(points.device)
    return torch.gather(order, 1, shuffled).flatten()


def _boxes(
    position: Float[Tensor, "points 3"], unit: Float[Tensor, " points"], leaf: int
) -> tuple[Float[Tensor, "_ _ 8"], ...]:
    """Bounding boxes of all levels below the root, as in :class:`PointTree`."""
    levels, children = [], leaf
    low, high, largest = position, position, unit
    while True:
        low, high = low.view(-1, children, 3).amin(dim=1), high.view(-1, children, 3).amax(dim=1)
        largest = largest.view(-1, children).amax(dim=1)
        centre, half = (low + high) / 2, (high - low) / 2
        rounding = _ROUNDING * torch.finfo(half.dtype).eps * (centre.abs() + half).amax(dim=1, keepdim=True)
        one = torch.ones_like(largest[:, None])
        box = torch.cat([torch.cat([centre, one, half + rounding], dim=1) / largest[:, None], one], dim=1)
        children = min(len(box), _BOXES if levels else _LEAVES)
        levels.append(box.view(-1, children, 8))
        if children == len(box):
            return tuple(levels[::-1])


def reach(tree: PointTree, lines: Lines, radius: Float[Tensor, " lines"], most: int) -> Pairs | None:
    """Find the leaves that may hold points within each line's radius; None for more than ``most`` pairs."""
    tests = _tests(lines, radius)
    rows = torch.arange(len(radius), device=radius.device)
    pairs = [Pairs(rows[:0].int(), rows[:0].int(), radius[:0])]
    # Depth first, so that leaves come in order. The stack has (level, parent, lines that reach the parent).
    stack = [(0, 0, rows)]
    count = 0
    while stack and count <= most:
        level, parent, rows = stack.pop()
        boxes = tree.boxes[level][parent]
        margin = _margins(boxes, tests, rows)
        reached = torch.nonzero((margin >= 0).view(-1)).flatten()
        child = torch.div(reached, len(rows), rounding_mode="floor")
        line = rows.index_select(0, reached - child * len(rows))
        first = parent * len(boxes)
        if level == len(tree.boxes) - 1:
            pairs.append(Pairs(line.int(), (first + child).int(), margin.view(-1).index_select(0, reached)))
            count += len(line)
        else:
            split = line.split(torch.bincount(child, minlength=len(boxes)).tolist())
            stack += [(level + 1, first + box, split[box]) for box in reversed(range(len(boxes))) if len(split[box])]
    return None if count > most else Pairs(*map(torch.cat, zip(*pairs, strict=True)))


def _tests(lines: Lines, radius: Float[Tensor, " lines"]) -> Float[Tensor, "lines 6 8"]:
    """Six rows per line; if the line is within its radius of a box, all their products with the box are at least 0.

    Each product is the radius minus the distance of line and box along d x e_a, a direction orthogonal to the line and
    to axis a, with both signs. For a centre c and half sides h that distance is
    |(c x d - m)_a| - h_b |d_c| - h_c |d_b|, over the length of d x e_a.
    """
    direction, moment = lines
    test = direction.new_zeros(len(direction), 3, 2, 8)
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        sine = (1 - direction[:, a].square()).clamp_min(0).sqrt()
        over = torch.where(sine > _ALONG, 1 / sine, 0)
        for side, sign in enumerate((over, -over)):
            test[:, a, side, b] = sign * direction[:, c]
            test[:, a, side, c] = -sign * direction[:, b]
            test[:, a, side, 3] = -sign * moment[:, a]
            test[:, a, side, 4 + b] = over * direction[:, c].abs()
            test[:, a, side, 4 + c] = over * direction[:, b].abs()
    test[..., 7] = (1 + _ROUNDING * torch.finfo(radius.dtype).eps) * radius[:, None, None]
    return test.view(-1, 6, 8)


def _margins(
    boxes: Float[Tensor, "boxes 8"], tests: Float[Tensor, "lines 6 8"], rows: Int[Tensor, " rows"]
) -> Float[Tensor, "boxes rows"]:
    """Radius minus distance of the lines ``rows`` from boxes; negative where a line does not reach a box."""
    tiles = []
    for tile in rows.split(max(1, _TILE // len(boxes))):
        test = tests.index_select(0, tile)
        margin = boxes @ test[:, 0].T
        for side in range(1, 6):
            torch.minimum(margin, boxes @ test[:, side].T, out=margin)
        tiles.append(margin)
    return torch.cat(tiles, dim=1)
