"""Pair geometry of lines in Plücker coordinates (``docs/how-it-works.md``, "Votes").

With c = d_i . d_j and feet o_i = d_i x m_i:

- line-line distance |d_i . m_j + d_j . m_i| / sqrt(1 - c^2),
- the point of l_i closest to l_j at beta_ij = (o_j . d_i + c o_i . d_j) / (1 - c^2), since o_i . d_i = 0,
- the point of l_i with the least squared distance to several l_j: the mean of beta_ij weighted by 1 - c^2,
- distance of a point p to l_i: |p x d_i - m_i|.

Pairs with an angle below ``PARALLEL`` have no closest point: they are masked, never given distance 0.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l2p.geometry.elements import Lines

#: Smallest sine of the angle of a pair that has a closest point (0.06 degrees).
PARALLEL = 1e-3


class Votes(NamedTuple):
    """Positions along each line that its neighbours vote for; ``valid`` is False where there is no vote."""

    beta: Float[Tensor, "lines k"]
    valid: Bool[Tensor, "lines k"]


def closest_points(lines: Lines, others: Lines, neighbors: Int[Tensor, "lines k"]) -> Votes:
    """Position of each line's closest point to its neighbours: beta_ij for j = ``neighbors[i]`` among ``others``.

    A neighbour of -1, or one parallel to the line, gives no vote (``valid`` False, beta 0).
    """
    product = _products(lines.direction, lines.foot, others.direction, others.foot, neighbors)
    sine2 = 1 - product.cosine.square()
    valid = (neighbors >= 0) & (sine2 > PARALLEL**2)
    beta = (product.other_first + product.cosine * product.first_other) / sine2.clamp_min(PARALLEL**2)
    return Votes(beta.masked_fill(~valid, 0), valid)


def least_squares_points(
    lines: Lines, others: Lines, neighbors: Int[Tensor, "lines k"], weight: Float[Tensor, "lines k"]
) -> Float[Tensor, " lines"]:
    """Position of the point of each line with the least weighted sum of squared distances to its neighbours.

    It is the mean of the closest points beta_ij with weights w_ij sin^2 of the angle: the nearer to parallel, the less
    a neighbour says. Neighbours without a vote do not count; without any vote, it is 0, the foot.
    """
    product = _products(lines.direction, lines.foot, others.direction, others.foot, neighbors)
    sine2 = 1 - product.cosine.square()
    weight = weight * ((neighbors >= 0) & (sine2 > PARALLEL**2))
    # sin^2 cancels the denominator of beta_ij.
    moved = (weight * (product.other_first + product.cosine * product.first_other)).sum(dim=1)
    total = (weight * sine2).sum(dim=1)
    return torch.where(total > 0, moved / total.clamp_min(torch.finfo(total.dtype).tiny), 0.0)


def line_line_distance(lines: Lines, others: Lines, neighbors: Int[Tensor, "lines k"]) -> Float[Tensor, "lines k"]:
    """Distance |reciprocal product| / sine of the angle; infinite for a neighbour of -1 and for parallel lines."""
    product = _products(lines.direction, lines.moment, others.direction, others.moment, neighbors)
    sine2 = 1 - product.cosine.square()
    distance = (product.other_first + product.first_other).abs() / sine2.clamp_min(PARALLEL**2).sqrt()
    return distance.masked_fill((neighbors < 0) | (sine2 <= PARALLEL**2), torch.inf)


class _Products(NamedTuple):
    cosine: Float[Tensor, "lines k"]
    other_first: Float[Tensor, "lines k"]
    first_other: Float[Tensor, "lines k"]


def _products(
    direction: Float[Tensor, "lines 3"],
    second: Float[Tensor, "lines 3"],
    other_direction: Float[Tensor, "others 3"],
    other_second: Float[Tensor, "others 3"],
    neighbors: Int[Tensor, "lines k"],
) -> _Products:
    """Products d_i . d_j, d_i . s_j and s_i . d_j for j = ``neighbors[i]``: a gather and a small product per line."""
    table = torch.cat([other_direction, other_second], dim=1)
    # (lines, k, 6), also if the table is empty.
    gathered = table[neighbors.clamp_min(0).flatten().long()].view(*neighbors.shape, 6)
    factors = direction.new_zeros(len(direction), 6, 3)
    factors[:, :3, 0] = direction
    factors[:, 3:, 1] = direction
    factors[:, :3, 2] = second
    product = torch.bmm(gathered, factors)
    return _Products(*product.unbind(-1))


def feet(lines: Lines, points: Float[Tensor, "points 3"], neighbors: Int[Tensor, "lines k"]) -> Votes:
    """Feet f_ij of the neighbours' points on each line; a neighbour of -1 gives no vote."""
    valid = neighbors >= 0
    gathered = points[neighbors.clamp_min(0).flatten().long()].view(*neighbors.shape, 3)
    # o . d = 0, so the foot of p is at p . d.
    beta = torch.bmm(gathered, lines.direction[:, :, None]).squeeze(-1)
    return Votes(beta.masked_fill(~valid, 0), valid)


def point_line_distance(
    points: Float[Tensor, "*pairs 3"], direction: Float[Tensor, "*pairs 3"], moment: Float[Tensor, "*pairs 3"]
) -> Float[Tensor, "*pairs"]:
    """Distance |p x d - m|, which stays accurate for points far from the frame's origin."""
    return (torch.linalg.cross(points, direction) - moment).norm(dim=-1)
