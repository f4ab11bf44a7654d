"""Quality of a confidence: risk among the most confident points, calibration, and ranking."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

#: Number of bins, with equally many points each, of the reliability diagram and the calibration error.
BINS = 15


class Reliability(NamedTuple):
    """Confidence and share of right points in bins of equally many points, the least confident first.

    ``lines`` counts the points of each bin, ``confidence`` is their mean confidence, and ``inside`` the share of them
    within 1 spacing.
    """

    lines: Int[np.ndarray, " bins"]
    confidence: Float[np.ndarray, " bins"]
    inside: Float[np.ndarray, " bins"]


def most_confident(confidence: Float[np.ndarray, " points"], inside: Bool[np.ndarray, " points"], parts: int) -> float:
    """Share within 1 spacing in the most confident of ``parts`` equal parts, its size rounded up."""
    order = np.argsort(-confidence, kind="stable")
    return float(inside[order[: -(-len(order) // parts)]].mean())


def risk_coverage(
    confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"]
) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """Coverage (share of lines kept, most confident first) and risk (share of the kept lines outside 1 spacing)."""
    order = np.argsort(-confidence, kind="stable")
    kept = np.arange(1, len(order) + 1)
    return kept / len(order), np.cumsum(~inside[order]) / kept


def reliability(
    confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"], bins: int = BINS
) -> Reliability:
    """Reliability diagram of a confidence, in ``bins`` bins (one per line, if there are fewer lines)."""
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


def ranking(confidence: Float[np.ndarray, " lines"], inside: Bool[np.ndarray, " lines"]) -> float | None:
    """Area under the ROC curve: probability that a line within 1 spacing has a greater confidence than one outside.

    None if all lines are within, or all outside.
    """
    from scipy.stats import rankdata

    right = int(inside.sum())
    wrong = len(inside) - right
    if right == 0 or wrong == 0:
        return None
    return float((rankdata(confidence)[inside].sum() - right * (right + 1) / 2) / (right * wrong))
