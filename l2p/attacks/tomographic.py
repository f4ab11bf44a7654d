"""The tomographic attack: modes of the posterior, then the votes of the lines whose estimates are near."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from l2p.attacks.attack import Estimate, in_own_order
from l2p.attacks.peak import PeakConfig
from l2p.attacks.tomography.posterior import mass_within, modes
from l2p.attacks.tomography.reconstruct import LINE_BYTES as TOMOGRAPHY_BYTES
from l2p.attacks.tomography.reconstruct import TomographyConfig, reconstruct
from l2p.attacks.votes import _equal, peaks
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.nearest import (
    nearest_points_to_points,
)
from l2p.work.journal import Rounds
from l2p.work.progress import NO_PROGRESS, Progress


@dataclass(frozen=True)
class TomographicConfig:
    """Settings of the tomographic attack.

    Attributes
    ----------
    tomography : TomographyConfig
        The coarse stage.
    nearest : int
        Lines that vote: those whose estimates are nearest to a line's own.
    rounds : int
        Times that the votes are taken, first around the modes of the posterior, then around the estimates of the time
        before; 0 leaves the modes.
    peak : PeakConfig
    """

    tomography: TomographyConfig = field(default_factory=TomographyConfig)
    nearest: int = 12
    rounds: int = 2
    peak: PeakConfig = PeakConfig()

    def __post_init__(self) -> None:
        if self.rounds < 0:
            raise InputError(f"got {self.rounds} rounds; expected 0 (the modes alone) or more")


class Tomography:
    """The mode of the tomographic posterior, then the votes of the lines whose modes are near
    (:mod:`l2p.attacks.tomography.reconstruct`).

    The confidence is the posterior probability within twice the median distance of the voters: it ranks, and is not
    calibrated.
    """

    def __init__(self, config: TomographicConfig | None = None) -> None:
        self.config = config or TomographicConfig()

    def locate(self, lines: Lines, frame: Frame, progress: Progress = NO_PROGRESS) -> Estimate:
        """O(lines x segments) for the posterior, O(lines log lines) for the search of the voters."""
        return self.locate_in_rounds(lines, frame, progress, Rounds())

    def locate_in_rounds(self, lines: Lines, frame: Frame, progress: Progress, rounds: Rounds) -> Estimate:
        """The same by several processes, and from the last round that was kept."""
        return in_own_order(lines, lambda lines: self._voted(lines, progress, rounds), rounds.shards)

    def _voted(self, lines: Lines, progress: Progress, rounds: Rounds) -> Estimate:
        shards, count = rounds.shards, len(lines.direction)
        # The confidence needs the posterior, whatever rounds are done.
        posterior = reconstruct(lines, self.config.tomography, progress, shards)
        done, kept = rounds.last({"beta": lines.direction[:, 0]})
        beta = kept["beta"] if done else shards.gather(modes(posterior)[0], count)
        near = nearest_points_to_points(lines.at(beta), self.config.nearest, shards=shards)
        for number in range(done, self.config.rounds):
            part = peaks(lines, near.index, _equal(lines, near.index), self.config.peak, progress, shards)
            beta = shards.gather(part, count)
            rounds.keep(number + 1, {"beta": beta})
            near = nearest_points_to_points(lines.at(beta), self.config.nearest, shards=shards)
        distance = shards.gather(near.distance, count)
        radius = 2 * float(distance.median()) if distance.numel() else 0.0
        own = beta[shards.own(count)]
        return Estimate(own, mass_within(posterior, own, radius), near.index, _equal(lines, near.index))

    @property
    def line_bytes(self) -> float:
        """What is held of each line (``benchmarks/recover.py``)."""
        return TOMOGRAPHY_BYTES

    def settings(self) -> dict[str, Any]:
        """The configuration."""
        return asdict(self.config)
