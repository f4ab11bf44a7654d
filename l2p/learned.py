"""The learned attack: tomography first, then rounds of candidates, affinities and weighted peaks.

Each round looks at the lines' candidates around the estimates of the round before, lets a network judge them
(:mod:`l2p.network`), and takes the peak of their votes, closest points and feet, each with its weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.features import STATE, Nodes, edges, surroundings
from l2p.frame import Frame
from l2p.geometry import Lines
from l2p.neighborhoods import Estimate
from l2p.network import Judgement, LineTransformer
from l2p.peak import PeakConfig, find_peak
from l2p.progress import NO_PROGRESS, Progress
from l2p.search import nearest_points_to_lines
from l2p.tomography import Posterior, TomographyConfig, mass_within, modes, reconstruct


@dataclass(frozen=True)
class RoundConfig:
    """How a round runs around its network.

    Attributes
    ----------
    candidates : int
        Candidates of each line: the estimates nearest to it, in units of the square root of their local scale, so
        that neither the dense nor the sparse places that it passes take all.
    batch : int
        Lines judged at a time; the answer does not depend on it.
    peak : PeakConfig
        The weighted votes are not trimmed: the weights have done it.
    """

    candidates: int = 96
    batch: int = 64
    peak: PeakConfig = PeakConfig(threshold=0.5, trim=0)


class Round(NamedTuple):
    """What a round finds: the nodes of the next one, and each line's candidates with their affinities."""

    nodes: Nodes
    candidates: Int[Tensor, "lines k"]
    affinity: Float[Tensor, "lines k"]


def first_nodes(lines: Lines, posterior: Posterior) -> Nodes:
    """What is known before the first round: the modes of the posterior."""
    beta, _ = modes(posterior)
    state = beta.new_zeros(len(beta), STATE)
    nodes = surroundings(lines, beta, torch.ones_like(beta), state)
    return surroundings(lines, beta, mass_within(posterior, beta, nodes.scale), state)


def find_candidates(
    lines: Lines, nodes: Nodes, config: RoundConfig, progress: Progress = NO_PROGRESS
) -> Int[Tensor, "lines k"]:
    """The candidates of each line, -1 for none."""
    near = nearest_points_to_lines(lines, nodes.point, config.candidates, scale=nodes.scale.sqrt(), progress=progress)
    return near.index


def judge_round(
    lines: Lines,
    nodes: Nodes,
    posterior: Posterior,
    network: LineTransformer,
    config: RoundConfig | None = None,
    progress: Progress = NO_PROGRESS,
) -> Round:
    """Run one round on all lines; the network in evaluation mode."""
    config = config or RoundConfig()
    candidates = find_candidates(lines, nodes, config, progress)
    count = len(candidates)
    beta, confidence = nodes.beta.clone(), nodes.confidence.clone()
    state, affinity = torch.zeros_like(nodes.state), torch.zeros_like(candidates, dtype=nodes.beta.dtype)
    with progress.task("affinities", total=count) as advance:
        for begin in range(0, count if candidates.shape[1] else 0, config.batch):
            rows = torch.arange(begin, min(begin + config.batch, count), device=candidates.device)
            near = edges(lines, nodes, posterior, rows, candidates[rows])
            judgement = network(near)
            beta[rows] = weighted_peak(near.closest, near.foot, judgement, config.peak, nodes.beta[rows])
            confidence[rows] = torch.sigmoid(judgement.sure)
            state[rows], affinity[rows] = judgement.state, torch.sigmoid(judgement.affinity)
            advance(len(rows))
    return Round(surroundings(lines, beta, confidence, state), candidates, affinity)


def weighted_peak(
    closest: Float[Tensor, "lines k"],
    foot: Float[Tensor, "lines k"],
    judgement: Judgement,
    config: PeakConfig,
    otherwise: Float[Tensor, " lines"],
) -> Float[Tensor, " lines"]:
    """The peak of both kinds of votes, weighted by the network; the estimate before where there is no vote."""
    votes = torch.stack([closest, foot], dim=2).flatten(1)
    weight = torch.softmax(judgement.vote.flatten(1), dim=1)
    found = find_peak(votes, weight, config).beta
    return torch.where(found.isnan(), otherwise, found)


class Learned:
    """The learned attack with one network a round.

    ``calibration`` has two numbers a round, a and b: the last round's turn its ``sure`` into the confidence
    sigmoid(a sure + b). Rounds see each other's confidence as the networks give it.
    """

    def __init__(
        self,
        networks: Sequence[LineTransformer],
        config: RoundConfig | None = None,
        calibration: Sequence[tuple[float, float]] | None = None,
    ) -> None:
        self.networks = [network.eval() for network in networks]
        self.config = config or RoundConfig()
        self.calibration = list(calibration or [(1.0, 0.0)] * len(self.networks))

    def locate(self, lines: Lines, frame: Frame, progress: Progress = NO_PROGRESS) -> Estimate:
        """Tomography, then a round for each network."""
        posterior = reconstruct(lines, TomographyConfig(), progress)
        nodes = first_nodes(lines, posterior)
        if not self.networks:
            candidates = find_candidates(lines, nodes, self.config, progress)
            return Estimate(nodes.beta, nodes.confidence, candidates, (candidates >= 0).to(nodes.beta.dtype))
        candidates, affinity = None, None
        for network in self.networks:
            nodes, candidates, affinity = judge_round(lines, nodes, posterior, network, self.config, progress)
        assert candidates is not None and affinity is not None
        return Estimate(nodes.beta, self._calibrated(nodes.confidence), candidates, affinity)

    def _calibrated(self, confidence: Float[Tensor, " lines"]) -> Float[Tensor, " lines"]:
        slope, offset = self.calibration[len(self.networks) - 1]
        return torch.sigmoid(slope * torch.logit(confidence, eps=1e-6) + offset)

    def settings(self) -> dict[str, Any]:
        """Rounds, their configuration and the networks' sizes."""
        return {
            "rounds": len(self.networks),
            **asdict(self.config),
            "networks": [asdict(network.config) for network in self.networks],
        }
