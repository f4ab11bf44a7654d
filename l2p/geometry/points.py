"""The nearest points to each point, by scipy's k-d tree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class NearestPoints(NamedTuple):
    """Neighbours of each point, nearest first, without the point itself."""

    index: Int[np.ndarray, "points k"]
    distance: Float[np.ndarray, "points k"]


def nearest_neighbors(
    points: Float[np.ndarray, "points 3"], k: int, workers: int = -1, rows: slice | None = None
) -> NearestPoints:
    """Find the k nearest other points of each point.

    Parameters
    ----------
    points : (points, 3)
    k : int
        Columns of the result; points - 1 if that is less.
    workers : int
        Threads; -1 for all cores.
    rows : slice, optional
        Points whose neighbours are wanted; all by default.
    """
    from scipy.spatial import KDTree

    k = max(0, min(k, len(points) - 1))
    number = np.arange(len(points))[rows or slice(None)]
    if k == 0:
        return NearestPoints(np.zeros((len(number), 0), dtype=np.int64), np.zeros((len(number), 0)))
    distance, index = map(np.asarray, KDTree(points).query(points[number], k + 1, workers=workers))
    # The point itself is not always first: coincident points come in any order.
    itself = index == number[:, None]
    itself[:, -1] |= ~itself.any(axis=1)
    keep = ~itself
    return NearestPoints(index[keep].reshape(-1, k).astype(np.int64), distance[keep].reshape(-1, k))
