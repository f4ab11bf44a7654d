"""The tomographic attack: modes of the posterior, then votes of the lines with the nearest estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from jaxtyping import Float
from torch import Tensor

from l2p.attacks.attack import Attack, Elements, Estimate
from l2p.attacks.families import other_points_near_points
from l2p.attacks.peak import PeakConfig
from l2p.attacks.settings import TomographySettings
from l2p.attacks.structure import Structure
from l2p.attacks.structured import STRUCTURED
from l2p.attacks.tomography.posterior import Posterior, first_places, mass_within
from l2p.attacks.tomography.reconstruct import LINE_BYTES, TomographyConfig, reconstruct
from l2p.attacks.votes import equal_weights, peaks
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.nearest import Nearest, nearest_points_to_points
from l2p.schemes.recognition import FALSE_PLACES
from l2p.work.work import Work


@dataclass(frozen=True)
class TomographicConfig(TomographySettings):
    """Settings of the tomographic attack.

    Attributes
    ----------
    tomography : TomographyConfig
        The coarse stage.
    nearest : int
        Voters per line: the lines whose estimates are nearest to its own.
    rounds : int
        Rounds of votes, first around the modes of the posterior, then around the last estimates; 0 returns the modes.
    peak : PeakConfig
    """

    tomography: TomographyConfig = field(default_factory=TomographyConfig)
    nearest: int = 12
    peak: PeakConfig = PeakConfig()

    def __post_init__(self) -> None:
        if self.rounds < 0:
            raise InputError(f"got {self.rounds} rounds; expected 0 (the modes alone) or more")


class _State(NamedTuple):
    """Posterior of this process's lines, estimates of all lines, and the nearest estimates to each of its own."""

    lines: Lines
    posterior: Posterior
    beta: Float[Tensor, " lines"]
    near: Nearest
    structure: Structure


class Tomography(Attack):
    """The mode of the tomographic posterior, then votes of the lines with the nearest estimates
    (:mod:`l2p.attacks.tomography.reconstruct`).

    O(lines x segments) for the posterior, O(lines log lines) for the search of the voters. The confidence is the
    posterior probability within twice the median distance of the voters: it ranks, and is not calibrated. Lines through
    centres get votes of the other families only; the two points of a line start at the two modes of its posterior.
    """

    schemes = (*STRUCTURED, FALSE_PLACES)

    by_part = True
    columns: Mapping[str, tuple[int, ...]] = {"beta": ()}
    line_bytes = LINE_BYTES

    def __init__(self, config: TomographicConfig | None = None) -> None:
        self.config = config or TomographicConfig()
        self.rounds = self.config.rounds

    def begin(self, elements: Elements, saved: Mapping[str, Tensor] | None, work: Work) -> _State:
        """Reconstruct the posterior, which the confidence always needs; without saved estimates, take its modes."""
        lines, structure = elements.lines, elements.structure
        posterior = reconstruct(lines, self.config.tomography, work, structure)
        if saved is None:
            beta = work.gather(first_places(posterior, structure.twin, work.own(len(elements))), len(elements))
        else:
            beta = saved["beta"]
        return self._around(lines, posterior, beta, structure, work)

    def step(self, state: _State, work: Work) -> _State:
        """Take the peak of the voters' closest points, then the voters of the new estimates."""
        lines, voters = state.lines, state.near.index
        beta = peaks(lines, voters, equal_weights(lines, voters), self.config.peak, work)
        return self._around(lines, state.posterior, work.gather(beta, len(state.beta)), state.structure, work)

    def finish(self, state: _State, work: Work) -> Estimate:
        """Compute the confidence of the estimates from the posterior."""
        count = len(state.beta)
        distance = work.gather(state.near.distance, count)
        radius = 2 * float(distance.median()) if distance.numel() else 0.0
        beta, voters = state.beta[work.own(count)], state.near.index
        return Estimate(beta, mass_within(state.posterior, beta, radius), voters, equal_weights(state.lines, voters))

    def _around(
        self, lines: Lines, posterior: Posterior, beta: Float[Tensor, " lines"], structure: Structure, work: Work
    ) -> _State:
        points, k = lines.at(beta), self.config.nearest
        if structure.family is None:
            near = nearest_points_to_points(points, k, work=work)
        else:
            near = other_points_near_points(points, k, structure.family, work)
        return _State(lines, posterior, beta, near, structure)

    def settings(self) -> dict[str, Any]:
        """Return the configuration."""
        return asdict(self.config)


def build(settings: TomographySettings) -> Tomography:
    """Build the attack with these settings."""
    return Tomography(TomographicConfig(**asdict(settings)))
