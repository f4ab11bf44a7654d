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
from l2p.maps.truth import Truth

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
        Number of true points, which is that of the lines unless some hide two points or none.
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
        """Plain values for a JSON file; None where an error is infinite."""
        return {name: None if value == np.inf else value for name, value in asdict(self).items()}


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


def matched(recovery: Recovery, truth: Truth) -> Int[np.ndarray, " points"]:
    """The recovered row of each true point, -1 for none: of its own element, and no row twice.

    Notes
    -----
    Where an element has several points or rows, they are matched with the least total distance.
    """
    if recovery.one_each and truth.one_each:
        return np.where(truth.element < len(recovery), truth.element, -1)
    order = np.argsort(recovery.element, kind="stable")
    own = recovery.element[order]
    begin, end = (np.searchsorted(own, truth.element, side) for side in ("left", "right"))
    row = np.full(len(truth), -1)
    found = end > begin
    row[found] = order[begin[found]]
    _, element, count = np.unique(truth.element, return_inverse=True, return_counts=True)
    several = found & ((count[element] > 1) | (end - begin > 1))
    points = np.flatnonzero(several)[np.argsort(element[several], kind="stable")]
    for group in np.split(points, np.flatnonzero(np.diff(element[points])) + 1) if len(points) else []:
        row[group] = _assigned(truth.xyz[group], recovery.xyz, order[begin[group[0]] : end[group[0]]])
    return row


def _assigned(
    true: Float[np.ndarray, "points 3"], recovered: Float[np.ndarray, "rows 3"], rows: Int[np.ndarray, " own"]
) -> Int[np.ndarray, " points"]:
    """The row of each point of one element, -1 for none."""
    from scipy.optimize import linear_sum_assignment

    distance = np.linalg.norm(true[:, None] - recovered[rows], axis=2)
    point, place = linear_sum_assignment(distance)
    row = np.full(len(true), -1)
    row[point] = rows[place]
    return row


def errors(
    recovered: Recovery | Float[np.ndarray, "rows 3"], truth: Truth | Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, " points"]:
    """Distance of each true point from the recovered one that is matched with it, scene units.

    Infinite for a point whose element has no recovered row left. Recovered rows of fakes count nowhere. In bare arrays
    row i is of element i.
    """
    recovery, true = _recovery(recovered), _truth(truth)
    return _distance(recovery, true, matched(recovery, true))


@dataclass(frozen=True, eq=False)
class Outcome:
    """A recovery beside the truth, point by point.

    Attributes
    ----------
    recovery : Recovery
    truth : Truth
    spacing : float
        Of the full true cloud, scene units.
    row : (points,) int64
        Recovered row of each true point, -1 for none (:func:`matched`).
    error : (points,) float64
        Scene units, infinite where there is no row.
    confidence : (points,) float32
        Of the recovered row, 0 where there is none.
    """

    recovery: Recovery
    truth: Truth
    spacing: float
    row: Int[np.ndarray, " points"]
    error: Float[np.ndarray, " points"]
    confidence: Float[np.ndarray, " points"]

    @property
    def inside(self) -> Bool[np.ndarray, " points"]:
        """Which points are within 1 spacing."""
        return self.error <= self.spacing

    @property
    def spacings(self) -> Float[np.ndarray, " points"]:
        """Errors in spacings."""
        return self.error / self.spacing


def compare(recovery: Recovery, truth: Truth | Float[np.ndarray, "lines 3"], spacing: float | None = None) -> Outcome:
    """Put a recovery beside the truth; see :func:`evaluate`."""
    true = _truth(truth)
    if recovery.one_each and true.one_each and len(true) != len(recovery):
        raise InputError(
            f"got {len(recovery)} recovered and {len(true)} true points; expected the truth of these very lines"
        )
    row = matched(recovery, true)
    confidence = recovery.confidence[row]
    confidence[row < 0] = 0
    scale = _scale(true) if spacing is None else spacing
    return Outcome(recovery, true, scale, row, _distance(recovery, true, row), confidence)


def _scale(truth: Truth) -> float:
    return spacing(truth.xyz) if truth.spacing is None else truth.spacing


def _distance(recovery: Recovery, truth: Truth, row: Int[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
    return np.where(row < 0, np.inf, np.linalg.norm(recovery.xyz[row] - truth.xyz, axis=1))


def _recovery(points: Recovery | Float[np.ndarray, "rows 3"]) -> Recovery:
    if isinstance(points, Recovery):
        return points
    return Recovery(points, np.zeros(len(points), dtype=np.float32), np.zeros(len(points)))


def _truth(points: Truth | Float[np.ndarray, "points 3"]) -> Truth:
    if isinstance(points, Truth):
        return points
    points = finite_rows("truth", points)
    return Truth(points, np.arange(len(points)))


def evaluate(
    recovery: Recovery,
    truth: Truth | Float[np.ndarray, "lines 3"],
    spacing: float | None = None,
    metric: bool = False,
) -> Scores:
    """Score a recovery against the true points.

    Parameters
    ----------
    recovery : Recovery
    truth : Truth or (lines, 3) array
        True points; those of an array are in the order of the lines.
    spacing : float, optional
        Of the full true cloud, scene units. When left out, that of the truth; where this is not measured, that of the
        true points, which is right only if all points were hidden.
    metric : bool
        The scene is in metres: give the shares within centimetres, too.

    Returns
    -------
    Scores

    Raises
    ------
    InputError
        If the truth has other lines than the recovery.

    Notes
    -----
    Every true point counts once. One without a recovered row has an infinite error and confidence 0.

    Examples
    --------
    >>> import l2p
    >>> hidden = l2p.hide(l2p.simulate("room", 200), seed=0)
    >>> scores = l2p.evaluate(l2p.recover(hidden.map, method="tomography"), hidden.truth)
    >>> scores.lines, 0 <= scores.within_spacings["1"] <= 1
    (200, True)
    """
    found = compare(recovery, truth, spacing)
    error, scale, inside = found.error, found.spacing, found.inside
    order = np.argsort(-found.confidence, kind="stable")
    return Scores(
        lines=len(error),
        spacing=scale,
        median=float(np.median(error)),
        mean=float(error.mean()),
        median_spacings=float(np.median(error) / scale),
        within_spacings={f"{t:g}": float((error <= t * scale).mean()) for t in SPACINGS},
        within_cm={f"{t:g}": float((error <= t / 100).mean()) for t in CENTIMETRES} if metric else {},
        confident_half=float(inside[order[: (len(order) + 1) // 2]].mean()),
        confident_quarter=float(inside[order[: (len(order) + 3) // 4]].mean()),
        calibration_error=calibration_error(found.confidence, inside) if recovery.calibrated else None,
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
