"""The attack of Chelani et al. (CVPR 2021): neighbours by the distances of lines and estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.attack import Attack, Elements, Estimate
from l2p.attacks.peak import PeakConfig
from l2p.attacks.settings import SCENE_KINDS, HeuristicSettings
from l2p.attacks.votes import equal_weights, member, peaks, vote
from l2p.checks import check_fraction
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.nearest import nearest_lines_to_lines, nearest_lines_to_points, nearest_points_to_lines
from l2p.work.work import Work


@dataclass(frozen=True)
class HeuristicConfig(HeuristicSettings):
    """The paper's neighbour counts, from the table in its supplement (Chelani et al., CVPR 2021).

    Attributes
    ----------
    scene_kind : str
        ``outdoor``: 500 nearest lines, then 200; 100 and 50 at 5 % of the points or less. ``indoor``: 250 and 100;
        50 and 25.
    fraction : float
        Fraction of the map's points in the line cloud, in (0, 1], as far as it is known.
    rounds : int
        Refinements after the coarse stage.
    intersection : int
        N_pl and N_lp are intersected if they have more than this many lines in common; otherwise N_pl is used.
    peak : PeakConfig
    """

    intersection: int = 10
    peak: PeakConfig = PeakConfig()

    def __post_init__(self) -> None:
        if self.scene_kind not in SCENE_KINDS:
            raise InputError(f"got scene kind {self.scene_kind!r}; expected one of {', '.join(SCENE_KINDS)}")
        check_fraction(self.fraction)
        if self.rounds < 0:
            raise InputError(f"got {self.rounds} rounds; expected 0 (the coarse stage alone) or more")

    @property
    def coarse(self) -> int:
        """Neighbours of the coarse stage."""
        return {("outdoor", True): 500, ("outdoor", False): 100, ("indoor", True): 250, ("indoor", False): 50}[
            self.scene_kind, self.fraction > 0.05
        ]

    @property
    def fine(self) -> int:
        """Neighbours of each refinement."""
        return {("outdoor", True): 200, ("outdoor", False): 50, ("indoor", True): 100, ("indoor", False): 25}[
            self.scene_kind, self.fraction > 0.05
        ]


class _State(NamedTuple):
    """Estimates of all lines, and neighbours of this process's lines around them."""

    lines: Lines
    beta: Float[Tensor, " lines"]
    neighbors: Int[Tensor, "own k"]


class Heuristic(Attack):
    """The paper's attack: votes of the nearest lines first, then of lines in both N_pl and N_lp.

    O(rounds x lines^2) time, O(lines k) memory. A line is not its own neighbour, and origins are canonical; the
    published code does neither, which favours it (``docs/``, "Fairness").
    """

    by_part = True
    columns: Mapping[str, tuple[int, ...]] = {"beta": ()}

    def __init__(self, config: HeuristicConfig | None = None) -> None:
        self.config = config or HeuristicConfig()
        self.rounds = self.config.rounds
        # Measured by benchmarks/recover.py.
        self.line_bytes = 1000 + 24 * self.config.coarse

    def begin(self, elements: Elements, saved: Mapping[str, Tensor] | None, work: Work) -> _State:
        """Find the nearest lines, or the mutual neighbours of saved estimates."""
        lines = elements.lines
        if saved is not None:
            return self._around(lines, saved["beta"], work)
        near = nearest_lines_to_lines(lines, self.config.coarse, work=work)
        return _State(lines, lines.direction[:, 0], near.index)

    def step(self, state: _State, work: Work) -> _State:
        """Take the peak of the neighbours' votes, then the neighbours of the new estimates."""
        lines, neighbors = state.lines, state.neighbors
        beta = peaks(lines, neighbors, equal_weights(lines, neighbors), self.config.peak, work)
        return self._around(lines, work.gather(beta, len(lines.direction)), work)

    def finish(self, state: _State, work: Work) -> Estimate:
        """Vote once more."""
        return vote(state.lines, state.neighbors, peak=self.config.peak, work=work)

    def _around(self, lines: Lines, beta: Float[Tensor, " lines"], work: Work) -> _State:
        """Find the neighbours: N_pl of each line, intersected with N_lp of its estimate if enough remain."""
        points = lines.at(beta)
        near_line = nearest_points_to_lines(lines, points, self.config.fine, work=work).index
        near_point = nearest_lines_to_points(points, lines, self.config.fine, work=work).index
        both = member(near_line, near_point)
        enough = both.sum(dim=1, keepdim=True) > self.config.intersection
        return _State(lines, beta, near_line.masked_fill(~both & enough, -1))

    def settings(self) -> dict[str, Any]:
        """Return the configuration and its neighbour counts."""
        return {**asdict(self.config), "coarse": self.config.coarse, "fine": self.config.fine}


def build(settings: HeuristicSettings) -> Heuristic:
    """Build the attack with these settings."""
    return Heuristic(HeuristicConfig(**asdict(settings)))
