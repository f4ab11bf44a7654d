"""Curves of a recovery, measured or predicted: error distribution, risk-coverage, calibration, neighbours."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from l2p.judging.accuracy import Outcome
from l2p.judging.calibration import reliability, risk_coverage
from l2p.judging.neighbours import affinity_precision
from l2p.maps.recovery import Recovery

#: Errors at which their distribution is sampled, in spacings.
THRESHOLDS = np.geomspace(0.01, 100, 81)
#: Least and greatest error drawn, in spacings: smaller ones are noise of the map, larger ones could be anywhere.
SHOWN = (0.02, 30)
#: Shares of the points (most confident first) or neighbours (greatest affinity first) at which curves are sampled.
SHARES = np.arange(1, 101) / 100


@dataclass(frozen=True)
class Curves:
    """Curves in the figures of an audit; all plain numbers, shares in [0, 1].

    Attributes
    ----------
    within : list of float
        Share of points with an error of at most each of :data:`THRESHOLDS`; empty if the truth is not known.
    risk : list of float
        Share with an error above 1 spacing among the most confident points, at each of :data:`SHARES`; the expected
        share if the truth is not known; empty if there is neither.
    claimed, right : list of float
        Mean confidence and share within 1 spacing in each bin of equally many points, the least confident first; empty
        if the truth is not known or the confidence is no probability.
    """

    within: list[float]
    risk: list[float]
    claimed: list[float]
    right: list[float]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for a JSON file."""
        return asdict(self)


def measured_curves(found: Outcome) -> Curves:
    """Curves of a recovery whose truth is known."""
    within, risk = distribution(found.spacings), sampled_risk(found.confidence, found.inside)
    bins = reliability(found.confidence, found.inside) if found.recovery.calibrated else None
    claimed, right = ([], []) if bins is None else (bins.confidence.tolist(), bins.inside.tolist())
    return Curves(within.tolist(), risk.tolist(), claimed, right)


def predicted_curves(recovery: Recovery) -> Curves:
    """Curves that a calibrated confidence predicts without the truth; empty if it only ranks."""
    if not recovery.calibrated:
        return Curves([], [], [], [])
    ordered = np.sort(recovery.confidence.astype(np.float64))[::-1]
    return Curves([], _at_shares(np.cumsum(1 - ordered) / np.arange(1, len(ordered) + 1)).tolist(), [], [])


def distribution(error: Float[np.ndarray, " points"]) -> Float[np.ndarray, " thresholds"]:
    """Share of errors (spacings) within each of ``THRESHOLDS``."""
    return np.searchsorted(np.sort(error), THRESHOLDS, side="right") / len(error)


def sampled_risk(
    confidence: Float[np.ndarray, " points"], inside: Bool[np.ndarray, " points"]
) -> Float[np.ndarray, " shares"]:
    """Share of points outside 1 spacing among the most confident points, at each of ``SHARES``."""
    return _at_shares(risk_coverage(confidence, inside)[1])


def sampled_precision(recovery: Recovery, right: Bool[np.ndarray, "lines k"]) -> Float[np.ndarray, " shares"]:
    """Precision of the neighbours with the greatest affinity, at each of ``SHARES``."""
    assert recovery.neighbors is not None
    used = recovery.neighbors >= 0
    affinity = np.ones(used.shape) if recovery.affinity is None else recovery.affinity
    return affinity_precision(affinity[used], right[used], SHARES) if used.any() else np.zeros(len(SHARES))


def _at_shares(risk: Float[np.ndarray, " points"]) -> Float[np.ndarray, " shares"]:
    """Risk at each of ``SHARES``, the number of points rounded up."""
    return risk[np.ceil(SHARES * len(risk) - 1e-9).astype(int) - 1]
