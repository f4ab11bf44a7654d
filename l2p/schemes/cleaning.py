"""Cleaning of a map before its points are paired: points that are unusually far from all others are left out."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

#: Nearest points, the point itself among them, and standard deviations; the same twice, as in the authors' code.
_NEIGHBORS, _DEVIATIONS, _TIMES = 20, 10.0, 2


def without_outliers(points: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, " kept"]:
    """Rows of the points that pass a statistical outlier removal twice, in their order.

    Notes
    -----
    The removal is that of Open3D (``remove_statistical_outlier``), by a tree of SciPy, since hiding a map should not
    need Open3D: a point goes if the mean distance to its 20 nearest points, itself included, is more than 10 standard
    deviations above the mean of all, or 0. Fewer than three points are all kept: they have no usual distance.
    """
    from scipy.spatial import KDTree

    kept = np.arange(len(points))
    for _ in range(_TIMES):
        if len(kept) < 3:
            break
        some = points[kept] - points[kept].mean(axis=0)
        some = some / (np.abs(some).max() or 1.0)  # squares of tiny numbers would be 0
        distance = KDTree(some).query(some, k=min(_NEIGHBORS, len(some)))[0].mean(axis=1)
        usual = distance <= distance.mean() + _DEVIATIONS * distance.std(ddof=1)
        kept = kept[usual & (distance > 0)]
    return kept
