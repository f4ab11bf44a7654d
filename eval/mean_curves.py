"""Curves of one prediction, sampled when it is scored, and their mean over scenes, each with equal weight."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from l2p.judging.accuracy import Outcome, affinity_precision, reliability, right_neighbors, risk_coverage
from l2p.maps.recovery import Recovery
from l2p.maps.truth import Truth

#: Thresholds of the error's distribution function, in spacings.
THRESHOLDS = np.geomspace(0.01, 100, 81)
#: Shares of the lines, or of the neighbours, at which curves are sampled: the most confident, the most affine first.
SHARES = np.arange(1, 101) / 100
#: Bins of the pooled reliability; a scene's own are ten times as fine, so that scenes can be merged.
BINS = 15
FINE_BINS = 10 * BINS
#: Digits that are kept.
DIGITS = 5


class Diagram(NamedTuple):
    """The reliability diagram of several scenes: share of all lines, mean confidence and share within 1 spacing."""

    share: Float[np.ndarray, " bins"]
    confidence: Float[np.ndarray, " bins"]
    inside: Float[np.ndarray, " bins"]


def distribution(error: Float[np.ndarray, " lines"]) -> Float[np.ndarray, " thresholds"]:
    """Share of the errors within each of ``THRESHOLDS``."""
    return np.searchsorted(np.sort(error), THRESHOLDS, side="right") / len(error)


def curves_of(
    found: Outcome,
    right: Bool[np.ndarray, "lines k"] | None,
) -> dict[str, Any]:
    """Every curve of a prediction, as plain lists; None for what the prediction does not have.

    Parameters
    ----------
    right
        Which neighbours are true; None without neighbours.
    """
    error, confidence = found.spacings, found.confidence
    inside = error <= 1
    ranks = confidence.min() < confidence.max()
    return {
        "within": _plain(distribution(error)),
        "risk": _plain(sampled_risk(confidence, inside)) if ranks else None,
        "reliability": _plain(sampled_reliability(confidence, inside)) if found.recovery.calibrated else None,
        "neighbors": None if right is None else _plain(sampled_precision(found.recovery, right)),
    }


def sampled_risk(
    confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"]
) -> Float[np.ndarray, " shares"]:
    """Share of lines beyond 1 spacing among the most confident share, at each of ``SHARES`` (rounded up to a line)."""
    _, risk = risk_coverage(confidence, inside)
    return risk[np.ceil(SHARES * len(risk) - 1e-9).astype(int) - 1]


def sampled_reliability(
    confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"]
) -> Float[np.ndarray, "3 bins"]:
    """Share of the lines, mean confidence and share within 1 spacing of each fine bin."""
    bins = reliability(confidence, inside, FINE_BINS)
    return np.stack([bins.lines / bins.lines.sum(), bins.confidence, bins.inside])


def sampled_precision(recovery: Recovery, right: Bool[np.ndarray, "lines k"]) -> Float[np.ndarray, " shares"]:
    """Share of true ones among the most affine share of all neighbours, at each of ``SHARES``."""
    assert recovery.neighbors is not None
    used = recovery.neighbors >= 0
    affinity = np.ones(used.shape) if recovery.affinity is None else recovery.affinity
    return affinity_precision(affinity[used], right[used], SHARES) if used.any() else np.zeros(len(SHARES))


def found_neighbors(recovery: Recovery, truth: Truth) -> Bool[np.ndarray, "lines k"] | None:
    """Which neighbours are true; None without neighbours, and where lines hide two points or none."""
    if recovery.neighbors is None or not (recovery.one_each and truth.one_each):
        return None
    return right_neighbors(recovery.neighbors, truth.xyz)


def pooled_reliability(curves: Iterable[Any]) -> Diagram:
    """One diagram of all scenes, each with equal weight however many lines it has, in bins of equal weight."""
    parts = [np.asarray(curve) for curve in curves]
    share, confidence, inside = np.concatenate(parts, axis=1)
    share = share / len(parts)
    order = np.argsort(confidence, kind="stable")
    middle = np.cumsum(share[order]) - share[order] / 2
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.minimum((middle * BINS).astype(int), BINS - 1)
    total, said, found = (np.bincount(place, share * value, BINS) for value in (1, confidence, inside))
    some = total > 0
    return Diagram(total[some], said[some] / total[some], found[some] / total[some])


def pooled_calibration_error(curves: Iterable[Any]) -> float:
    """Expected calibration error over all scenes, each with equal weight."""
    share, confidence, inside = pooled_reliability(curves)
    return float((share * np.abs(confidence - inside)).sum() / share.sum())


def _plain(curve: np.ndarray) -> list[Any]:
    return curve.round(DIGITS).tolist()
