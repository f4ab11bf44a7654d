"""Triangulation: noisy pixels, least-squares points, and the filters of an SfM program."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.short_repr import short_repr
from l2p.simulator.cameras import Cameras
from l2p.simulator.observe import Sightings, select

#: COLMAP's default filters (``filter_max_reproj_error``, ``filter_min_tri_angle``), pixels and degrees.
MAX_REPROJECTION_ERROR = 4.0
MIN_TRIANGULATION_ANGLE = 1.5
#: Gauss-Newton steps; few are enough from the true point.
STEPS = 3


@dataclass(frozen=True)
class Tracks:
    """Triangulated points and their observations, ``sightings.point`` sorted.

    ``xyz`` (points, 3) are the reconstructed positions, ``pixel`` (views, 2) the measured ones, ``error`` (points,)
    the mean reprojection error in pixels.
    """

    sightings: Sightings
    xyz: Float[np.ndarray, "points 3"]
    pixel: Float[np.ndarray, "views 2"]
    error: Float[np.ndarray, " points"]

    __repr__ = short_repr

    @property
    def length(self) -> Int[np.ndarray, " points"]:
        """Number of observations of each point."""
        return np.bincount(self.sightings.point, minlength=len(self.xyz))


def triangulate(sightings: Sightings, cameras: Cameras, noise: float, rng: np.random.Generator) -> Tracks:
    """Triangulate noisy observations by least squares, and filter the points as COLMAP does.

    Parameters
    ----------
    noise : float
        Median standard deviation of a pixel coordinate, in pixels.

    Notes
    -----
    Errors of points are not drawn from a model: they follow from the noisy pixels, so they are long along the viewing
    rays, grow with depth over baseline and fall with the length of the track.
    """
    exact = cameras.pixels(cameras.local(sightings.xyz[sightings.point], sightings.camera))
    # Keypoints of coarse scale are localised worse: noise differs between points, and a few are bad.
    sigma = noise * np.exp(0.5 * rng.standard_normal(len(sightings)))
    pixel = exact + sigma[sightings.point, None] * rng.standard_normal(exact.shape)
    xyz = sightings.xyz
    for _ in range(STEPS):
        xyz = xyz + _step(xyz, sightings, cameras, pixel)
    local = cameras.local(xyz[sightings.point], sightings.camera)
    ahead = local[:, 2] > 0.02
    residual = np.linalg.norm(cameras.pixels(np.where(ahead[:, None], local, 1.0)) - pixel, axis=1)
    count = np.maximum(np.bincount(sightings.point, minlength=len(sightings)), 1)
    bad = np.bincount(sightings.point, ~ahead | (residual > MAX_REPROJECTION_ERROR), minlength=len(sightings)) > 0
    error = np.bincount(sightings.point, residual, minlength=len(sightings)) / count
    keep = ~bad & (_angle(xyz, sightings, cameras) > np.radians(MIN_TRIANGULATION_ANGLE))
    kept = select(sightings, keep)
    return Tracks(kept, xyz[keep], pixel[keep[sightings.point]], error[keep])


def _step(xyz: np.ndarray, sightings: Sightings, cameras: Cameras, pixel: np.ndarray) -> np.ndarray:
    """A damped Gauss-Newton step for every point, in metres."""
    point, camera = sightings.point, sightings.camera
    local = cameras.local(xyz[point], camera)
    depth = np.maximum(local[:, 2:], 0.02)
    local = np.concatenate([local[:, :2], depth], axis=1)
    residual = pixel - cameras.pixels(local)
    turn = cameras.rotation[camera]
    jacobian = cameras.focal / depth[:, :, None] * (turn[:, :2] - (local[:, :2] / depth)[:, :, None] * turn[:, 2:])
    normal = _sum_over_views(np.einsum("nij,nik->njk", jacobian, jacobian).reshape(-1, 9), point, len(xyz))
    gradient = _sum_over_views(np.einsum("nij,ni->nj", jacobian, residual), point, len(xyz))
    normal = normal.reshape(-1, 3, 3)
    damping = 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.linalg.solve(normal + damping, gradient[:, :, None])[:, :, 0]


def _angle(xyz: np.ndarray, sightings: Sightings, cameras: Cameras) -> np.ndarray:
    """Largest angle (radians) between a point's first ray and its other ones."""
    ray = xyz[sightings.point] - cameras.center[sightings.camera]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    start = np.searchsorted(sightings.point, np.arange(len(xyz)))
    sine = np.linalg.norm(np.cross(ray, ray[start[sightings.point]]), axis=1)
    largest = np.zeros(len(xyz))
    np.maximum.at(largest, sightings.point, sine)
    return np.arcsin(np.minimum(largest, 1.0))


def _sum_over_views(value: np.ndarray, point: np.ndarray, points: int) -> np.ndarray:
    """Sum the rows of ``value`` that belong to one point; ``point`` is sorted and every point occurs."""
    return np.add.reduceat(value, np.searchsorted(point, np.arange(points)), axis=0)
