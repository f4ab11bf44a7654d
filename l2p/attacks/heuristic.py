"""The attack of Chelani et al. (CVPR 2021): neighbours by the distances of lines and estimates."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.attack import Estimate, in_own_order
from l2p.attacks.peak import PeakConfig
from l2p.attacks.settings import DENSITY, SCENE_KINDS
from l2p.attacks.votes import _equal, member, peaks, vote
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.nearest import (
    nearest_lines_to_lines,
    nearest_lines_to_points,
    nearest_points_to_lines,
)
from l2p.work.journal import Rounds
from l2p.work.progress import NO_PROGRESS, Progress
from l2p.work.shards import Shards


@dataclass(frozen=True)
class HeuristicConfig:
    """The paper's neighbour counts, from the table in its supplement (Chelani et al., CVPR 2021).

    Attributes
    ----------
    scene_kind : str
        ``outdoor``: 500 nearest lines, then 200; 100 and 50 at 5 % of the points or less. ``indoor``: 250 and 100;
        50 and 25.
    density : float
        Share of the map's points that the line cloud holds, in (0, 1], as far as it is known.
    rounds : int
        Refinements after the coarse stage.
    intersection : int
        N_pl and N_lp are intersected where more than this many lines are in both, else N_pl stands alone.
    peak : PeakConfig
    """

    scene_kind: str = SCENE_KINDS[0]
    density: float = DENSITY
    rounds: int = 3
    intersection: int = 10
    peak: PeakConfig = PeakConfig()

    def __post_init__(self) -> None:
        if self.scene_kind not in SCENE_KINDS:
            raise InputError(f"got scene kind {self.scene_kind!r}; expected one of {', '.join(SCENE_KINDS)}")
        if not 0 < self.density <= 1:
            raise InputError(f"got density {self.density}; expected a number in (0, 1]")
        if self.rounds < 0:
            raise InputError(f"got {self.rounds} rounds; expected 0 (the coarse stage alone) or more")

    @property
    def coarse(self) -> int:
        """Neighbours of the coarse stage."""
        return {("outdoor", True): 500, ("outdoor", False): 100, ("indoor", True): 250, ("indoor", False): 50}[
            self.scene_kind, self.density > 0.05
        ]

    @property
    def fine(self) -> int:
        """Neighbours of each refinement."""
        return {("outdoor", True): 200, ("outdoor", False): 50, ("indoor", True): 100, ("indoor", False): 25}[
            self.scene_kind, self.density > 0.05
        ]


class Heuristic:
    """The paper's attack: the nearest lines first, then those that are near both ways, N_pl and N_lp.

    Self is excluded and origins are canonical; the published code has neither, which favours it (``docs/``,
    "Fairness").
    """

    #: The confidence only ranks.
    calibrated = False

    def __init__(self, config: HeuristicConfig | None = None) -> None:
        self.config = config or HeuristicConfig()

    def locate(self, lines: Lines, frame: Frame, progress: Progress = NO_PROGRESS) -> Estimate:
        """Coarse stage and refinements; O(rounds x lines^2) time, O(lines k) memory."""
        return self.locate_in_rounds(lines, frame, progress, Rounds())

    def locate_in_rounds(self, lines: Lines, frame: Frame, progress: Progress, rounds: Rounds) -> Estimate:
        """The same by several processes, and from the last round that was kept."""
        return in_own_order(lines, lambda lines: self._refined(lines, progress, rounds), rounds.shards)

    def _refined(self, lines: Lines, progress: Progress, rounds: Rounds) -> Estimate:
        shards, peak = rounds.shards, self.config.peak
        done, kept = rounds.last({"beta": lines.direction[:, 0]})
        if done:
            neighbors = self._mutual(lines, lines.at(kept["beta"]), progress, shards)
        else:
            neighbors = nearest_lines_to_lines(lines, self.config.coarse, progress=progress, shards=shards).index
        for number in range(done, self.config.rounds):
            part = peaks(lines, neighbors, _equal(lines, neighbors), peak, progress, shards)
            beta = shards.gather(part, len(lines.direction))
            rounds.keep(number + 1, {"beta": beta})
            neighbors = self._mutual(lines, lines.at(beta), progress, shards)
        return vote(lines, neighbors, peak=peak, progress=progress, shards=shards)

    def _mutual(
        self, lines: Lines, points: Float[Tensor, "lines 3"], progress: Progress, shards: Shards
    ) -> Int[Tensor, "own k"]:
        near_line = nearest_points_to_lines(lines, points, self.config.fine, progress=progress, shards=shards).index
        near_point = nearest_lines_to_points(points, lines, self.config.fine, progress=progress, shards=shards).index
        both = member(near_line, near_point)
        enough = both.sum(dim=1, keepdim=True) > self.config.intersection
        return near_line.masked_fill(~both & enough, -1)

    @property
    def line_bytes(self) -> float:
        """What is held of each line (``benchmarks/memory.py``)."""
        return 1000 + 24 * self.config.coarse

    def settings(self) -> dict[str, Any]:
        """The configuration, and the neighbour counts that it led to."""
        return {**asdict(self.config), "coarse": self.config.coarse, "fine": self.config.fine}
