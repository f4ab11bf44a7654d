"""Other ways to hide the map: each scheme is lifted and attacked as the audit's own line clouds are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from l2p.auditing.attackers import Attacker, others
from l2p.judging.accuracy import compare
from l2p.judging.measure import measured
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene
from l2p.maps.short_repr import short_repr
from l2p.maps.truth import Hiding
from l2p.schemes.hide import hide
from l2p.utility.releases import localizes


@dataclass(frozen=True)
class SchemeTrial:
    """One attack on the map as one scheme hides it.

    Attributes
    ----------
    scheme : str
    fraction : float
        Fraction of the map's points that was given to the scheme.
    used : tuple of str
        The attacker: names of the published attributes that the attack used.
    points : int
        Points behind what is published; some schemes leave points out.
    within : float
        Share of these that come back within 1 spacing.
    median : float
        Median error, spacings.
    both : float or None
        Share of the lines of which both points come back; None if lines have one point.
    real : float or None
        Area under the ROC curve of telling real elements from fakes by the confidence; None without fakes.
    seconds : float
    """

    scheme: str
    fraction: float
    used: Attacker
    points: int
    within: float
    median: float
    both: float | None
    real: float | None
    seconds: float


@dataclass(frozen=True, eq=False)
class OtherSchemes:
    """Attacks on the map hidden by other schemes.

    Attributes
    ----------
    trials : tuple of SchemeTrial
        By scheme; of each from the largest to the smallest fraction, and from the attacker who uses most to the one who
        uses nothing else.
    hidden : mapping
        The map of each scheme and fraction in which cameras can be localized.
    """

    trials: tuple[SchemeTrial, ...]
    hidden: dict[tuple[str, float], Hiding]

    __repr__ = short_repr

    @classmethod
    def of(
        cls,
        scene: Scene,
        schemes: Sequence[str],
        fractions: Sequence[float],
        seed: int,
        scale: float,
        used: Attacker,
        attack: Callable[[Any, float], Recovery],
        drop: np.ndarray | None = None,
    ) -> OtherSchemes:
        """Hide each fraction by each scheme, and attack it by all that is published and without appearance.

        Raises
        ------
        InputError
            If a scheme cannot hide these points.
        """
        trials: list[SchemeTrial] = []
        kept: dict[tuple[str, float], Hiding] = {}
        for scheme in schemes:
            for fraction in fractions:
                rgb, descriptor = "rgb" in used, "descriptor" in used
                hidden = hide(scene, seed, fraction, scheme, rgb, descriptor, drop=drop)
                if localizes(hidden):
                    kept[scheme, fraction] = hidden
                for attacker in dict.fromkeys((used, ())):
                    recovery = attack(hidden.map.without(others(attacker)), fraction)
                    found = measured(compare(recovery, hidden.truth, scale))
                    figures = (
                        found.get(name) for name in ("within_1", "median_spacings", "both_within_1", "fakes_auc")
                    )
                    within, median, both, real = figures
                    assert within is not None and median is not None
                    seconds = float(recovery.info["seconds"])
                    points = len(hidden.truth)
                    trials.append(SchemeTrial(scheme, fraction, attacker, points, within, median, both, real, seconds))
        return cls(tuple(trials), kept)

    def of_scheme(self, scheme: str, fraction: float, used: Attacker) -> SchemeTrial:
        """Return the trial of one attacker."""
        return next(t for t in self.trials if (t.scheme, t.fraction, t.used) == (scheme, fraction, used))

    @property
    def schemes(self) -> tuple[str, ...]:
        """Names of the schemes, in the order of the user."""
        return tuple(dict.fromkeys(trial.scheme for trial in self.trials))

    def as_dict(self) -> list[dict[str, Any]]:
        """Return all figures as plain values."""
        return [asdict(trial) for trial in self.trials]


def attacks_of(schemes: Sequence[str], fractions: Sequence[float], used: Attacker) -> int:
    """Number of attacks of a comparison, for its progress."""
    return len(schemes) * len(fractions) * (2 if used else 1)
