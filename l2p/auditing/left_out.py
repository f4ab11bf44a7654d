"""Points that were left out of a release, and how many of them have something near that is still there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from l2p.judging.near import share_near
from l2p.maps.recovery import Recovery
from l2p.maps.truth import Truth


@dataclass(frozen=True)
class Near:
    """Shares of the points that were left out, in one trial.

    Attributes
    ----------
    recovered : float
        Share with a recovered point within 1 spacing.
    published : float
        Share with a published point within 1 spacing, at its true place: the border, where neighbours that are
        published tell where points were that are not.
    """

    recovered: float
    published: float


@dataclass(frozen=True)
class LeftOut:
    """Points that were left out of a release.

    Attributes
    ----------
    points : int
        Their number.
    near : tuple of Near
        What is near them in each trial of the audit, in the order of the trials.
    """

    points: int
    near: tuple[Near, ...]

    @classmethod
    def of(
        cls, xyz: Float[np.ndarray, "points 3"], trials: Sequence[tuple[Recovery, Truth]], spacing: float
    ) -> LeftOut:
        """Measure what is within 1 spacing (scene units) of the points ``xyz`` that were left out."""
        published: dict[int, float] = {}
        near = []
        for recovery, truth in trials:
            # Attackers of one fraction attack the same lines.
            if id(truth) not in published:
                published[id(truth)] = share_near(xyz, truth.xyz, spacing)
            near.append(Near(share_near(xyz, recovery.xyz, spacing), published[id(truth)]))
        return cls(len(xyz), tuple(near))

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for a JSON file."""
        return {"points": self.points, "near": [asdict(near) for near in self.near]}
