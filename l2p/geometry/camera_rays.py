"""Rays of the pixels of a camera, of any of COLMAP's models."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float


def camera_rays(camera: Any, xy: Float[np.ndarray, "pixels 2"]) -> Float[np.ndarray, "pixels 3"]:
    """Return unit vectors (x right, y down, z forward) of pixels; NaN where a ``pycolmap.Camera`` has none."""
    if hasattr(camera, "cam_ray_from_img"):  # pycolmap 4: also rays that point backwards
        ray = np.asarray(camera.cam_ray_from_img(xy), dtype=np.float64)
    else:
        plane = np.asarray(camera.cam_from_img(xy), dtype=np.float64)
        ray = np.column_stack([plane, np.ones(len(plane))])
    return ray / np.linalg.norm(ray, axis=1, keepdims=True)
