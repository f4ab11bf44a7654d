"""The working frame: a centre, axes and a unit computed from the lines alone.

Attacks compute in this frame, so their answer does not depend on the position, rotation and scale of the scene, and
single precision is enough however far the scene is from its origin.

Attacks choose between positions that are almost equally good, and every choice changes the votes of the next round: a
difference in the last digit grows until it is visible (``docs/experiments.md``, "Invariance"). So lines that are equal
up to a similarity, their order and their signs must enter as the *same numbers*. The frame is computed in double
precision, directions get a canonical sign, and coordinates are rounded to ``DIGITS`` binary digits, which removes
almost all rounding errors of double precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from l2p.geometry.elements import Lines
from l2p.maps.lines import LineCloud
from l2p.maps.short_repr import short_repr

#: Binary digits after the point that rounding leaves to directions and to feet in frame units (fewer to feet beyond 1
#: unit): 2^-22 of the unit is far below any spacing.
DIGITS = 22
#: Most steps in the search of the centre, and the step, over the typical distance of the lines, at which it stops.
_ROUNDS = 100
_TOLERANCE = 1e-15
#: The typical distance is the mean, unless it exceeds the median by this factor.
_HEAVY = 100.0
#: Most first points of the search, and the distance, over the median distance of the lines, from which its result is
#: the first point of another search.
_STARTS, _NEAR = 3, 1e3


@dataclass(frozen=True, eq=False)
class Frame:
    """``x_frame = (x_scene - center) @ axes / unit``.

    Attributes
    ----------
    center : (3,) float64
        The point with the least sum of distances to the lines, scene units.
    unit : float
        Median distance of the lines from the centre, scene units.
    axes : (3, 3) float64
        Right-handed axes as columns: principal axes of the feet of the lines (distant feet damped), pointing in the
        direction of their skewness.
    """

    center: Float[np.ndarray, "3"]
    unit: float
    axes: Float[np.ndarray, "3 3"]

    __repr__ = short_repr

    @classmethod
    def of(cls, cloud: LineCloud) -> Frame:
        """Compute the frame of a line cloud.

        Notes
        -----
        The centre is that of :func:`middle`. Lines whose points lie far from all others hardly move it, and not the
        unit, as long as they are fewer than half; :mod:`l2p.geometry.parts` finds parts of a map that lie far apart.
        """
        center, step, foot = _middle(cloud.direction, cloud.moment)
        median = float(np.median(_distance(cloud.direction, foot, step)))
        size = np.abs(foot).max(axis=1, initial=0.0)
        # Lines that all meet in the centre have only rounding for a median.
        unit = median if median > 1e-12 * np.median(size) else (float(size.max(initial=0.0)) or 1.0)
        return cls.about(cloud, center, unit)

    @classmethod
    def about(cls, cloud: LineCloud, center: Float[np.ndarray, "3"], unit: float) -> Frame:
        """Compute the axes of a frame whose centre and unit are given."""
        across = np.cross(cloud.direction, cloud.moment - np.cross(center, cloud.direction))
        return cls(center, unit, _axes(across / unit))

    def as_dict(self) -> dict[str, Any]:
        """Plain values; in JSON they keep every bit."""
        return {"center": self.center.tolist(), "unit": self.unit, "axes": self.axes.tolist()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Frame:
        """The frame of :meth:`as_dict`."""
        return cls(np.array(values["center"]), values["unit"], np.array(values["axes"]))

    def enter(self, cloud: LineCloud, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Lines:
        """Transform lines into this frame, with canonical signs and rounded; computed in double precision."""
        direction, sign = self._directions(cloud)
        direction *= sign
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        foot = np.cross(cloud.direction, cloud.moment - np.cross(self.center, cloud.direction)) @ self.axes / self.unit
        size = np.exp2(np.ceil(np.log2(np.maximum(np.abs(foot).max(axis=1, keepdims=True), 1.0))))
        moment = np.cross(_rounded(foot, size), direction)
        return Lines(*(torch.as_tensor(column, dtype=dtype, device=device) for column in (direction, moment)))

    def enter_points(
        self,
        points: Float[np.ndarray, "points 3"],
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> Float[Tensor, "points 3"]:
        """Transform scene points into this frame."""
        return torch.as_tensor((points - self.center) @ self.axes / self.unit, dtype=dtype, device=device)

    def leave(self, cloud: LineCloud, beta: Float[Tensor, " lines"]) -> Float[np.ndarray, " lines"]:
        """Convert positions along the lines from this frame (its feet and unit) to the scene (its feet and unit)."""
        along = cloud.direction @ self.center
        return along + self.unit * self._directions(cloud)[1][:, 0] * beta.double().cpu().numpy()

    def _directions(self, cloud: LineCloud) -> tuple[Float[np.ndarray, "lines 3"], Float[np.ndarray, "lines 1"]]:
        """Rounded directions in this frame, and the signs (-1 or 1) that make them canonical."""
        direction = _rounded(cloud.direction @ self.axes, 1.0)
        return direction, _sign(direction)


def middle(direction: Float[np.ndarray, "lines 3"], moment: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "3"]:
    """The point with the least sum of distances to the lines.

    Notes
    -----
    Iteratively reweighted least squares (Weiszfeld) on sum_i |(I - d d^T)(x - o_i)|, O(lines) per step. Parallel
    lines and a single line leave a direction free; there, the step is the one of least norm from the mean foot.
    """
    return _middle(direction, moment)[0]


def _middle(
    direction: Float[np.ndarray, "lines 3"], moment: Float[np.ndarray, "lines 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "lines 3"]]:
    """The same, its step from a point amid the lines, and the feet of the lines relative to that point."""
    start = meeting_point(direction, np.cross(direction, moment), np.ones(len(direction)))
    for _ in range(_STARTS):
        # Feet relative to a point amid the lines, so that no digits are lost far from the origin.
        foot = np.cross(direction, moment - np.cross(start, direction))
        step = _step(direction, foot)
        typical = float(np.median(_distance(direction, foot, step)))
        # A few lines far away draw the first point, of least squares, away from all others.
        if np.linalg.norm(step) <= _NEAR * typical:
            break
        start = start + step
    return start + step, step, foot


def _step(direction: Float[np.ndarray, "lines 3"], foot: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "3"]:
    """The point with the least sum of distances to lines whose feet are near the origin."""
    step = np.zeros(3)
    for _ in range(_ROUNDS):
        distance = _distance(direction, foot, step)
        typical = _typical(distance)
        # The floor keeps the weights of lines that pass through the centre itself, and their sum, finite.
        weight = 1 / np.maximum(distance, 1e-6 * typical + np.finfo(float).tiny ** 0.5)
        moved = meeting_point(direction, foot, weight)
        done = np.linalg.norm(moved - step) <= _TOLERANCE * typical
        step = moved
        if done:
            break
    return step


def _typical(distance: Float[np.ndarray, " lines"]) -> float:
    """Mean distance of the lines; the median, if far lines make the mean many times as large."""
    mean, median = float(distance.mean()), float(np.median(distance))
    return mean if mean <= _HEAVY * median or median == 0 else median


def _rounded(
    value: Float[np.ndarray, "lines 3"], size: float | Float[np.ndarray, "lines 1"]
) -> Float[np.ndarray, "lines 3"]:
    """Round numbers of at most ``size``, a power of two, to ``DIGITS`` binary digits."""
    step = size * 2.0**-DIGITS
    return np.rint(value / step) * step


def _sign(direction: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "lines 1"]:
    """-1 where the first non-zero coordinate of a direction is negative, 1 elsewhere."""
    first = np.argmax(direction != 0, axis=1)[:, None]
    return np.where(np.take_along_axis(direction, first, axis=1) < 0, -1.0, 1.0)


def _axes(foot: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "3 3"]:
    """The axes of a frame; ``foot`` is relative to its centre, in its unit."""
    foot = foot / np.sqrt(1 + np.sum(foot**2, axis=1, keepdims=True))
    axes = np.linalg.eigh(foot.T @ foot)[1]
    axes = axes * np.where(np.sum((foot @ axes) ** 3, axis=0) < 0, -1.0, 1.0)
    # The axes stay right-handed: in a mirror image the moments would differ.
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return axes


def meeting_point(
    direction: Float[np.ndarray, "lines 3"], foot: Float[np.ndarray, "lines 3"], weight: Float[np.ndarray, " lines"]
) -> Float[np.ndarray, "3"]:
    """The point of least weighted sum of squared distances to the lines; if many, the nearest to the mean foot."""
    weight = weight / weight.sum()
    mean = weight @ foot
    apart = foot - mean
    normal = np.eye(3) - np.einsum("n,ni,nj->ij", weight, direction, direction)
    across = apart - np.sum(apart * direction, axis=1, keepdims=True) * direction
    return mean + np.linalg.lstsq(normal, weight @ across, rcond=1e-12)[0]


def _distance(
    direction: Float[np.ndarray, "lines 3"], foot: Float[np.ndarray, "lines 3"], point: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " lines"]:
    """Distance of ``point`` from each line."""
    return np.linalg.norm(np.cross(point - foot, direction), axis=1)
