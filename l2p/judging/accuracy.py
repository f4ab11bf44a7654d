"""How far a recovery is from the truth, in scene units and in spacings, and what its confidence is worth.

*Spacing* is the median distance to the 50th neighbour in the **full** true cloud, also when only a fraction of it was
lifted: figures at different densities then share one unit.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.checks import finite_rows
from l2p.errors import InputError
from l2p.geometry.points import nearest_neighbors
from l2p.maps.recovery import Recovery

#: Thresholds of the shares, in spacings.
SPACINGS = (0.25, 0.5, 1.0, 2.0, 5.0)
#: Thresholds of the shares of a metric scene, in centimetres.
CENTIMETRES = (1.0, 2.5, 5.0, 10.0, 25.0, 50.0)
_NEIGHBOR = 50
_BINS = 15


@dataclass(frozen=True)
class Scores:
    """Errors of a recovery; lengths in scene units unless they say spacings.

    Attributes
    ----------
    lines : int
        Number of lines.
    spacing : float
        Median distance to the 50th neighbour in the full true cloud.
    median, mean : float
        Of the error.
    median_spacings : float
        Median error over the spacing.
    within_spacings, within_cm : dict
        Share of points within each threshold; ``within_cm`` is empty unless the scene is metric.
    confident_half, confident_quarter : float
        Share within 1 spacing among the most confident half and quarter of the lines.
    calibration_error : float or None
        Expected calibration error of the confidence as the probability of lying within 1 spacing, in 15 bins of
        equal size; None where the confidence only ranks.
    """

    lines: int
    spacing: float
    median: float
    mean: float
    median_spacings: float
    within_spacings: dict[str, float]
    within_cm: dict[str, float]
    confident_half: float
    confident_quarter: float
    calibration_error: float | None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        return asdict(self)


@dataclass(frozen=True)
class NeighborScores:
    """How right the neighbours of an attack are, at its own k: true are the k_i nearest points, k_i as many as used.

    Attributes
    ----------
    precision : float
        Mean share of true neighbours among those used, weighted by affinity.
    under_half_outliers : float
        Share of lines with less than 50 % outliers, the most that the peak stands (paper, figure 4).
    used : float
        Mean number of neighbours used.
    """

    precision: float
    under_half_outliers: float
    used: float

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        return asdict(self)


class Reliability(NamedTuple):
    """What a confidence says and what holds, in bins of equally many lines, the least confident first.

    ``lines`` counts the lines of each bin, ``confidence`` is their mean confidence, and ``inside`` the share of them
    within 1 spacing.
    """

    lines: Int[np.ndarray, " bins"]
    confidence: Float[np.ndarray, " bins"]
    inside: Float[np.ndarray, " bins"]


def spacing(points: Float[np.ndarray, "points 3"]) -> float:
    """Median distance to the 50th neighbour (to the farthest point, in clouds of 50 points or fewer), scene units.

    Raises
    ------
    InputError
        If more than half of the points coincide with 50 others, or there is one point only: there is no scale.
    """
    points = finite_rows("points", points)
    distance = nearest_neighbors(points, _NEIGHBOR).distance
    value = float(np.median(distance[:, -1])) if distance.size else 0.0
    if value <= 0:
        raise InputError(f"got {len(points)} points without extent; expected points that differ, to measure errors by")
    return value


def errors(recovered: Float[np.ndarray, "lines 3"], truth: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, " lines"]:
    """Euclidean distance of each recovered point from its true one, scene units."""
    return np.linalg.norm(recovered - truth, axis=1)


def evaluate(
    recovery: Recovery, truth: Float[np.ndarray, "lines 3"], spacing: float | None = None, metric: bool = False
) -> Scores:
    """Score a recovery against the true points.

    Parameters
    ----------
    truth : (lines, 3)
        True points in the order of the lines.
    spacing : float, optional
        Of the full true cloud; computed from ``truth`` when left out, which is right only if all points were lifted.
    metric : bool
        The scene is in metres: give the shares within centimetres, too.

    Raises
    ------
    InputError
        If the truth has another number of points than the recovery.
    """
    truth = finite_rows("truth", truth)
    if len(truth) != len(recovery):
        raise InputError(
            f"got {len(recovery)} recovered and {len(truth)} true points; expected the truth of these very lines"
        )
    scale = globals()["spacing"](truth) if spacing is None else spacing
    error = errors(recovery.xyz, truth)
    inside = error <= scale
    order = np.argsort(-recovery.confidence, kind="stable")
    return Scores(
        lines=len(truth),
        spacing=scale,
        median=float(np.median(error)),
        mean=float(error.mean()),
        median_spacings=float(np.median(error) / scale),
        within_spacings={f"{t:g}": float((error <= t * scale).mean()) for t in SPACINGS},
        within_cm={f"{t:g}": float((error <= t / 100).mean()) for t in CENTIMETRES} if metric else {},
        confident_half=float(inside[order[: (len(order) + 1) // 2]].mean()),
        confident_quarter=float(inside[order[: (len(order) + 3) // 4]].mean()),
        calibration_error=calibration_error(recovery.confidence, inside) if recovery.calibrated else None,
    )


def risk_coverage(
    confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"]
) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """Coverage (share of lines kept, most confident first) and risk (share of the kept outside 1 spacing)."""
    order = np.argsort(-confidence, kind="stable")
    kept = np.arange(1, len(order) + 1)
    return kept / len(order), np.cumsum(~inside[order]) / kept


def reliability(
    confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"], bins: int = _BINS
) -> Reliability:
    """The reliability diagram of a confidence, in ``bins`` bins (as many as lines, if these are fewer)."""
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, min(bins, len(order)))
    return Reliability(
        lines=np.array([len(part) for part in parts]),
        confidence=np.array([confidence[part].mean(dtype=np.float64) for part in parts]),
        inside=np.array([inside[part].mean() for part in parts]),
    )


def calibration_error(confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"]) -> float:
    """Expected calibration error: mean gap between confidence and share within 1 spacing, in bins of equal size."""
    bins = reliability(confidence, inside)
    return float((bins.lines * np.abs(bins.confidence - bins.inside)).sum() / bins.lines.sum())


def right_neighbors(
    neighbors: Int[np.ndarray, "lines k"], truth: Float[np.ndarray, "lines 3"]
) -> Bool[np.ndarray, "lines k"]:
    """Which neighbours of an attack (-1: none) are true: among the k_i nearest points, k_i as many as line i has."""
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

    ``right`` is what :func:`right_neighbors` gives, computed when left out.
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
    """Precision of the most affine share of all pairs; of pairs with equal affinity any may come first.

    Notes
    -----
    As many pairs are used as there are true ones (:func:`right_neighbors`): the recall at a share is share x precision.
    """
    order = np.argsort(-affinity, kind="stable")
    ends = np.flatnonzero(np.diff(affinity[order], append=-np.inf)) + 1
    hits = np.cumsum(right[order])[ends - 1]
    kept = shares * len(order)
    return np.interp(kept, np.append(0, ends), np.append(0, hits)) / kept
