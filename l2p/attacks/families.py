"""Neighbours among lines through a few centres: the estimates of the other families only.

Lines of one family meet in their centre and nowhere else, so that they tell nothing of each other's depth.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l2p.geometry.closest_lines import nearest_lines
from l2p.geometry.elements import Lines
from l2p.geometry.nearest import Nearest, nearest_points_to_other_lines
from l2p.work.work import Work


def other_points_near_lines(
    lines: Lines,
    points: Float[Tensor, "lines 3"],
    k: int,
    scale: Float[Tensor, " lines"],
    family: Int[Tensor, " lines"],
    work: Work,
) -> Nearest:
    """Find the k points of other families nearest to each line of this process, in units of each point's scale."""
    own = work.own(len(points))

    def searched(rows: Int[Tensor, " rows"], others: Int[Tensor, " others"]) -> Nearest:
        queries = lines.rows(own).rows(rows)
        return nearest_points_to_other_lines(queries, points[others], k, scale=scale[others])

    return _by_family(searched, family, own, k, points)


def other_points_near_points(
    points: Float[Tensor, "lines 3"], k: int, family: Int[Tensor, " lines"], work: Work
) -> Nearest:
    """Find the k points of other families nearest to the point of each line of this process."""
    from scipy.spatial import KDTree

    own, place = work.own(len(points)), points.cpu().double().numpy()

    def searched(rows: Int[Tensor, " rows"], others: Int[Tensor, " others"]) -> Nearest:
        tree, queries = KDTree(place[others.cpu().numpy()]), place[own][rows.cpu().numpy()]
        ranks: Any = range(1, min(k, len(others)) + 1)  # also one neighbour has a column
        distance, index = tree.query(queries, ranks, workers=torch.get_num_threads())
        return Nearest(
            torch.as_tensor(index, device=points.device).int(),
            torch.as_tensor(distance, device=points.device, dtype=points.dtype),
        )

    return _by_family(searched, family, own, k, points)


def other_lines_near_lines(
    lines: Lines, k: int, family: Int[Tensor, " lines"], voting: Bool[Tensor, " lines"]
) -> Int[Tensor, "lines k"]:
    """Find the k voting lines of other families nearest to each line; -1 for none."""

    def searched(rows: Int[Tensor, " rows"], others: Int[Tensor, " others"]) -> Nearest:
        near = nearest_lines(lines.rows(rows), lines.rows(others[voting[others]]), k)
        index = torch.nonzero(voting[others]).flatten()[near.index] if near.index.shape[1] else near.index
        return Nearest(index.int().masked_fill(near.distance.isinf(), -1), near.distance)

    return _by_family(searched, family, slice(0, len(family)), k, lines.direction).index


def _by_family(
    search: Callable[[Int[Tensor, " rows"], Int[Tensor, " others"]], Nearest],
    family: Int[Tensor, " lines"],
    own: slice,
    k: int,
    like: Tensor,
) -> Nearest:
    """Search for each family among the others; fewer than k neighbours are padded."""
    index = torch.full((own.stop - own.start, k), -1, dtype=torch.int32, device=like.device)
    distance = like.new_full(index.shape, torch.inf)
    for number in range(int(family.max()) + 1):
        rows, others = (torch.nonzero(mask).flatten() for mask in (family[own] == number, family != number))
        if not len(rows) or not len(others):
            continue
        near = search(rows, others)
        width = near.index.shape[1]
        found = others[near.index.clamp_min(0).long()].int().masked_fill(near.index < 0, -1)
        index[rows, :width], distance[rows, :width] = found, near.distance
    return Nearest(index, distance)
