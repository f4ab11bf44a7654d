"""The working frame of a plane cloud: a centre, axes and a half-width computed from the planes alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

#: Steps of the search of the centre.
_STEPS = 50


class PlaneFrame(NamedTuple):
    """``x_frame = (x_scene - center) @ axes / half``: most points lie in the cube [-1, 1]^3."""

    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    half: float

    def leave(self, xyz: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Convert points to the scene."""
        return self.center + self.half * xyz @ self.axes.T


def plane_frame(
    normal: Float[np.ndarray, "planes 3"], offset: Float[np.ndarray, " planes"], inside: float
) -> PlaneFrame:
    """Compute the frame: it moves, turns and scales with the planes.

    Parameters
    ----------
    normal, offset : array
        Planes whose normals span the space.
    inside : float
        Share of the planes whose distance from the centre is at most the half-width of the cube.

    Notes
    -----
    The centre has the least sum of distances to the planes (iteratively reweighted least squares). With random normals
    the mean of distance^2 given the normal n is n^T S n for the second moment S of the points: S is fitted by least
    squares, far planes clipped, and its eigenvectors are the axes, each towards the longer tail.
    """
    weight, center = np.ones(len(normal)), np.zeros(3)
    start = np.linalg.lstsq(normal, offset, rcond=None)[0]
    rest = offset - normal @ start
    for _ in range(_STEPS):
        root = np.sqrt(weight)
        center = np.linalg.lstsq(normal * root[:, None], rest * root, rcond=None)[0]
        distance = np.abs(normal @ center - rest)
        weight = 1 / np.maximum(distance, 1e-3 * np.median(distance) + np.finfo(float).tiny ** 0.5)
        weight /= weight.max()
    signed = rest - normal @ center
    half = float(np.quantile(np.abs(signed), inside))
    if half <= 0:
        half = float(np.abs(signed).max(initial=0.0)) or 1.0
    clipped = np.clip(signed / half, -1, 1)
    row, column = np.triu_indices(3)
    design = normal[:, row] * normal[:, column] * np.where(row == column, 1, 2)
    second = np.zeros((3, 3))
    second[row, column] = np.linalg.lstsq(design, clipped**2, rcond=None)[0]
    axes = np.linalg.eigh(second + np.triu(second, 1).T)[1]
    axes = axes * np.where(clipped**3 @ (normal @ axes) < 0, -1.0, 1.0)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return PlaneFrame(start + center, axes, half)
