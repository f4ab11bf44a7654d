"""The surface that the estimates around a place lie on, though each of them errs along its own line.

An estimate that is wrong is wrong along its line. Where the line runs along the surface that takes it nowhere, where
the line is steep it takes it off the surface: so estimates whose lines are steep count for less, as in generalised
least squares with an error along each line and a roughness of the surface in all directions. Estimates far off the
surface belong to another one, or are lost, and count for less, too (Cauchy's weights). Both depend on the surface, so
that it is fitted again a few times, first with all alike.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.geometry import picked

#: Fits after the first one.
_REFITS = 4
#: Variance across a surface that is not error of the estimates, over that error along the lines.
_ROUGHNESS = 0.03
#: Variance across a surface at which an estimate counts half, over the usual one.
_DOUBT = 0.5
#: What an estimate counts at the least, beside its confidence.
_LEAST = 0.05
#: A line nearer to parallel with a surface than this (cosine to the normal) is taken to cut it at this slope.
_GRAZING = 0.05


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
    points: Float[Tensor, "lines k 3"], direction: Float[Tensor, "lines k 3"], confidence: Float[Tensor, "lines k"]
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
    sure = confidence + _LEAST
    # Counted from one of them, so that single precision is enough.
    corner = points[:, :1]
    plane = _weighted(points - corner, sure)
    for _ in range(_REFITS):
        plane = _weighted(points - corner, sure * _trust(points - corner, direction, plane))
    value = (plane.variance / plane.variance[:, 2:].clamp_min(1e-30)).to(points.dtype)
    return Surface(
        centre=plane.centre + corner[:, 0],
        normal=plane.normal,
        planarity=value[:, 1] - value[:, 0],
        linearity=1 - value[:, 1],
    )


class _Plane(NamedTuple):
    """Weighted mean, normal, and the variances along the principal axes, least first."""

    centre: Float[Tensor, "lines 3"]
    normal: Float[Tensor, "lines 3"]
    variance: Float[Tensor, "lines 3"]


def _weighted(points: Float[Tensor, "lines k 3"], weight: Float[Tensor, "lines k"]) -> _Plane:
    """The plane with the least weighted sum of squared distances."""
    share = (weight / weight.sum(dim=1, keepdim=True))[:, :, None]
    centre = (share * points).sum(dim=1, keepdim=True)
    apart = points - centre
    spread = (share * apart).transpose(1, 2) @ apart
    variance, axes = torch.linalg.eigh(spread.double())
    return _Plane(centre[:, 0], axes[:, :, 0].to(points.dtype), variance)


def _trust(
    points: Float[Tensor, "lines k 3"], direction: Float[Tensor, "lines k 3"], plane: _Plane
) -> Float[Tensor, "lines k"]:
    """How much each estimate says of a surface, if that is about where ``plane`` is."""
    normal = plane.normal[:, :, None]
    steep2 = (direction @ normal)[..., 0].square()
    off2 = ((points - plane.centre[:, None]) @ normal)[..., 0].square()
    usual2 = plane.variance[:, :1].to(points.dtype).clamp_min(1e-30) * _DOUBT
    return _ROUGHNESS / (_ROUGHNESS + steep2) / (1 + off2 / usual2)


def crossing(surface: Surface, direction: Tensor, foot: Tensor, *others: Tensor) -> Crossing:
    """How the lines of ``direction`` meet surfaces; ``foot`` and ``others`` are places."""
    slope = (surface.normal * direction).sum(-1)
    slope = torch.where(slope.abs() < _GRAZING, torch.where(slope < 0, -_GRAZING, _GRAZING), slope)
    off = [((place - surface.centre) * surface.normal).sum(-1) for place in (foot, *others)]
    return Crossing(slope, -off[0] / slope, off)
