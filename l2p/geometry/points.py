"""The nearest points to each point, by scipy's k-d tree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class NearestPoints(NamedTuple):
    """Neighbours of each point, nearest first, self left out."""

    index: Int[np.ndarray, "points k"]
    distance: Float[np.ndarray, "points k"]


def nearest_neighbors(
    points: Float[np.ndarray, "points 3"], k: int, workers: int = -1, rows: slice | None = None
) -> NearestPoints:
    """The k nearest other points of each point, or of those in ``rows``; points - 1 columns where k is larger.

    ``workers``: -1 for all cores.
    """
    from scipy.spatial import KDTree

    k = max(0, min(k, len(points) - 1))
    number = np.arange(len(points))[rows or slice(None)]
    if k == 0:
        return NearestPoints(np.zeros((len(number), 0), dtype=np.int64), np.zeros((len(number), 0)))
    distance, index = map(np.asarray, KDTree(points).query(points[number], k + 1, workers=workers))
    # Self is not always first: points that coincide with others come in any order.
    own = index == number[:, None]
    own[:, -1] |= ~own.any(axis=1)
    keep = ~own
    return NearestPoints(index[keep].reshape(-1, k).astype(np.int64), distance[keep].reshape(-1, k))
