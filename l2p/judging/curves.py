"""The curves of an attack, measured or predicted: error distribution, risk-coverage, calibration."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from l2p.judging.accuracy import reliability, risk_coverage

#: Errors at which the distribution is given, in spacings: from the noise of a map to any place in the scene.
THRESHOLDS = tuple(float(f"{value:.4g}") for value in np.geomspace(0.02, 30, 60))
#: Shares of the points, most confident first, at which the risk is given.
COVERAGE = tuple(round(0.02 * step, 2) for step in range(1, 51))
#: Groups of equally many points, from the least to the most confident, in the calibration curve.
GROUPS = 10


@dataclass(frozen=True)
class Curves:
    """What the figures of an audit show; all plain numbers, shares in [0, 1].

    Attributes
    ----------
    within : list of float
        Share of points with an error of at most each of :data:`THRESHOLDS`; empty where the truth is not known.
    risk : list of float
        Among the most confident points, as many as each of :data:`COVERAGE` says, the share more than 1 spacing off;
        the expected share where the truth is not known; empty if there is neither.
    claimed, right : list of float
        For each of :data:`GROUPS` groups of equal confidence the mean confidence and the share within 1 spacing;
        empty where the truth is not known or the confidence is no probability.
    """

    within: list[float]
    risk: list[float]
    claimed: list[float]
    right: list[float]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        return asdict(self)


def measured(
    error: Float[np.ndarray, " lines"], confidence: Float[np.ndarray, " lines"], *, calibrated: bool
) -> Curves:
    """The curves of errors in spacings; ``calibrated`` says whether the confidence claims to be a probability."""
    inside = error <= 1
    within = [float((error <= limit).mean()) for limit in THRESHOLDS]
    risk = _at_coverage(risk_coverage(confidence, inside)[1])
    if not calibrated:
        return Curves(within, risk, [], [])
    groups = reliability(confidence, inside, GROUPS)
    return Curves(within, risk, groups.confidence.tolist(), groups.inside.tolist())


def predicted(confidence: Float[np.ndarray, " lines"]) -> Curves:
    """What a calibrated confidence lets expect without the truth."""
    ordered = np.sort(confidence.astype(np.float64))[::-1]
    return Curves([], _at_coverage(np.cumsum(1 - ordered) / np.arange(1, len(ordered) + 1)), [], [])


def _at_coverage(risk: Float[np.ndarray, " lines"]) -> list[float]:
    """The risk at each coverage; of at least one point."""
    return [float(risk[max(1, round(share * len(risk))) - 1]) for share in COVERAGE]
