"""The surface that the estimates around a place lie on, though each of them errs along its own line.

An estimate that is wrong is wrong along its line. Where the line runs along the surface that takes it nowhere, where
the line is steep it takes it off the surface: so estimates whose lines are steep count for less, as in generalised
least squares with an error along each line and a roughness of the surface in all directions. Estimates far off the
surface belong to another one, or are lost, and count for less, too (Cauchy's weights). Both depend on the surface, so
that it is fitted again a few times, first with all alike.
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

#: Two axes count as equally short below this difference of their variances, against the greatest.
_ALIKE = 1e-9


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
    """Planes: a point on each, its normal, and how flat (0 to 1) and how straight (0 to 1) the estimates there lie."""

    centre: Float[Tensor, "*lines 3"]
    normal: Float[Tensor, "*lines 3"]
    planarity: Float[Tensor, "*lines"]
    linearity: Float[Tensor, "*lines"]

    def at(self, index: Int[Tensor, "rows k"]) -> Surface:
        """Those of some lines."""
        return Surface(*(picked(column, index) for column in self))


class Crossing(NamedTuple):
    """How lines meet surfaces: cosine to the normal, where they cut them, counted from the foot, and how far some
    places are off them."""

    slope: Float[Tensor, "rows k"]
    cut: Float[Tensor, "rows k"]
    off: list[Float[Tensor, "rows k"]]


def fitted(
    points: Float[Tensor, "lines k 3"],
    direction: Float[Tensor, "lines k 3"],
    confidence: Float[Tensor, "lines k"],
    config: SurfaceConfig,
) -> Surface:
    """The surface of k estimates each; the more confident ones count for more.

    Parameters
    ----------
    points : (lines, k, 3)
    direction : (lines, k, 3)
        Of the line of each estimate.
    confidence : (lines, k)
        In [0, 1].
    """
    weight = confidence + config.least
    # Counted from their middle, so that single precision is enough; one axis after the other, in the order of memory.
    middle = points.mean(dim=1, keepdim=True)
    place = (points - middle).permute(2, 0, 1).contiguous()
    way = direction.permute(2, 0, 1).contiguous()
    x, y, z = place
    products = [x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
    plane = _weighted(products, weight)
    for _ in range(config.refits):
        plane = _weighted(products, weight * _trust(place, way, plane, config))
    value = (plane.variance / plane.variance[:, 2:].clamp_min(1e-30)).to(points.dtype)
    return Surface(
        centre=plane.centre + middle[:, 0],
        normal=plane.normal,
        planarity=value[:, 1] - value[:, 0],
        linearity=1 - value[:, 1],
    )


class _Plane(NamedTuple):
    """Weighted mean, normal, and the variances along the principal axes, least first."""

    centre: Float[Tensor, "lines 3"]
    normal: Float[Tensor, "lines 3"]
    variance: Float[Tensor, "lines 3"]


def _weighted(products: Sequence[Float[Tensor, "lines k"]], weight: Float[Tensor, "lines k"]) -> _Plane:
    """The plane with the least weighted sum of squared distances; ``products`` are x, y, z, xx, yy, zz, xy, xz, yz of
    the points."""
    total = weight.sum(dim=1, keepdim=True)
    sums = torch.stack([torch.linalg.vecdot(weight, product) for product in products], dim=1)
    centre, squares, mixed = (sums.double() / total).split(3, dim=1)
    x, y, z = centre.unbind(dim=1)
    variance, normal = least_axis(squares - centre.square(), mixed - torch.stack([x * y, x * z, y * z], dim=1))
    return _Plane(centre.to(weight.dtype), normal.to(weight.dtype), variance)


def least_axis(
    diagonal: Float[Tensor, "lines 3"], mixed: Float[Tensor, "lines 3"]
) -> tuple[Float[Tensor, "lines 3"], Float[Tensor, "lines 3"]]:
    """Eigenvalues of symmetric matrices, rising and at least 0, and the unit eigenvector of the least one.

    In closed form (Smith, Communications of the ACM 4, 1961), for thousands of them at a time; ``torch.linalg.eigh``
    takes one after the other.

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
    # Rows of the matrix less the least eigenvalue: each is at right angles to the axis.
    (a, b, c), (p, q, r) = (diagonal - value[:, :1]).unbind(dim=1), mixed.unbind(dim=1)
    rows = torch.stack([a, p, q, p, b, r, q, r, c], dim=1).view(-1, 3, 3)
    pairs = torch.linalg.cross(rows, rows.roll(-1, dims=1))
    across, most = _longest(pairs)
    # Where two axes are equally short, only one row tells anything, and all at right angles to it will do.
    row, length = _longest(rows)
    other = crosswise(row)
    beside = torch.linalg.cross(row, other)
    beside = torch.where(length[:, None] > 0, beside, other)
    axis = torch.where((most > _ALIKE * length.square())[:, None], across, beside)
    return value.clamp_min(0), torch.nn.functional.normalize(axis, dim=1, eps=0.0)


def _determinant(diagonal: Float[Tensor, "lines 3"], mixed: Float[Tensor, "lines 3"]) -> Float[Tensor, " lines"]:
    (a, b, c), (p, q, r) = diagonal.unbind(dim=1), mixed.unbind(dim=1)
    return a * (b * c - r * r) - p * (p * c - r * q) + q * (p * r - b * q)


def _longest(vectors: Float[Tensor, "lines some 3"]) -> tuple[Float[Tensor, "lines 3"], Float[Tensor, " lines"]]:
    """The longest vector of each line, and its length."""
    length, place = vectors.norm(dim=2).max(dim=1)
    return vectors.gather(1, place[:, None, None].expand(-1, 1, 3))[:, 0], length


def _trust(
    place: Float[Tensor, "3 lines k"], way: Float[Tensor, "3 lines k"], plane: _Plane, config: SurfaceConfig
) -> Float[Tensor, "lines k"]:
    """How much each estimate says of a surface, if that is about where ``plane`` is."""
    steep = _along(plane.normal, way)
    off = _along(plane.normal, place).sub_((plane.centre * plane.normal).sum(dim=1, keepdim=True))
    usual2 = plane.variance[:, :1].to(way.dtype).clamp_min(1e-30) * config.doubt
    return config.roughness / (steep.square_().add_(config.roughness) * off.square_().div_(usual2).add_(1))


def _along(normal: Float[Tensor, "lines 3"], vectors: Float[Tensor, "3 lines k"]) -> Float[Tensor, "lines k"]:
    """Products of a normal of each line with k vectors."""
    x, y, z = normal[:, :, None].unbind(dim=1)
    return (vectors[0] * x).addcmul_(vectors[1], y).addcmul_(vectors[2], z)


def crossing(
    surface: Surface, direction: Tensor, foot: Tensor, closest: Tensor, own: Tensor, grazing: float
) -> Crossing:
    """Cut lines with surfaces; ``foot``, ``closest`` and ``own`` are points on the lines.

    ``grazing`` is the least absolute cosine to the normal; lines at a shallower angle are clamped to it.
    """
    slope = (surface.normal * direction).sum(-1)
    slope = torch.where(slope.abs() < grazing, torch.where(slope < 0, -grazing, grazing), slope)
    off = [((place - surface.centre) * surface.normal).sum(-1) for place in (foot, closest, own)]
    return Crossing(slope, -off[0] / slope, off)
