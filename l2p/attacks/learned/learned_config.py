"""Settings of the learned attack around its network."""

from __future__ import annotations

import math
from dataclasses import dataclass

from l2p.attacks.learned.nodes import NodesConfig
from l2p.attacks.learned.teaching import TeachingConfig
from l2p.attacks.peak import PeakConfig
from l2p.attacks.tomography.reconstruct import TomographyConfig
from l2p.errors import InputError


@dataclass(frozen=True)
class LearnedConfig:
    """Settings of the rounds around the network.

    Attributes
    ----------
    rounds, alike_rounds : int
        Number of times that the network judges all lines: lines alone, and with likeness, which moves estimates longer.
    candidates : int
        Candidates per line: the estimates nearest to it, in units of the square root of their local scale, so that
        neither dense nor sparse places along the line provide all candidates.
    alike, liking : int, float
        Candidates per line if there is likeness: of the ``alike`` nearest estimates, those with the least distance
        times exp(-liking * likeness).
    peak : PeakConfig
        Search of the peak; votes are not trimmed, since their weights suppress outliers.
    relaxation : float
        Factor on the move of an estimate between two rounds: over-relaxation (Young, 1954), since the estimates around
        it tend to move the same way. Moves of more than a local scale, to another peak, are not changed, nor are those
        of the last round.
    settling : int
        Steps of the M-estimate from Kuiper's peak (:func:`l2p.attacks.peak.settled`); 0 returns the peak.
    widening : float
        Factor on the predicted spread of votes in the M-estimate: the network's spread is that of correct votes,
        outliers need a wider kernel.
    dimension : float
        Effective dimension of SfM points, which form clusters on surfaces; fitted on thinned training scenes
        (``benchmarks/spacing_ratio.py``).
    tomography : TomographyConfig
        Settings of the coarse stage, which also gives the tomographic inputs.
    nodes : NodesConfig
        Local scales and surfaces.
    teaching : TeachingConfig
        Lessons about the appearances of the map, between the rounds.
    """

    rounds: int = 3
    alike_rounds: int = 4
    candidates: int = 32
    alike: int = 96
    liking: float = 0.4
    peak: PeakConfig = PeakConfig(threshold=0.5, trim=0)
    relaxation: float = 1.4
    settling: int = 6
    widening: float = 4.0
    dimension: float = 1.9
    tomography: TomographyConfig = TomographyConfig()
    nodes: NodesConfig = NodesConfig()
    teaching: TeachingConfig = TeachingConfig()

    def __post_init__(self) -> None:
        for name, least in (("rounds", 0), ("alike_rounds", 0), ("candidates", 1), ("alike", 1), ("settling", 0)):
            value = getattr(self, name)
            if value < least:
                raise InputError(f"got {name} {value} of the learned attack; expected at least {least}")
        if not 0 < self.relaxation < 2:
            raise InputError(
                f"got relaxation {self.relaxation} of the learned attack; expected more than 0, less than 2"
            )
        for name in ("widening", "dimension"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"got {name} {getattr(self, name)} of the learned attack; expected more than 0")
