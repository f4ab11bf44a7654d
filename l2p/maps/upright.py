"""Which way is up in a map, from the rotations of its cameras."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: Least mean square of the second principal component of the cameras' horizontal axes, and how many times that of the
#: third: below, they do not span a plane.
_SPAN, _FLAT = 0.005, 4.0
#: Least length of a mean of unit vectors that has a direction.
_AGREE = 0.2


def up_of(rotations: Float[np.ndarray, "cameras 3 3"]) -> Float[np.ndarray, "3"] | None:
    """Estimate the direction of up in the map.

    Photographers hold cameras level but point them up or down: the horizontal axes of level cameras lie in the ground
    plane, and up is across them. Where they do not span a plane, because all cameras look the same way or some are held
    upright, it is the mean of the cameras' own up directions.

    Parameters
    ----------
    rotations : (cameras, 3, 3) float64
        World to camera; rows are right, down, forward of each camera in the map, as COLMAP has them.

    Returns
    -------
    (3,) float64 or None
        Unit vector; None without cameras, or if they say nothing.
    """
    if len(rotations) == 0 or not np.isfinite(rotations).all():
        return None
    right, own = rotations[:, 0], -rotations[:, 1].mean(axis=0)
    share, across = np.linalg.eigh(right.T @ right / len(right))
    if share[1] >= max(_SPAN, _FLAT * share[0]):
        up = across[:, 0]
        # Cameras that look straight down have no up of their own; the ground is before them.
        hint = own if abs(up @ own) >= _AGREE else -rotations[:, 2].mean(axis=0)
        return up if up @ hint >= 0 else -up
    length = float(np.linalg.norm(own))
    return own / length if length >= _AGREE else None
