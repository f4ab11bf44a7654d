"""Precision of the neighbours that an attack used, at its own k."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.geometry.points import nearest_neighbors


class NeighborScores(NamedTuple):
    """Precision of the neighbours of an attack: the true ones of line i are its k_i nearest points, if it used k_i.

    Attributes
    ----------
    precision : float
        Mean share of true neighbours among those used, weighted by affinity.
    under_half_outliers : float
        Share of lines with less than 50 % outliers, the breakdown point of the peak (paper, figure 4).
    used : float
        Mean number of neighbours used.
    """

    precision: float
    under_half_outliers: float
    used: float


def right_neighbors(
    neighbors: Int[np.ndarray, "lines k"], truth: Float[np.ndarray, "lines 3"]
) -> Bool[np.ndarray, "lines k"]:
    """Mask of the true neighbours of an attack (-1: none): among the k_i nearest points, if line i has k_i of them."""
    used = neighbors >= 0
    count = used.sum(axis=1)
    true = nearest_neighbors(truth, int(count.max(initial=0)))
    if true.distance.shape[1] == 0:
        return np.zeros(neighbors.shape, dtype=bool)
    reach = np.take_along_axis(true.distance, np.maximum(count - 1, 0)[:, None], axis=1)
    distance = np.linalg.norm(truth[np.maximum(neighbors, 0)] - truth[:, None], axis=2)
    return (distance <= reach) & used


def neighbor_scores(
    neighbors: Int[np.ndarray, "lines k"],
    truth: Float[np.ndarray, "lines 3"],
    affinity: Float[np.ndarray, "lines k"] | None = None,
    right: Bool[np.ndarray, "lines k"] | None = None,
) -> NeighborScores:
    """Precision of an attack's neighbours (-1: none) at its own k; see :class:`NeighborScores`.

    ``right`` is the result of :func:`right_neighbors`, computed if left out.
    """
    right = right_neighbors(neighbors, truth) if right is None else right
    used = neighbors >= 0
    weight = used.astype(np.float64) if affinity is None else np.where(used, affinity, 0.0)
    count = used.sum(axis=1)
    some = count > 0
    if not some.any():
        return NeighborScores(0.0, 0.0, 0.0)
    precision = (weight * right).sum(axis=1)[some] / np.maximum(weight.sum(axis=1)[some], 1e-12)
    return NeighborScores(float(precision.mean()), float((precision > 0.5).mean()), float(count.mean()))


def affinity_precision(
    affinity: Float[np.ndarray, " pairs"], right: Bool[np.ndarray, " pairs"], shares: Float[np.ndarray, " shares"]
) -> Float[np.ndarray, " shares"]:
    """Precision of the given shares of all pairs, greatest affinity first; pairs of equal affinity in any order.

    Notes
    -----
    There are as many pairs as true ones (:func:`right_neighbors`), so the recall at a share is share x precision.
    """
    order = np.argsort(-affinity, kind="stable")
    ends = np.flatnonzero(np.diff(affinity[order], append=-np.inf)) + 1
    hits = np.cumsum(right[order])[ends - 1]
    kept = shares * len(order)
    return np.interp(kept, np.append(0, ends), np.append(0, hits)) / kept
