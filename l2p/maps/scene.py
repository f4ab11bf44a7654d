"""A Structure-from-Motion scene: points and their attributes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8


@dataclass(frozen=True, eq=False)
class Scene:
    """The sparse points of an SfM model.

    Attributes
    ----------
    xyz : (points, 3) float64
        Points in scene units (metres only if the model is metric).
    rgb : (points, 3) uint8 or None
        Colours of the points.
    error : (points,) float32 or None
        Mean reprojection error in pixels.
    track_length : (points,) int32 or None
        Number of images that see the point.
    ids : (points,) int64 or None
        Identifiers of the source (COLMAP ``point3D_id``).
    camera_centers : (cameras, 3) float64 or None
        Centres of the cameras that see the points, scene units.
    """

    xyz: Float[np.ndarray, "points 3"]
    rgb: UInt8[np.ndarray, "points 3"] | None = None
    error: Float[np.ndarray, " points"] | None = None
    track_length: Int[np.ndarray, " points"] | None = None
    ids: Int[np.ndarray, " points"] | None = None
    camera_centers: Float[np.ndarray, "cameras 3"] | None = None

    def __len__(self) -> int:
        return len(self.xyz)
