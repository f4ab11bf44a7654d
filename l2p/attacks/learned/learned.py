"""The learned attack: tomography first, then rounds of candidates, affinities and weighted peaks.

Each round looks at the lines' candidates around the estimates of the round before, lets the network judge them
(:mod:`l2p.attacks.learned.network`), and takes the place where their votes settle around their peak, each with its
weight. All rounds share one network: it was trained on the estimates of all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.attack import Estimate, in_own_order
from l2p.attacks.learned.features import STATE, Nodes, Told, described, edges, nearest_estimates, surroundings
from l2p.attacks.learned.network import NO_VOTE, NOTHING, RADII, Judgement, LineTransformer
from l2p.attacks.peak import PeakConfig, find_peak, settled
from l2p.attacks.tomography.posterior import Posterior, mass_within, modes
from l2p.attacks.tomography.reconstruct import LINE_BYTES as TOMOGRAPHY_BYTES
from l2p.attacks.tomography.reconstruct import TomographyConfig, reconstruct
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.nearest import nearest_points_to_lines
from l2p.work.journal import Rounds
from l2p.work.progress import NO_PROGRESS, Progress
from l2p.work.shards import ALONE, BLOCK, Shards
from l2p.work.threads import over_blocks

#: Of the radii, the one that the lines around are told the confidence of.
_TOLD = RADII.index(1.0)
#: Errors of votes that settle together, over the spread of a vote when it is right and the others may be wrong.
_WIDER = 4.0
#: Points of maps lie on surfaces, and in bunches on them: the dimension that spacings of thinned training scenes show.
_DIMENSION = 1.9


@dataclass(frozen=True)
class LearnedConfig:
    """How the rounds run around the network.

    Attributes
    ----------
    rounds : int
        Times that the network judges all lines.
    candidates : int
        Candidates of each line: the estimates nearest to it, in units of the square root of their local scale, so
        that neither the dense nor the sparse places that it passes take all.
    batch : int
        Lines judged at a time; the answer does not depend on it.
    peak : PeakConfig
        The weighted votes are not trimmed: the weights have done it.
    relaxation : float
        Between two rounds an estimate goes this many times as far as the last round moved it: over-relaxation (Young,
        1954), since the estimates around it are about to move the same way. Moves of more than a local scale, which
        are changes of mind, are left as they are, and so are those of the last round.
    settling : int
        Steps in which a peak settles among the votes around it (:func:`l2p.attacks.peak.settled`); 0 leaves Kuiper's.
    weight : str
        What weighs the votes: ``vote``, the network's word on each of them; ``affinity``, the square of the candidate's
        affinity, the same for all of its votes.
    """

    rounds: int = 3
    candidates: int = 32
    batch: int = BLOCK
    peak: PeakConfig = PeakConfig(threshold=0.5, trim=0)
    relaxation: float = 1.4
    settling: int = 6
    weight: str = "vote"

    def __post_init__(self) -> None:
        for name, least in (("rounds", 0), ("candidates", 1), ("batch", 1), ("settling", 0)):
            value = getattr(self, name)
            if value < least:
                raise InputError(f"got {name} {value} of the learned attack; expected at least {least}")
        if not 0 < self.relaxation < 2:
            raise InputError(
                f"got relaxation {self.relaxation} of the learned attack; expected more than 0, less than 2"
            )
        if self.weight not in ("vote", "affinity"):
            raise InputError(f"got weight {self.weight!r} of the learned attack; expected 'vote' or 'affinity'")


class Round(NamedTuple):
    """What a round finds: the estimates of all lines, and of the lines of this process the candidates with their
    affinities, and how sure it is of each estimate (logits, see :class:`l2p.attacks.learned.network.Judgement`)."""

    told: Told
    candidates: Int[Tensor, "own k"]
    affinity: Float[Tensor, "own k"]
    sure: Float[Tensor, "own radii"]


def first_nodes(lines: Lines, posterior: Posterior, shards: Shards = ALONE) -> Nodes:
    """What is known before the first round: the modes of the posterior."""
    count = len(lines.direction)
    mode, _ = modes(posterior)
    beta = shards.gather(mode, count)
    around = nearest_estimates(lines, beta, shards)
    confidence = shards.gather(mass_within(posterior, mode, around.scale[shards.own(count)]), count)
    return described(lines, around, Told(beta, confidence, beta.new_zeros(count, STATE)), shards)


def find_candidates(
    lines: Lines, nodes: Nodes, config: LearnedConfig, progress: Progress = NO_PROGRESS, shards: Shards = ALONE
) -> Int[Tensor, "own k"]:
    """The candidates of each line, -1 for none."""
    scale = nodes.scale.sqrt()
    near = nearest_points_to_lines(lines, nodes.point, config.candidates, scale=scale, progress=progress, shards=shards)
    return near.index


def judge_round(
    lines: Lines,
    nodes: Nodes,
    posterior: Posterior,
    network: LineTransformer,
    config: LearnedConfig,
    progress: Progress = NO_PROGRESS,
    shards: Shards = ALONE,
) -> Round:
    """Run one round on all lines, or on those of this process; the network in evaluation mode."""
    candidates = find_candidates(lines, nodes, config, progress, shards)
    own, count = shards.own(len(nodes.beta)), len(candidates)
    beta, state = nodes.beta[own].clone(), torch.zeros_like(nodes.state[own])
    affinity = torch.zeros_like(candidates, dtype=beta.dtype)
    sure = beta.new_full((count, len(RADII)), NOTHING)
    row_bytes = judging_bytes(network, candidates.shape[1])

    def judged(block: slice) -> tuple[Judgement, Tensor]:
        rows = torch.arange(own.start + block.start, own.start + block.stop, device=candidates.device)
        judgement = network(edges(lines, nodes, posterior, rows, candidates[block], own.start))
        return judgement, weighted_peak(judgement, config)

    with progress.task("affinities", total=count) as advance:
        if candidates.shape[1]:
            for block, (judgement, moved) in over_blocks(judged, count, config.batch, candidates.device, row_bytes):
                beta[block] += moved
                state[block], sure[block] = judgement.state, judgement.sure
                affinity[block] = torch.sigmoid(judgement.affinity)
                advance(block.stop - block.start)
    found = Told(*(shards.gather(part, len(nodes.beta)) for part in (beta, told(sure), state)))
    return Round(found, candidates, affinity, sure)


def judging_bytes(network: LineTransformer, k: int) -> float:
    """Temporaries of a line with k candidates: kernels of all pairs of them for each head, and their tokens."""
    width, heads = network.config.width, network.config.heads
    return 4 * k * (k * (2 * heads + 2) + 12 * width + 450)


def told(sure: Float[Tensor, "lines radii"]) -> Float[Tensor, " lines"]:
    """The confidence that the lines around are told in the next round, as the network gives it."""
    return torch.sigmoid(sure[:, _TOLD])


def relaxed(nodes: Nodes, found: Told, config: LearnedConfig) -> Told:
    """What a round found, its estimates moved farther than it moved those of ``nodes``, for the next round."""
    moved = found.beta - nodes.beta
    ahead = nodes.beta + config.relaxation * moved
    return found._replace(beta=torch.where(moved.abs() < nodes.scale, ahead, found.beta))


def weighted_peak(judgement: Judgement, config: LearnedConfig) -> Float[Tensor, " lines"]:
    """The peak of the votes, weighted by the network, counted from the estimate before; 0 where there is no vote."""
    if config.weight == "vote":
        weight = torch.softmax(judgement.vote.flatten(1), dim=1)
    else:
        weight = torch.sigmoid(judgement.affinity).square()[..., None]
        weight = (weight * (judgement.vote > NO_VOTE)).flatten(1)
    place = judgement.place.flatten(1)
    peak = find_peak(place, weight, config.peak).beta
    spread = _WIDER * judgement.spread.flatten(1)
    return settled(peak, place, weight, spread, config.settling).nan_to_num(nan=0.0)


class Learned:
    """The learned attack.

    Parameters
    ----------
    network : LineTransformer
    config : LearnedConfig, optional
    calibration : sequence of sequences of (a, b), optional
        For each round and radius: sigmoid(a sure + b) is the probability that a point is within that radius. Rounds
        tell each other what the network gives.
    density : float
        Share of the map's points that the line cloud holds, as far as it is known. The confidence is that of lying
        within 1 spacing of the *map*, which is less than that of a thinned cloud.

    Raises
    ------
    InputError
        If there are more rounds than calibrations.
    """

    def __init__(
        self,
        network: LineTransformer,
        config: LearnedConfig | None = None,
        calibration: Sequence[Sequence[tuple[float, float]]] | None = None,
        density: float = 1.0,
    ) -> None:
        self.network = network.eval()
        self.config = config or LearnedConfig()
        self.calibration = calibration or [[(1.0, 0.0)] * len(RADII)] * self.config.rounds
        if len(self.calibration) < self.config.rounds:
            raise InputError(
                f"got {len(self.calibration)} calibrations for {self.config.rounds} rounds; expected as many"
            )
        self.density = density

    def locate(self, lines: Lines, frame: Frame, progress: Progress = NO_PROGRESS) -> Estimate:
        """Tomography, then the rounds; O(rounds x lines x k^2) besides the searches."""
        return self.locate_in_rounds(lines, frame, progress, Rounds())

    def locate_in_rounds(self, lines: Lines, frame: Frame, progress: Progress, rounds: Rounds) -> Estimate:
        """The same by several processes, and from the last round that was kept."""
        return in_own_order(lines, lambda lines: self._judged(lines, progress, rounds), rounds.shards)

    def _judged(self, lines: Lines, progress: Progress, rounds: Rounds) -> Estimate:
        shards = rounds.shards
        network = self.network.to(lines.direction.device)
        posterior = reconstruct(lines, TomographyConfig(), progress, shards)
        own = shards.own(len(lines.direction))
        done, nodes = self._begun(lines, posterior, rounds)
        if not self.config.rounds:
            candidates = find_candidates(lines, nodes, self.config, progress, shards)
            affinity = (candidates >= 0).to(nodes.beta.dtype)
            return Estimate(nodes.beta[own], nodes.confidence[own], candidates, affinity)
        for number in range(done + 1, self.config.rounds):
            found = judge_round(lines, nodes, posterior, network, self.config, progress, shards)
            ahead = relaxed(nodes, found.told, self.config)
            rounds.keep(number, ahead._asdict())
            nodes = surroundings(lines, ahead, shards)
        found = judge_round(lines, nodes, posterior, network, self.config, progress, shards)
        return Estimate(found.told.beta[own], self.confidence(found), found.candidates, found.affinity)

    def _begun(self, lines: Lines, posterior: Posterior, rounds: Rounds) -> tuple[int, Nodes]:
        """How many rounds are done, and what is known after them."""
        number = lines.direction[:, 0]
        like = Told(number, number, number.new_zeros(len(number), STATE))
        done, kept = rounds.last(like._asdict())
        if not done:
            return 0, first_nodes(lines, posterior, rounds.shards)
        return done, surroundings(lines, Told(**kept), rounds.shards)

    def confidence(self, found: Round) -> Float[Tensor, " own"]:
        """Calibrated probability that each point of the last round lies within 1 spacing of the map."""
        calibration = found.sure.new_tensor(self.calibration[self.config.rounds - 1])
        logit = (calibration[:, 0] * found.sure + calibration[:, 1]).cummax(dim=1).values
        return torch.sigmoid(_between(logit, math.log(spacing_ratio(self.density))))

    @property
    def line_bytes(self) -> float:
        """What is held of each line (``benchmarks/recover.py``)."""
        return max(TOMOGRAPHY_BYTES, 4000 + 40 * self.config.candidates)

    def settings(self) -> dict[str, Any]:
        """Rounds, candidates, size of the network, density."""
        return {**asdict(self.config), "network": asdict(self.network.config), "density": self.density}


def spacing_ratio(density: float) -> float:
    """Spacing of a map over that of the share ``density`` of its points: the root of the share.

    Estimates do not tell it well: at 10 % and 5 % of five training scenes theirs gave four fifths of the ratio, since
    they scatter. The usual dimension of maps does better (``benchmarks/spacing_ratio.py``).
    """
    return density ** (1 / _DIMENSION)


def _between(logit: Float[Tensor, "lines radii"], log_radius: float) -> Float[Tensor, " lines"]:
    """The logit at a radius between those that the network knows, in line over the logarithm of the radius.

    Below the smallest the line goes on: with the radius the probability falls to 0.
    """
    known = [math.log(radius) for radius in RADII]
    after = min(max(sum(radius <= log_radius for radius in known), 1), len(known) - 1)
    share = (log_radius - known[after - 1]) / (known[after] - known[after - 1])
    return torch.lerp(logit[:, after - 1], logit[:, after], share)
