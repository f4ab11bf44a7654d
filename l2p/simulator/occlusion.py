"""Occlusion: segments from cameras to points, tested against every solid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.simulator.surfaces import CUBE, CYLINDER, SPHERE, SQUARE, Shapes

#: Coordinates x, y, z of vectors, each (segments, solids).
Axes = Sequence[np.ndarray]
#: Segments per block; its work arrays fit the cache.
BLOCK = 2048
#: Position along a segment (0 to 1) from which on a cut does not count: there the segment meets the point's surface.
END = 1.0 - 1e-4


def hidden(
    camera_center: Float[np.ndarray, "cameras 3"],
    camera: Int[np.ndarray, " segments"],
    point: Float[np.ndarray, "segments 3"],
    own: Int[np.ndarray, " segments"],
    solids: Shapes,
) -> Bool[np.ndarray, " segments"]:
    """Whether a solid other than the point's ``own`` (-1 for none) cuts each segment from a camera to a point.

    Notes
    -----
    O(segments x solids), in blocks of bounded memory. A point on its own convex body is hidden by that body only if
    the surface turns away from the camera; the caller tests that by the normal.
    """
    result = np.zeros(len(point), dtype=bool)
    for kind, cuts in ((SQUARE, _square), (CUBE, _cube), (SPHERE, _sphere), (CYLINDER, _cylinder)):
        rows = np.flatnonzero(solids.shape == kind)
        if rows.size == 0:
            continue
        to_unit = np.linalg.inv(solids.axes[rows])
        start = _unit(camera_center, solids.center[rows], to_unit)
        for first in range(0, len(point), BLOCK):
            block = np.arange(first, min(first + BLOCK, len(point)))
            block = block[~result[block]]
            end = _unit(point[block], solids.center[rows], to_unit)
            begin = [axis[camera[block]] for axis in start]  # each (segments, solids)
            cut = cuts(begin, [e - b for e, b in zip(end, begin, strict=True)])
            result[block] = (cut & (own[block, None] != rows)).any(axis=1)
    return result


def _unit(point: np.ndarray, center: np.ndarray, to_unit: np.ndarray) -> list[np.ndarray]:
    """Coordinates of points in the unit frame of every solid: three times (points, solids), single precision."""
    moved = np.einsum("sij,sj->si", to_unit, center).astype(np.float32)
    point, to_unit = point.astype(np.float32), to_unit.astype(np.float32)
    return [point @ to_unit[:, axis].T - moved[:, axis] for axis in range(3)]


def _square(begin: Axes, step: Axes) -> np.ndarray:
    """Whether segments cut the unit square."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -begin[2] / step[2]
        x, y = begin[0] + t * step[0], begin[1] + t * step[1]
        return (t > 0) & (t < END) & (np.abs(x) <= 1) & (np.abs(y) <= 1)


def _cube(begin: Axes, step: Axes) -> np.ndarray:
    """Whether segments cut the unit cube, the intersection of three slabs."""
    enter, leave = _slab(begin[0], step[0])
    for axis in (1, 2):
        low, high = _slab(begin[axis], step[axis])
        enter, leave = np.maximum(enter, low), np.minimum(leave, high)
    return (enter < leave) & (leave > 0) & (enter < END)


def _sphere(begin: Axes, step: Axes) -> np.ndarray:
    """Whether segments cut the unit sphere."""
    return _quadratic(_dot(step, step), _dot(begin, step), _dot(begin, begin) - 1)[0]


def _cylinder(begin: Axes, step: Axes) -> np.ndarray:
    """Whether segments cut the unit cylinder, the intersection of an infinite tube and a slab."""
    flat, along = begin[:2], step[:2]
    meets, enter, leave = _quadratic(_dot(along, along), _dot(flat, along), _dot(flat, flat) - 1)
    low, high = _slab(begin[2], step[2])
    enter, leave = np.maximum(enter, low), np.minimum(leave, high)
    return meets & (enter < leave) & (leave > 0) & (enter < END)


def _slab(begin: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last t with begin + t step in [-1, 1]; the tiny term keeps parallel segments finite."""
    inverse = 1 / (step + np.float32(1e-12))
    half, middle = np.abs(inverse), -begin * inverse
    return middle - half, middle + half


def _dot(a: Axes, b: Axes) -> np.ndarray:
    """Dot products of vectors given by their coordinates."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total += x * y
    return total


def _quadratic(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve a t^2 + 2 b t + c <= 0: whether the solution meets the segment, its first and its last t."""
    a = np.maximum(a, np.float32(1e-12))
    disc = b * b - a * c
    root = np.sqrt(np.maximum(disc, 0))
    enter, leave = (-b - root) / a, (-b + root) / a
    return (disc > 0) & (leave > 0) & (enter < END), enter, leave
