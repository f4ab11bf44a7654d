"""How much comes back of a region that the owner of a map asks about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from l2p.auditing.trial import Trial
from l2p.judging.accuracy import errors
from l2p.maps.short_repr import short_repr


@dataclass(frozen=True)
class InRegion:
    """What one attack gets back of a region.

    Attributes
    ----------
    published : int
        Points of the region that are published.
    within : float or None
        Share of these that come back within 1 spacing; None if none is published.
    median : float or None
        Their median error, spacings.
    """

    published: int
    within: float | None
    median: float | None


@dataclass(frozen=True)
class AskedRegion:
    """A region of a map.

    Attributes
    ----------
    points : int
        Points of the map in it.
    trials : tuple of InRegion
        What comes back in each trial of the audit, in the order of the trials.
    """

    points: int
    trials: tuple[InRegion, ...]

    __repr__ = short_repr

    @classmethod
    def of(cls, region: Bool[np.ndarray, " points"], trials: Sequence[Trial], spacing: float) -> AskedRegion:
        """Measure the trials in a region, True for each of its points; ``spacing`` in scene units."""
        found = []
        for trial in trials:
            assert trial.truth is not None
            error = errors(trial.recovery, trial.truth)[region[trial.truth.index]] / spacing
            some = len(error) > 0
            within, median = (float((error <= 1).mean()), float(np.median(error))) if some else (None, None)
            found.append(InRegion(len(error), within, median))
        return cls(int(region.sum()), tuple(found))

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for a JSON file."""
        return {"points": self.points, "trials": [asdict(trial) for trial in self.trials]}
