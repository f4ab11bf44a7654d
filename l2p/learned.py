"""The learned attack: tomography first, then rounds of candidates, affinities and weighted peaks.

Each round looks at the lines' candidates around the estimates of the round before, lets the network judge them
(:mod:`l2p.network`), and takes the peak of their votes, each with its weight. All rounds share one network: it was
trained on the estimates of all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.errors import InputError
from l2p.features import STATE, Nodes, edges, surroundings
from l2p.frame import Frame
from l2p.geometry import Lines
from l2p.neighborhoods import Estimate, in_own_order
from l2p.network import NO_VOTE, NOTHING, RADII, Judgement, LineTransformer
from l2p.peak import PeakConfig, find_peak
from l2p.progress import NO_PROGRESS, Progress
from l2p.search import nearest_points_to_lines, nearest_points_to_points
from l2p.threads import over_blocks
from l2p.tomography import LINE_BYTES as TOMOGRAPHY_BYTES
from l2p.tomography import Posterior, TomographyConfig, mass_within, modes, reconstruct

#: Of the radii, the one that the lines around are told the confidence of.
_TOLD = RADII.index(1.0)
#: Neighbour whose median distance is the spacing (:func:`l2p.metrics.spacing`).
_SPACING = 50


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
    weight : str
        What weighs the votes: ``vote``, the network's word on each of them; ``affinity``, the square of the candidate's
        affinity, the same for all of its votes.
    """

    rounds: int = 4
    candidates: int = 64
    batch: int = 64
    peak: PeakConfig = PeakConfig(threshold=0.5, trim=0)
    weight: str = "vote"

    def __post_init__(self) -> None:
        for name, least in (("rounds", 0), ("candidates", 1), ("batch", 1)):
            value = getattr(self, name)
            if value < least:
                raise InputError(f"got {name} {value} of the learned attack; expected at least {least}")
        if self.weight not in ("vote", "affinity"):
            raise InputError(f"got weight {self.weight!r} of the learned attack; expected 'vote' or 'affinity'")


class Round(NamedTuple):
    """What a round finds: the nodes of the next one, each line's candidates with their affinities, and how sure it is
    of each estimate (logits, see :class:`l2p.network.Judgement`)."""

    nodes: Nodes
    candidates: Int[Tensor, "lines k"]
    affinity: Float[Tensor, "lines k"]
    sure: Float[Tensor, "lines radii"]


def first_nodes(lines: Lines, posterior: Posterior) -> Nodes:
    """What is known before the first round: the modes of the posterior."""
    beta, _ = modes(posterior)
    state = beta.new_zeros(len(beta), STATE)
    nodes = surroundings(lines, beta, torch.ones_like(beta), state)
    return surroundings(lines, beta, mass_within(posterior, beta, nodes.scale), state)


def find_candidates(
    lines: Lines, nodes: Nodes, config: LearnedConfig, progress: Progress = NO_PROGRESS
) -> Int[Tensor, "lines k"]:
    """The candidates of each line, -1 for none."""
    near = nearest_points_to_lines(lines, nodes.point, config.candidates, scale=nodes.scale.sqrt(), progress=progress)
    return near.index


def judge_round(
    lines: Lines,
    nodes: Nodes,
    posterior: Posterior,
    network: LineTransformer,
    config: LearnedConfig,
    progress: Progress = NO_PROGRESS,
) -> Round:
    """Run one round on all lines; the network in evaluation mode."""
    candidates = find_candidates(lines, nodes, config, progress)
    count = len(candidates)
    beta, state = nodes.beta.clone(), torch.zeros_like(nodes.state)
    affinity = torch.zeros_like(candidates, dtype=beta.dtype)
    sure = beta.new_full((count, len(RADII)), NOTHING)
    row_bytes = judging_bytes(network, candidates.shape[1])

    def judged(block: slice) -> tuple[Judgement, Tensor]:
        rows = torch.arange(block.start, block.stop, device=candidates.device)
        judgement = network(edges(lines, nodes, posterior, rows, candidates[rows]))
        return judgement, weighted_peak(judgement, config)

    with progress.task("affinities", total=count) as advance:
        if candidates.shape[1]:
            for block, (judgement, moved) in over_blocks(judged, count, config.batch, candidates.device, row_bytes):
                beta[block] += moved
                state[block], sure[block] = judgement.state, judgement.sure
                affinity[block] = torch.sigmoid(judgement.affinity)
                advance(block.stop - block.start)
    return Round(surroundings(lines, beta, told(sure), state), candidates, affinity, sure)


def judging_bytes(network: LineTransformer, k: int) -> float:
    """Temporaries of a line with k candidates: kernels of all pairs of them for each head, and their tokens."""
    width, heads = network.config.width, network.config.heads
    return 4 * k * (k * (heads + 4) + 12 * width + 300)


def told(sure: Float[Tensor, "lines radii"]) -> Float[Tensor, " lines"]:
    """The confidence that the lines around are told in the next round, as the network gives it."""
    return torch.sigmoid(sure[:, _TOLD])


def weighted_peak(judgement: Judgement, config: LearnedConfig) -> Float[Tensor, " lines"]:
    """The peak of the votes, weighted by the network, counted from the estimate before; 0 where there is no vote."""
    if config.weight == "vote":
        weight = torch.softmax(judgement.vote.flatten(1), dim=1)
    else:
        weight = torch.sigmoid(judgement.affinity).square()[..., None]
        weight = (weight * (judgement.vote > NO_VOTE)).flatten(1)
    return find_peak(judgement.place.flatten(1), weight, config.peak).beta.nan_to_num(nan=0.0)


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
        return in_own_order(lines, lambda lines: self._judged(lines, progress))

    def _judged(self, lines: Lines, progress: Progress) -> Estimate:
        network = self.network.to(lines.direction.device)
        posterior = reconstruct(lines, TomographyConfig(), progress)
        nodes = first_nodes(lines, posterior)
        if not self.config.rounds:
            candidates = find_candidates(lines, nodes, self.config, progress)
            return Estimate(nodes.beta, nodes.confidence, candidates, (candidates >= 0).to(nodes.beta.dtype))
        found = None
        for _ in range(self.config.rounds):
            found = judge_round(lines, nodes, posterior, network, self.config, progress)
            nodes = found.nodes
        assert found is not None
        return Estimate(nodes.beta, self.confidence(found), found.candidates, found.affinity)

    def confidence(self, found: Round) -> Float[Tensor, " lines"]:
        """Calibrated probability that each point of the last round lies within 1 spacing of the map."""
        calibration = found.sure.new_tensor(self.calibration[self.config.rounds - 1])
        logit = (calibration[:, 0] * found.sure + calibration[:, 1]).cummax(dim=1).values
        return torch.sigmoid(_between(logit, math.log(spacing_ratio(found.nodes.point, self.density))))

    @property
    def line_bytes(self) -> float:
        """What is held of each line (``benchmarks/memory.py``)."""
        return max(TOMOGRAPHY_BYTES, 4000 + 40 * self.config.candidates)

    def settings(self) -> dict[str, Any]:
        """Rounds, candidates, size of the network, density."""
        return {**asdict(self.config), "network": asdict(self.network.config), "density": self.density}


def spacing_ratio(points: Float[Tensor, "lines 3"], density: float) -> float:
    """Spacing of a map over that of the share ``density`` of its points.

    The 50th neighbour in the map is about neighbour 50 x density in the share.
    """
    k = max(1, round(_SPACING * density))
    if k >= min(_SPACING, len(points) - 1):
        return 1.0
    near = nearest_points_to_points(points, _SPACING).distance
    own, full = float(near[:, -1].median()), float(near[:, k - 1].median())
    return min(1.0, max(full / own, 1e-3)) if own > 0 else 1.0


def _between(logit: Float[Tensor, "lines radii"], log_radius: float) -> Float[Tensor, " lines"]:
    """The logit at a radius between those that the network knows, in line over the logarithm of the radius.

    Below the smallest the line goes on: with the radius the probability falls to 0.
    """
    known = [math.log(radius) for radius in RADII]
    after = min(max(sum(radius <= log_radius for radius in known), 1), len(known) - 1)
    share = (log_radius - known[after - 1]) / (known[after] - known[after - 1])
    return torch.lerp(logit[:, after - 1], logit[:, after], share)
