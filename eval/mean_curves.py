"""Curves of one prediction, sampled when it is scored, and their mean over scenes, each with equal weight."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from l2p.judging.accuracy import Outcome
from l2p.judging.calibration import BINS, reliability
from l2p.judging.curves import distribution, sampled_precision, sampled_risk

#: Bins of the reliability of one scene: ten times those of the pooled diagram, so that scenes can be merged.
FINE_BINS = 10 * BINS
#: Digits of saved values.
DIGITS = 5


class Diagram(NamedTuple):
    """Reliability diagram of several scenes: share of all lines, mean confidence and share within 1 spacing."""

    share: Float[np.ndarray, " bins"]
    confidence: Float[np.ndarray, " bins"]
    inside: Float[np.ndarray, " bins"]


def curves_of(found: Outcome) -> dict[str, Any]:
    """Sample every curve of a prediction, as plain lists; None for curves that it does not have."""
    confidence, inside = found.confidence, found.inside
    return {
        "within": _plain(distribution(found.spacings)),
        "risk": _plain(sampled_risk(confidence, inside)) if found.ranks else None,
        "reliability": _plain(sampled_reliability(confidence, inside)) if found.recovery.calibrated else None,
        "neighbors": None if found.right is None else _plain(sampled_precision(found.recovery, found.right)),
    }


def sampled_reliability(
    confidence: Float[np.ndarray, " points"], inside: Bool[np.ndarray, " points"]
) -> Float[np.ndarray, "3 bins"]:
    """Share of the points, mean confidence and share within 1 spacing in each fine bin."""
    bins = reliability(confidence, inside, FINE_BINS)
    return np.stack([bins.lines / bins.lines.sum(), bins.confidence, bins.inside])


def pooled_reliability(curves: Iterable[Any]) -> Diagram:
    """Reliability diagram of all scenes, in bins of equal weight; scenes count equally, whatever their size."""
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
