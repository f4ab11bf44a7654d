"""Points in the leaves of a k-d tree, and the leaves that lines reach.

A line reaches a box if its distance to it is no more than the line's radius, counted in units of the largest scale of
the points inside: then a point inside may be within the radius, in units of its own scale. Boxes are met level by
level, the children of each with all the lines that reach it, by matrix products.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.geometry.elements import Lines

#: Most points of a leaf; a leaf holds at least half of that.
LEAF = 32
#: Most children of a box, where these are leaves and where they are boxes.
_LEAVES, _BOXES = 32, 16
#: Points in the sample of all.
_SAMPLE = 2048
#: Products of boxes and lines in one tile, which fits the cache.
_TILE = 1 << 16
#: Lines with a smaller sine to an axis are not tested along it: too few digits are left.
_ALONG = 1e-2
#: Relative error of a few operations, in units of the last digit.
_ROUNDING = 32


class PointTree(NamedTuple):
    """Points in the leaves of a k-d tree.

    ``points`` are (x, y, z, 1) / scale, nan for padding; ``index`` says which they are. Inside a leaf they come in
    random order. ``boxes`` has, level by level from the root's children to the leaves, the children of each box:
    (centre, 1, half sides) / largest scale, and 1. ``sample`` are some of the points, evenly from the whole tree.
    """

    index: Int[Tensor, "leaves leaf"]
    points: Float[Tensor, "leaves 4 leaf"]
    boxes: tuple[Float[Tensor, "_ _ 8"], ...]
    sample: Float[Tensor, "4 sample"]


class Pairs(NamedTuple):
    """Leaves that lines reach, leaf after leaf; with a radius smaller by more than ``margin`` a line would not."""

    line: Int[Tensor, " pairs"]
    leaf: Int[Tensor, " pairs"]
    margin: Float[Tensor, " pairs"]


def plant(points: Float[Tensor, "points 3"], scale: Float[Tensor, " points"]) -> PointTree:
    """The tree of some points, whose distances count in units of ``scale``; O(points log^2 points) time."""
    count = len(points)
    depth = max(0, math.ceil(math.log2(count / LEAF)))
    leaf = -(-count >> depth)
    generator = torch.Generator().manual_seed(0)
    # For leaves of the same size some points come twice; the second time they are padding.
    again = torch.randperm(count, generator=generator)[: (leaf << depth) - count]
    index = torch.cat([torch.arange(count), again]).to(points.device)
    order = _halve(points[index], depth, generator)
    index, padding = index[order], order >= count
    place, unit = points[index], scale[index]
    factor = torch.cat([place, torch.ones_like(place[:, :1])], dim=1) / unit[:, None]
    stride = -(-len(index) // _SAMPLE)
    begin = torch.arange(0, len(index) - stride + 1, stride)
    some = begin + torch.randint(0, stride, begin.shape, generator=generator)
    sample = factor[some.to(index.device)].T.contiguous()
    factor[padding] = torch.nan
    leaves = factor.view(-1, leaf, 4).mT.contiguous()
    return PointTree(index.view(-1, leaf).int(), leaves, _boxes(place, unit, leaf), sample)


def _halve(points: Float[Tensor, "points 3"], depth: int, generator: torch.Generator) -> Int[Tensor, " points"]:
    """The order that puts the leaves of a k-d tree one after the other: boxes are halved across their longest side."""
    order = torch.arange(len(points), device=points.device)[None]
    for _ in range(depth):
        place = points[order]
        side = place.amax(dim=1) - place.amin(dim=1)
        longest = side.argmax(dim=1)[:, None, None].expand(-1, place.shape[1], 1)
        along = torch.gather(place, 2, longest).squeeze(2)
        order = torch.gather(order, 1, along.argsort(dim=1)).view(-1, order.shape[1] // 2)
    shuffled = torch.rand(order.shape, generator=generator).argsort(dim=1).to(points.device)
    return torch.gather(order, 1, shuffled).flatten()


def _boxes(
    place: Float[Tensor, "points 3"], unit: Float[Tensor, " points"], leaf: int
) -> tuple[Float[Tensor, "_ _ 8"], ...]:
    """The bounding boxes of all levels below the root."""
    levels, children = [], leaf
    low, high, largest = place, place, unit
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
    """The leaves that may hold points within the radius of each line; None where there are more than ``most``."""
    tests = _tests(lines, radius)
    rows = torch.arange(len(radius), device=radius.device)
    parts = [Pairs(rows[:0].int(), rows[:0].int(), radius[:0])]
    # Boxes are taken depth first, so that the leaves come in their order: (level, parent, lines that reach it).
    left = [(0, 0, rows)]
    found = 0
    while left and found <= most:
        level, parent, rows = left.pop()
        boxes = tree.boxes[level][parent]
        margin = _margins(boxes, tests, rows)
        reached = torch.nonzero((margin >= 0).view(-1)).flatten()
        child = torch.div(reached, len(rows), rounding_mode="floor")
        line = rows.index_select(0, reached - child * len(rows))
        first = parent * len(boxes)
        if level == len(tree.boxes) - 1:
            parts.append(Pairs(line.int(), (first + child).int(), margin.view(-1).index_select(0, reached)))
            found += len(line)
        else:
            some = line.split(torch.bincount(child, minlength=len(boxes)).tolist())
            left += [(level + 1, first + box, some[box]) for box in reversed(range(len(boxes))) if len(some[box])]
    return None if found > most else Pairs(*map(torch.cat, zip(*parts, strict=True)))


def _tests(lines: Lines, radius: Float[Tensor, " lines"]) -> Float[Tensor, "lines 6 8"]:
    """Six rows for each line, whose products with a box are all positive if the line keeps within its radius of it.

    Each product is the radius less the distance of line and box along a direction d x e_a that is across the line and
    an axis, one way and the other. For a centre c and half sides h that distance is
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
    """By how much some of the lines reach boxes, negative if they do not."""
    parts = []
    for part in rows.split(max(1, _TILE // len(boxes))):
        test = tests.index_select(0, part)
        margin = boxes @ test[:, 0].T
        for side in range(1, 6):
            torch.minimum(margin, boxes @ test[:, side].T, out=margin)
        parts.append(margin)
    return torch.cat(parts, dim=1)
