"""The working frame: a centre and a unit computed from the lines alone.

Everything an attack measures is divided by this unit and counted from this centre, so the answer does not depend on
where the scene lies and how it is scaled, and single precision is enough inside, however far the scene's coordinates
are from zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from l2p.geometry import Lines
from l2p.lines import LineCloud

_ROUNDS = 100
_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class Frame:
    """``x_frame = (x_scene - center) / unit``.

    Attributes
    ----------
    center : (3,) float64
        The point with the least sum of distances to the lines, scene units.
    unit : float
        Median distance of the lines from it, scene units.
    """

    center: Float[np.ndarray, "3"]
    unit: float

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
        return cls(start + step, median if median > 1e-12 * scale else (scale or 1.0))

    def enter(self, cloud: LineCloud, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Lines:
        """The lines as tensors in this frame; the subtraction is done in double precision."""
        moment = (cloud.moment - np.cross(self.center, cloud.direction)) / self.unit
        return Lines(
            torch.as_tensor(cloud.direction.copy(), dtype=dtype, device=device),
            torch.as_tensor(moment, dtype=dtype, device=device),
        )

    def enter_points(
        self,
        points: Float[np.ndarray, "points 3"],
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> Float[Tensor, "points 3"]:
        """Scene points as a tensor in this frame."""
        return torch.as_tensor((points - self.center) / self.unit, dtype=dtype, device=device)

    def leave(self, cloud: LineCloud, beta: Float[Tensor, " lines"]) -> Float[np.ndarray, " lines"]:
        """Positions along the lines, counted from the foot of this frame, as positions from the scene's own feet."""
        along = cloud.direction @ self.center
        return along + self.unit * beta.double().cpu().numpy()


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
