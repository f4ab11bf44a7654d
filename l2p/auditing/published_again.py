"""A map that is published more than once, with other directions each time: what its releases give away together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from l2p.judging.accuracy import errors
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene
from l2p.maps.short_repr import short_repr
from l2p.schemes.hide import hide

#: Most releases of an audit.
MOST_RELEASES = 9
#: An error, in spacings, within which a point counts as given away exactly.
EXACT = 0.02


@dataclass(frozen=True)
class AgainTrial:
    """Releases of one fraction, attacked together by their lines alone.

    Attributes
    ----------
    fraction : float
        Fraction of the map's points in each release, drawn anew each time.
    lines, met : int
        Lines of the first release, and how many meet a line of another one in their point.
    within, exact : float
        Share of the points of the first release that come back within 1 spacing, and within :data:`EXACT` spacings.
    median : float
        Median error, spacings.
    seconds : float
    """

    fraction: float
    lines: int
    met: int
    within: float
    exact: float
    median: float
    seconds: float


@dataclass(frozen=True)
class PublishedAgain:
    """What several releases give away together; ``trials`` go from the largest to the smallest fraction."""

    releases: int
    trials: tuple[AgainTrial, ...]

    __repr__ = short_repr

    @classmethod
    def of(
        cls,
        scene: Scene,
        releases: int,
        fractions: Sequence[float],
        seed: int,
        scale: float,
        attack: Callable[[list[LineCloud], float], Recovery],
        drop: np.ndarray | None = None,
    ) -> PublishedAgain:
        """Lift each fraction so many times, with the seeds from ``seed`` on, and attack the releases together."""
        trials = []
        for fraction in fractions:
            hidden = [hide(scene, seed + number, fraction, drop=drop) for number in range(releases)]
            recovery = attack([each.map for each in hidden], fraction)
            error = errors(recovery, hidden[0].truth) / scale
            within, exact = (float(np.mean(error <= limit)) for limit in (1, EXACT))
            met, seconds = recovery.info["met"], recovery.info["seconds"]
            trials.append(AgainTrial(fraction, len(recovery), met, within, exact, float(np.median(error)), seconds))
        return cls(releases, tuple(trials))

    def as_dict(self) -> dict[str, Any]:
        """Return all figures as plain values."""
        return {"releases": self.releases, "exact": EXACT, "trials": [asdict(trial) for trial in self.trials]}
