"""The working frame: a centre, axes and a unit computed from the lines alone.

Everything an attack measures is divided by this unit, counted from this centre and along these axes, so the answer does
not depend on where the scene lies, how it is turned and scaled, and single precision is enough inside, however far the
scene's coordinates are from zero.

Attacks choose between places that are all but equally good, and round after round a choice moves others: what differs
in the last digit at first differs visibly in the end (``docs/experiments.md``, "Invariance"). So lines that are the
same up to a similarity, their order and their signs must enter as the *same numbers*. The frame is therefore found in
double precision to the last digits, directions get one sign, and coordinates are rounded to ``DIGITS`` binary digits:
what double precision leaves of a difference hardly ever lies across the border of two rounded numbers.
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

#: Binary digits that are kept of directions, and of feet in frame units (of farther feet fewer): 2^-22 of the unit is
#: far below any spacing.
DIGITS = 22
_ROUNDS = 100
_TOLERANCE = 1e-15


@dataclass(frozen=True, eq=False)
class Frame:
    """``x_frame = (x_scene - center) @ axes / unit``.

    Attributes
    ----------
    center : (3,) float64
        The point with the least sum of distances to the lines, scene units.
    unit : float
        Median distance of the lines from it, scene units.
    axes : (3, 3) float64
        Right-handed axes as columns: principal axes of the feet of the lines, far ones damped, each pointing to where
        the feet are skewed.
    """

    center: Float[np.ndarray, "3"]
    unit: float
    axes: Float[np.ndarray, "3 3"]

    @classmethod
    def of(cls, cloud: LineCloud) -> Frame:
        """The frame of a line cloud.

        Notes
        -----
        Iteratively reweighted least squares (Weiszfeld) on sum_i |(I - d d^T)(x - o_i)|, O(lines) a round. Parallel
        lines and a single line leave a direction free; the least-norm step from the mean foot is taken there.
        """
        # Feet are taken from a point amid the lines, so that no digits are lost far from the origin.
        start = _meeting_point(cloud.direction, cloud.origin, np.ones(len(cloud)))
        foot = np.cross(cloud.direction, cloud.moment - np.cross(start, cloud.direction))
        step = np.zeros(3)
        for _ in range(_ROUNDS):
            distance = _distance(cloud.direction, foot, step)
            # The floor keeps the weights of lines that pass through the centre itself, and their sum, finite.
            weight = 1 / np.maximum(distance, 1e-6 * distance.mean() + np.finfo(float).tiny ** 0.5)
            moved = _meeting_point(cloud.direction, foot, weight)
            done = np.linalg.norm(moved - step) <= _TOLERANCE * distance.mean()
            step = moved
            if done:
                break
        median = float(np.median(_distance(cloud.direction, foot, step)))
        scale = float(np.abs(foot).max(initial=0.0))
        unit = median if median > 1e-12 * scale else (scale or 1.0)
        across = foot - step - np.sum((foot - step) * cloud.direction, axis=1, keepdims=True) * cloud.direction
        return cls(start + step, unit, _axes(across / unit))

    def as_dict(self) -> dict[str, Any]:
        """Plain values; in JSON they keep every bit."""
        return {"center": self.center.tolist(), "unit": self.unit, "axes": self.axes.tolist()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Frame:
        """The frame of :meth:`as_dict`."""
        return cls(np.array(values["center"]), values["unit"], np.array(values["axes"]))

    def enter(self, cloud: LineCloud, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Lines:
        """The lines as tensors in this frame, with one sign and rounded; all of it is done in double precision."""
        direction, sign = self._turned(cloud)
        direction *= sign
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        foot = np.cross(cloud.direction, cloud.moment - np.cross(self.center, cloud.direction)) @ self.axes / self.unit
        size = np.exp2(np.ceil(np.log2(np.maximum(np.abs(foot).max(axis=1, keepdims=True), 1.0))))
        moment = np.cross(_rounded(foot, size), direction)
        return Lines(*(torch.as_tensor(part, dtype=dtype, device=device) for part in (direction, moment)))

    def enter_points(
        self,
        points: Float[np.ndarray, "points 3"],
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> Float[Tensor, "points 3"]:
        """Scene points as a tensor in this frame."""
        return torch.as_tensor((points - self.center) @ self.axes / self.unit, dtype=dtype, device=device)

    def leave(self, cloud: LineCloud, beta: Float[Tensor, " lines"]) -> Float[np.ndarray, " lines"]:
        """Positions along the lines, counted from the foot of this frame, as positions from the scene's own feet."""
        along = cloud.direction @ self.center
        return along + self.unit * self._turned(cloud)[1][:, 0] * beta.double().cpu().numpy()

    def _turned(self, cloud: LineCloud) -> tuple[Float[np.ndarray, "lines 3"], Float[np.ndarray, "lines 1"]]:
        """Directions along the axes, rounded, and the sign that they are given on entering."""
        direction = _rounded(cloud.direction @ self.axes, 1.0)
        return direction, _sign(direction)


def _rounded(
    value: Float[np.ndarray, "lines 3"], size: float | Float[np.ndarray, "lines 1"]
) -> Float[np.ndarray, "lines 3"]:
    """Numbers of at most ``size``, a power of two, with ``DIGITS`` binary digits."""
    step = size * 2.0**-DIGITS
    return np.rint(value / step) * step


def _sign(direction: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "lines 1"]:
    """-1 for directions whose first number that is not 0 is below it, 1 for the others."""
    first = np.argmax(direction != 0, axis=1)[:, None]
    return np.where(np.take_along_axis(direction, first, axis=1) < 0, -1.0, 1.0)


def _axes(foot: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "3 3"]:
    foot = foot / np.sqrt(1 + np.sum(foot**2, axis=1, keepdims=True))
    axes = np.linalg.eigh(foot.T @ foot)[1]
    axes = axes * np.where(np.sum((foot @ axes) ** 3, axis=0) < 0, -1.0, 1.0)
    # A mirror image of the lines would have another moment; the axes stay right-handed.
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return axes


def _meeting_point(
    direction: Float[np.ndarray, "lines 3"], foot: Float[np.ndarray, "lines 3"], weight: Float[np.ndarray, " lines"]
) -> Float[np.ndarray, "3"]:
    """The point with the least weighted sum of squared distances to the lines, the nearest one to the mean foot."""
    weight = weight / weight.sum()
    mean = weight @ foot
    apart = foot - mean
    normal = np.eye(3) - np.einsum("n,ni,nj->ij", weight, direction, direction)
    across = apart - np.sum(apart * direction, axis=1, keepdims=True) * direction
    return mean + np.linalg.lstsq(normal, weight @ across, rcond=1e-12)[0]


def _distance(
    direction: Float[np.ndarray, "lines 3"], foot: Float[np.ndarray, "lines 3"], point: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " lines"]:
    return np.linalg.norm(np.cross(point - foot, direction), axis=1)
