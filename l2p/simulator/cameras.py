"""Cameras of simulated scenes: a handheld walk, orbits, a drive along a street, a drone's grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.short_repr import short_repr
from l2p.simulator.surfaces import Number


@dataclass(frozen=True)
class Cameras:
    """Pinhole cameras with one calibration.

    Attributes
    ----------
    center : (cameras, 3) float64
        In metres.
    rotation : (cameras, 3, 3) float64
        World to camera; rows are right, down, forward.
    focal : float
        In pixels; the principal point is the image centre.
    width, height : int
    """

    center: Float[np.ndarray, "cameras 3"]
    rotation: Float[np.ndarray, "cameras 3 3"]
    focal: float
    width: int
    height: int

    __repr__ = short_repr

    def local(
        self, point: Float[np.ndarray, "views 3"], camera: Int[np.ndarray, " views"]
    ) -> Float[np.ndarray, "views 3"]:
        """Points in the frames of their cameras, in metres; the third coordinate is the depth."""
        return np.einsum("nij,nj->ni", self.rotation[camera], point - self.center[camera])

    def pixels(self, local: Float[np.ndarray, "views 3"]) -> Float[np.ndarray, "views 2"]:
        """Project points in camera frames to pixel coordinates, in COLMAP's convention."""
        half = np.array([self.width / 2, self.height / 2])
        return self.focal * local[:, :2] / local[:, 2:] + half

    def __len__(self) -> int:
        return len(self.center)


def look(
    center: Float[np.ndarray, "cameras 3"],
    target: Float[np.ndarray, "cameras 3"],
    focal: float,
    rng: np.random.Generator,
    width: int = 1600,
    height: int = 1200,
) -> Cameras:
    """Cameras at ``center`` that look at ``target``, held by a slightly unsteady hand (about 3 degrees)."""
    forward = target - center + 0.05 * rng.standard_normal(center.shape) * _length(target - center)
    forward = forward / _length(forward)
    # A small horizontal component keeps "up" defined for cameras that look straight down.
    up = np.array([0.0, 0.02, 1.0]) + 0.05 * rng.standard_normal(center.shape)
    right = np.cross(forward, up)
    right = right / _length(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Cameras(center, rotation, focal, width, height)


def walk(waypoints: Float[np.ndarray, "way 3"], steps: int, sway: float, rng: np.random.Generator) -> np.ndarray:
    """Positions (steps, 3) along the polyline of ``waypoints``, with normal noise of ``sway`` metres."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))])
    at = np.linspace(0.0, length[-1], steps)
    path = np.stack([np.interp(at, length, waypoints[:, axis]) for axis in range(3)], axis=1)
    return path + sway * rng.standard_normal(path.shape)


def orbit(
    middle: Float[np.ndarray, " 3"],
    radius: Number,
    height: Number,
    arc: tuple[Number, Number],
    steps: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Positions (steps, 3) on an arc (from, to in radians) around ``middle``, ``height`` metres above it."""
    angle = np.linspace(arc[0], arc[1], steps)
    reach = radius * (1 + 0.06 * rng.standard_normal(steps))
    circle = np.stack([np.cos(angle) * reach, np.sin(angle) * reach, np.full(steps, height)], axis=1)
    return middle + circle + 0.03 * radius * rng.standard_normal((steps, 3))


def drone_grid(
    size: tuple[float, float], height: Number, shape: tuple[int, int], rng: np.random.Generator
) -> np.ndarray:
    """Positions (photos, 3) of a survey flight over ``size`` metres; ``shape`` is photos along and across."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, shape[0]) * size[0], np.linspace(-0.5, 0.5, shape[1]) * size[1])
    center = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    return center + 0.02 * height * rng.standard_normal(center.shape)


def _length(vector: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vector, axis=-1, keepdims=True)
