"""One attack of an audit, and what is predicted where the truth is not known."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from l2p.auditing.attackers import Attacker
from l2p.judging.curves import Curves
from l2p.judging.intervals import interval
from l2p.judging.scores import Scores
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.maps.short_repr import short_repr
from l2p.maps.truth import Truth


@dataclass(frozen=True)
class Prediction:
    """Scores predicted from the calibrated confidence, without the truth.

    Attributes
    ----------
    within_spacing : float
        Expected share of points within 1 spacing: the mean confidence.
    confident_half : float
        Expected share among the most confident half.
    """

    within_spacing: float
    confident_half: float

    @classmethod
    def of(cls, recovery: Recovery) -> Prediction | None:
        """Predict from the confidences of a recovery; None if they only rank."""
        if not recovery.calibrated:
            return None
        ordered = np.sort(recovery.confidence.astype(np.float64))[::-1]
        return cls(float(ordered.mean()), float(ordered[: (len(ordered) + 1) // 2].mean()))


@dataclass(frozen=True, eq=False)
class Trial:
    """One attack of an audit.

    Attributes
    ----------
    fraction : float
        Fraction of the map's points that was lifted.
    used : tuple of str
        The attacker: names of the published attributes that the attack used.
    lines : LineCloud
        The lines without attributes, one object for all attackers.
    recovery : Recovery
        The recovery without neighbours and affinities.
    truth : Truth or None
        The points behind the lines; None if the audit was given a line cloud.
    rgb : (lines, 3) uint8 or None
        Colours of the points behind the lines, for pictures, also if the attack did not use them.
    scores : Scores or None
        None without the truth.
    prediction : Prediction or None
        None if the confidence of the method is no probability.
    curves : Curves
    """

    fraction: float
    used: Attacker
    lines: LineCloud
    recovery: Recovery
    truth: Truth | None
    rgb: UInt8[np.ndarray, "lines 3"] | None
    scores: Scores | None
    prediction: Prediction | None
    curves: Curves

    __repr__ = short_repr

    @property
    def seconds(self) -> float:
        """Wall time of the attack."""
        return float(self.recovery.info["seconds"])

    @property
    def within(self) -> float | None:
        """Share of points within 1 spacing: measured if possible, else predicted, else None."""
        if self.scores is not None:
            return self.scores.within_spacings["1"]
        return None if self.prediction is None else self.prediction.within_spacing

    @property
    def confident_half(self) -> float | None:
        """The same share among the most confident half."""
        if self.scores is not None:
            return self.scores.confident_half
        return None if self.prediction is None else self.prediction.confident_half

    def as_dict(self) -> dict[str, Any]:
        """Return all figures as plain values."""
        return {
            "fraction": self.fraction,
            "used": list(self.used),
            "lines": len(self),
            "attack": self.recovery.info,
            "scores": None if self.scores is None else self.scores.as_dict(),
            "within_interval": None if self.scores is None else interval(self.scores.within_spacings["1"], len(self)),
            "prediction": None if self.prediction is None else asdict(self.prediction),
            "curves": self.curves.as_dict(),
        }

    def __len__(self) -> int:
        return len(self.lines)
