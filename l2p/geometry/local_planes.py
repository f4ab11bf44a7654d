"""Planes fitted to estimates that each err along their own line.

An error along a line that runs within the surface does no harm; along a steep line it moves the estimate off the
surface. So estimates on steep lines get less weight, as in generalised least squares with an error variance along each
line and a roughness of the surface in all directions. Estimates far off the surface belong to another one or are
outliers, and get less weight, too (Cauchy's weights). Both weights depend on the plane, so the fit is repeated a few
times, first without them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.geometry.elements import crosswise, picked

#: Two least variances count as equal if they differ by less than this share of the greatest.
_EQUAL = 1e-9


@dataclass(frozen=True)
class SurfaceConfig:
    """How surfaces are fitted.

    Attributes
    ----------
    refits : int
        Fits after the first one, each with the weights that follow from the fit before.
    roughness : float
        Variance of the surface itself over the variance of the estimates along their lines.
    doubt : float
        Cauchy scale: an estimate has weight 1/2 at this multiple of the usual variance across the surface.
    least : float
        Weight of an estimate beside its confidence.
    """

    refits: int = 4
    roughness: float = 0.03
    doubt: float = 0.5
    least: float = 0.05


class Surface(NamedTuple):
    """Planes: a point on each, unit normals, and planarity and linearity (0 to 1) of the estimates there."""

    centre: Float[Tensor, "*lines 3"]
    normal: Float[Tensor, "*lines 3"]
    planarity: Float[Tensor, "*lines"]
    linearity: Float[Tensor, "*lines"]

    def at(self, index: Int[Tensor, "rows k"]) -> Surface:
        """Select the planes of some lines."""
        return Surface(*(picked(column, index) for column in self))


class Crossing(NamedTuple):
    """Intersections of lines with planes: ``slope`` is the cosine to the normal, ``cut`` the position along the line
    from its foot, ``off`` the signed distances from the plane of the foot and of other points."""

    slope: Float[Tensor, "rows k"]
    cut: Float[Tensor, "rows k"]
    off: list[Float[Tensor, "rows k"]]


def fitted(
    points: Float[Tensor, "lines k 3"],
    direction: Float[Tensor, "lines k 3"],
    confidence: Float[Tensor, "lines k"],
    config: SurfaceConfig,
) -> Surface:
    """Fit a plane to each k estimates, weighted by confidence.

    Parameters
    ----------
    points : (lines, k, 3)
        The estimates.
    direction : (lines, k, 3)
        Direction of the line of each estimate.
    confidence : (lines, k)
        In [0, 1].
    """
    weight = confidence + config.least
    # Relative to their mean, so that single precision is enough; axes first, so that each is contiguous.
    mean = points.mean(dim=1, keepdim=True)
    position = (points - mean).permute(2, 0, 1).contiguous()
    direction = direction.permute(2, 0, 1).contiguous()
    x, y, z = position
    products = [x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
    plane = _weighted(products, weight)
    for _ in range(config.refits):
        plane = _weighted(products, weight * _reweighted(position, direction, plane, config))
    value = (plane.variance / plane.variance[:, 2:].clamp_min(1e-30)).to(points.dtype)
    return Surface(
        centre=plane.centre + mean[:, 0],
        normal=plane.normal,
        planarity=value[:, 1] - value[:, 0],
        linearity=1 - value[:, 1],
    )


class _Plane(NamedTuple):
    """Weighted mean, unit normal, and variances along the principal axes, least first."""

    centre: Float[Tensor, "lines 3"]
    normal: Float[Tensor, "lines 3"]
    variance: Float[Tensor, "lines 3"]


def _weighted(products: Sequence[Float[Tensor, "lines k"]], weight: Float[Tensor, "lines k"]) -> _Plane:
    """Weighted least-squares planes; ``products`` are x, y, z, xx, yy, zz, xy, xz, yz of the points."""
    total = weight.sum(dim=1, keepdim=True)
    sums = torch.stack([torch.linalg.vecdot(weight, product) for product in products], dim=1)
    centre, squares, mixed = (sums.double() / total).split(3, dim=1)
    x, y, z = centre.unbind(dim=1)
    variance, normal = least_axis(squares - centre.square(), mixed - torch.stack([x * y, x * z, y * z], dim=1))
    return _Plane(centre.to(weight.dtype), normal.to(weight.dtype), variance)


def least_axis(
    diagonal: Float[Tensor, "lines 3"], mixed: Float[Tensor, "lines 3"]
) -> tuple[Float[Tensor, "lines 3"], Float[Tensor, "lines 3"]]:
    """Eigenvalues of symmetric matrices, ascending and at least 0, and the unit eigenvector of the least one.

    In closed form (Smith, Communications of the ACM 4, 1961), for all matrices at once; ``torch.linalg.eigh`` takes
    one after the other.

    Parameters
    ----------
    diagonal : (lines, 3)
        xx, yy, zz.
    mixed : (lines, 3)
        xy, xz, yz.
    """
    mean = diagonal.mean(dim=1, keepdim=True)
    beyond = diagonal - mean
    size = ((beyond.square().sum(dim=1) + 2 * mixed.square().sum(dim=1)) / 6).sqrt()
    unit = size.clamp_min(torch.finfo(size.dtype).tiny ** 0.25)[:, None]
    angle = torch.acos((_determinant(beyond / unit, mixed / unit) / 2).clamp(-1, 1)) / 3
    turns = angle.new_tensor([2 * math.pi / 3, -2 * math.pi / 3, 0.0])
    value = mean + 2 * size[:, None] * torch.cos(angle[:, None] + turns)
    # Rows of the matrix minus the least eigenvalue: all are orthogonal to the axis.
    (a, b, c), (p, q, r) = (diagonal - value[:, :1]).unbind(dim=1), mixed.unbind(dim=1)
    rows = torch.stack([a, p, q, p, b, r, q, r, c], dim=1).view(-1, 3, 3)
    pairs = torch.linalg.cross(rows, rows.roll(-1, dims=1))
    across, most = _longest(pairs)
    # If the two least eigenvalues are equal, all rows are parallel, and any direction orthogonal to them is an axis.
    row, length = _longest(rows)
    other = crosswise(row)
    beside = torch.linalg.cross(row, other)
    beside = torch.where(length[:, None] > 0, beside, other)
    axis = torch.where((most > _EQUAL * length.square())[:, None], across, beside)
    return value.clamp_min(0), torch.nn.functional.normalize(axis, dim=1, eps=0.0)


def _determinant(diagonal: Float[Tensor, "lines 3"], mixed: Float[Tensor, "lines 3"]) -> Float[Tensor, " lines"]:
    (a, b, c), (p, q, r) = diagonal.unbind(dim=1), mixed.unbind(dim=1)
    return a * (b * c - r * r) - p * (p * c - r * q) + q * (p * r - b * q)


def _longest(vectors: Float[Tensor, "lines some 3"]) -> tuple[Float[Tensor, "lines 3"], Float[Tensor, " lines"]]:
    """The longest vector of each line, and its length."""
    length, index = vectors.norm(dim=2).max(dim=1)
    return vectors.gather(1, index[:, None, None].expand(-1, 1, 3))[:, 0], length


def _reweighted(
    position: Float[Tensor, "3 lines k"], direction: Float[Tensor, "3 lines k"], plane: _Plane, config: SurfaceConfig
) -> Float[Tensor, "lines k"]:
    """Factors on the weights of the estimates, given the plane of the last fit."""
    steep = _along(plane.normal, direction)
    off = _along(plane.normal, position).sub_((plane.centre * plane.normal).sum(dim=1, keepdim=True))
    scale2 = plane.variance[:, :1].to(direction.dtype).clamp_min(1e-30) * config.doubt
    return config.roughness / (steep.square_().add_(config.roughness) * off.square_().div_(scale2).add_(1))


def _along(normal: Float[Tensor, "lines 3"], vectors: Float[Tensor, "3 lines k"]) -> Float[Tensor, "lines k"]:
    """Dot products of each line's normal with its k vectors."""
    x, y, z = normal[:, :, None].unbind(dim=1)
    return (vectors[0] * x).addcmul_(vectors[1], y).addcmul_(vectors[2], z)


def crossing(
    surface: Surface, direction: Tensor, foot: Tensor, closest: Tensor, own: Tensor, grazing: float
) -> Crossing:
    """Intersect lines with planes; ``closest`` and ``own`` are more points whose distances from the planes are wanted.

    ``grazing`` is the least absolute cosine to the normal; lines at a shallower angle are clamped to it.
    """
    slope = (surface.normal * direction).sum(-1)
    slope = torch.where(slope.abs() < grazing, torch.where(slope < 0, -grazing, grazing), slope)
    off = [((point - surface.centre) * surface.normal).sum(-1) for point in (foot, closest, own)]
    return Crossing(slope, -off[0] / slope, off)
