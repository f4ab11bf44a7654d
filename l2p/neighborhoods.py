"""Which lines are neighbours: what an attack may guess from the lines alone.

A neighbourhood gives, for each line, the lines whose points it takes to be near; the closest points to them vote, and
the peak of the votes is the estimate (:mod:`l2p.peak`). From the second round on the estimates of the round before
help to choose better neighbours. Neighbourhoods that know the answer are in :mod:`l2p.oracles`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l2p.errors import InputError
from l2p.frame import Frame
from l2p.geometry import Lines, closest_points
from l2p.memory import fitting
from l2p.methods import SCENE_KINDS
from l2p.peak import PeakConfig, find_peak
from l2p.progress import NO_PROGRESS, Progress
from l2p.rounds import Rounds
from l2p.search import (
    nearest_lines_to_lines,
    nearest_lines_to_points,
    nearest_points_to_lines,
    nearest_points_to_points,
)
from l2p.sharding import ALONE, Shards
from l2p.tomography import LINE_BYTES as TOMOGRAPHY_BYTES
from l2p.tomography import TomographyConfig, mass_within, modes, reconstruct

#: Most votes in one block of the peak search, and bytes of temporaries of each.
VOTES, _VOTE_BYTES = 1 << 21, 60


class Estimate(NamedTuple):
    """A position on each line, in the working frame, and what it rests on.

    ``confidence`` is in [0, 1], 0 where a line had no vote and was placed next to the centre. ``neighbors`` is -1 and
    ``affinity`` 0 where a line has fewer than k neighbours.
    """

    beta: Float[Tensor, " lines"]
    confidence: Float[Tensor, " lines"]
    neighbors: Int[Tensor, "lines k"]
    affinity: Float[Tensor, "lines k"]


@runtime_checkable
class Method(Protocol):
    """Anything that places a point on each line; all attacks, bounds and users' own methods share this call."""

    def locate(self, lines: Lines, frame: Frame, progress: Progress = NO_PROGRESS) -> Estimate:
        """Place the points, in the working frame; ``frame`` leads to scene units for those that know the truth."""
        ...

    def settings(self) -> dict[str, Any]:
        """Plain values that say what was run, for the record."""
        ...


@runtime_checkable
class MethodInRounds(Method, Protocol):
    """A method that several processes can share, and that can go on from a round."""

    def locate_in_rounds(self, lines: Lines, frame: Frame, progress: Progress, rounds: Rounds) -> Estimate:
        """Place the points as ``locate`` does; the first process has the answer, the others that of their own lines."""
        ...


def vote(
    lines: Lines,
    neighbors: Int[Tensor, "own k"],
    affinity: Float[Tensor, "own k"] | None = None,
    peak: PeakConfig | None = None,
    progress: Progress = NO_PROGRESS,
    shards: Shards = ALONE,
) -> Estimate:
    """The closest points to the neighbours vote, the peak is the estimate, its support the confidence.

    Affinities weight the votes; without them each neighbour has one vote.
    """
    weight = _equal(lines, neighbors) if affinity is None else affinity
    beta = peaks(lines, neighbors, weight, peak, progress, shards)
    return Estimate(beta, support(lines, neighbors, weight, beta, shards), neighbors, weight)


def own_order(lines: Lines) -> Int[Tensor, " lines"]:
    """The lines sorted by their coordinates."""
    key = torch.cat([lines.direction, lines.moment], dim=1).cpu().numpy()
    return torch.as_tensor(np.lexsort(key.T), device=lines.direction.device)


def in_own_order(lines: Lines, locate: Callable[[Lines], Estimate], shards: Shards = ALONE) -> Estimate:
    """What ``locate`` makes of the lines in an order that they decide themselves, in the order that they came in.

    Sums, and choices between equals, depend on the order; see :mod:`l2p.frame`. Of several processes, the first one
    has the answer, the others nothing.
    """
    order = own_order(lines)
    found = Estimate(*(shards.collect(part, len(order)) for part in locate(lines.rows(order))))
    if shards.rank > 0:
        return found
    place = order.argsort()
    near = found.neighbors[place]
    named = order[near.clamp_min(0).long()].to(near.dtype).masked_fill(near < 0, -1)
    return Estimate(found.beta[place], found.confidence[place], named, found.affinity[place])


def _equal(lines: Lines, neighbors: Int[Tensor, "own k"]) -> Float[Tensor, "own k"]:
    return (neighbors >= 0).to(lines.direction.dtype)


def peaks(
    lines: Lines,
    neighbors: Int[Tensor, "own k"],
    affinity: Float[Tensor, "own k"],
    peak: PeakConfig | None = None,
    progress: Progress = NO_PROGRESS,
    shards: Shards = ALONE,
) -> Float[Tensor, " own"]:
    """The peak of the neighbours' votes on each line; the foot, 0, where there is no vote. Blocked over lines."""
    own = lines.rows(shards.own(len(lines.direction)))
    beta = lines.direction.new_zeros(len(neighbors))
    with progress.task("peaks of the votes", total=len(neighbors)) as advance:
        for here in _blocks(neighbors):
            votes = closest_points(own.rows(here), lines, neighbors[here])
            beta[here] = find_peak(votes.beta, affinity[here] * votes.valid, peak).beta.nan_to_num(nan=0.0)
            advance(here.stop - here.start)
    return beta


def support(
    lines: Lines,
    neighbors: Int[Tensor, "own k"],
    affinity: Float[Tensor, "own k"],
    beta: Float[Tensor, " own"],
    shards: Shards = ALONE,
) -> Float[Tensor, " own"]:
    """Votes near the estimate over all votes that a line could have had, in [0, 1].

    Near means within the median, over the lines, of the median distance of a line's votes from its estimate. It ranks
    lines (column ``confidence_auc`` of ``python -m eval``); Kuiper's statistic does not, since it tells sharp peaks,
    right or wrong, from blunt ones.
    """
    own = lines.rows(shards.own(len(lines.direction)))
    distance = lines.direction.new_full((len(neighbors),), torch.nan)
    near = torch.zeros_like(distance)
    for here in _blocks(neighbors):
        distance[here] = _apart(own, lines, neighbors, affinity, beta, here).nanmedian(dim=1).values
    radius = shards.gather(distance, len(lines.direction)).nanmedian()
    for here in _blocks(neighbors):
        inside = _apart(own, lines, neighbors, affinity, beta, here) <= radius
        near[here] = (affinity[here] * inside).sum(dim=1)
    return (near / max(neighbors.shape[1], 1)).clamp(0, 1)


def _apart(
    own: Lines,
    lines: Lines,
    neighbors: Int[Tensor, "own k"],
    affinity: Float[Tensor, "own k"],
    beta: Float[Tensor, " own"],
    rows: slice,
) -> Float[Tensor, "rows k"]:
    """Distance of each vote from the estimate, NaN where there is no vote."""
    votes = closest_points(own.rows(rows), lines, neighbors[rows])
    apart = (votes.beta - beta[rows, None]).abs()
    return apart.masked_fill(~votes.valid | (affinity[rows] <= 0), torch.nan)


def _blocks(neighbors: Int[Tensor, "lines k"]) -> list[slice]:
    """Slices of lines, each with at most about ``VOTES`` votes."""
    count, k = neighbors.shape
    rows = max(1, fitting(VOTES, _VOTE_BYTES) // max(k, 1))
    return [slice(begin, min(begin + rows, count)) for begin in range(0, count if k else 0, rows)]


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

    scene_kind: str = "indoor"
    density: float = 1.0
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
    """The mode of the tomographic posterior, then the votes of the lines whose modes are near (:mod:`l2p.tomography`).

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
        """What is held of each line (``benchmarks/memory.py``)."""
        return TOMOGRAPHY_BYTES

    def settings(self) -> dict[str, Any]:
        """The configuration."""
        return asdict(self.config)


def member(values: Int[Tensor, "lines k"], sets: Int[Tensor, "lines m"]) -> Bool[Tensor, "lines k"]:
    """Whether each of a line's values is in its set; -1 is in none."""
    if sets.shape[1] == 0:
        return torch.zeros_like(values, dtype=torch.bool)
    ordered = sets.sort(dim=1).values
    place = torch.searchsorted(ordered, values).clamp_max(sets.shape[1] - 1)
    return (torch.gather(ordered, 1, place) == values) & (values >= 0)
