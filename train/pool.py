"""The pool of clouds in training, each in some round of the attack.

A step takes some lines of each cloud; the network's outputs for them are trained on and saved. After one pass over a
cloud, its saved outputs become the inputs of the next round; after the last round a new cloud replaces it. So every
round is trained on real estimates of the network, at no extra cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.learned.edges import Edges
from l2p.attacks.learned.learned import Learned, State
from l2p.attacks.learned.network import Judgement
from l2p.attacks.learned.nodes import Estimates, Nodes, nodes_of
from train.clouds import Cloud, CloudSource, lifted
from train.infonce import Embeddings
from train.losses import Sample
from train.sources import Sources


@dataclass
class Entry:
    """A cloud in a round: its state before the round, and the outputs saved so far.

    ``order`` is the order in which its lines are drawn, ``turn`` the number drawn so far.
    """

    source: CloudSource
    cloud: Cloud
    number: int
    round: int
    state: State
    candidates: Int[Tensor, "lines k"]
    order: Int[Tensor, " lines"]
    turn: int
    beta: Float[Tensor, " lines"]
    found: Float[Tensor, "lines radii"]
    passed: Float[Tensor, "lines state"]

    @property
    def nodes(self) -> Nodes:
        """Nodes before the round."""
        return self.state.nodes


class Pool:
    """The clouds from which a batch is mixed.

    Parameters
    ----------
    sources : Sources
    attack : Learned
    clouds : int
    seed : int
    rank, ranks : int
        Rank of this process, and number of ranks; each takes its own sources.
    embeddings : Embeddings, optional
        For cross-fitted likeness (:mod:`train.infonce`).
    """

    def __init__(
        self,
        sources: Sources,
        attack: Learned,
        clouds: int,
        seed: int,
        rank: int = 0,
        ranks: int = 1,
        embeddings: Embeddings | None = None,
    ) -> None:
        self.embeddings = embeddings
        self.sources, self.attack, self.seed, self.rank, self.ranks = sources, attack, seed, rank, ranks
        self.drawn = 0
        self.entries = [self._fresh() for _ in range(clouds)]

    def draw(self, lines: int) -> tuple[Sample, list[Int[Tensor, " rows"]]]:
        """Draw the next lines of every cloud as one batch; return it with their rows in each cloud."""
        rows = [entry.order[entry.turn : entry.turn + lines] for entry in self.entries]
        samples = [
            entry.cloud.sample(self.attack, entry.state, entry.candidates, rows)
            for entry, rows in zip(self.entries, rows, strict=True)
        ]
        return _joined(samples), rows

    @torch.no_grad()
    def keep(self, rows: Sequence[Int[Tensor, " rows"]], moved: Float[Tensor, " batch"], judgement: Judgement) -> None:
        """Save the network's outputs for the drawn lines; ``moved`` is relative to the last estimate."""
        sizes = [len(part) for part in rows]
        for place, (part, beta, found, state) in enumerate(
            zip(rows, moved.split(sizes), judgement.found.split(sizes), judgement.state.split(sizes), strict=True)
        ):
            entry = self.entries[place]
            entry.beta[part] = entry.nodes.beta[part] + beta
            entry.found[part], entry.passed[part] = found, state
            entry.turn += len(part)
            if entry.turn == len(entry.order):
                self.entries[place] = self._after(entry)

    def state_dict(self) -> dict[str, Any]:
        """Return the state that cannot be recomputed."""
        return {
            "drawn": self.drawn,
            "entries": [
                {
                    "number": entry.number,
                    "round": entry.round,
                    "turn": entry.turn,
                    "before": [entry.nodes.beta, entry.nodes.confidence, entry.nodes.state],
                    "found": [entry.beta, entry.found, entry.passed],
                }
                for entry in self.entries
            ],
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Continue from a ``state_dict``."""
        self.drawn = saved["drawn"]
        self.entries = []
        for part in saved["entries"]:
            source = self.sources[part["number"]]
            cloud = lifted(source, self.attack, self.embeddings)
            state = cloud.state()
            if part["round"]:
                before = Estimates(*part["before"])
                nodes = nodes_of(cloud.elements.lines, before, self.attack.config.nodes)
                state = self.attack.schooled(state._replace(nodes=nodes))
            entry = self._entry(source, cloud, part["number"], part["round"], state)
            entry.turn = part["turn"]
            entry.beta, entry.found, entry.passed = (value.clone() for value in part["found"])
            self.entries.append(entry)

    def _fresh(self) -> Entry:
        number = self.drawn * self.ranks + self.rank
        self.drawn += 1
        source = self.sources[number]
        cloud = lifted(source, self.attack, self.embeddings)
        return self._entry(source, cloud, number, 0, cloud.state())

    def _after(self, entry: Entry) -> Entry:
        if entry.round >= self.attack.rounds_of(entry.cloud.elements):
            return self._fresh()
        estimates = Estimates(entry.beta, self.attack.passed_confidence(entry.found), entry.passed)
        state = self.attack.moved(entry.state, estimates)
        return self._entry(entry.source, entry.cloud, entry.number, entry.round + 1, state)

    def _entry(self, source: CloudSource, cloud: Cloud, number: int, round: int, state: State) -> Entry:
        nodes = state.nodes
        order = np.random.default_rng([self.seed, 3, number, round]).permutation(len(nodes.beta))
        return Entry(
            source=source,
            cloud=cloud,
            number=number,
            round=round,
            state=state,
            candidates=self.attack.candidates(state),
            order=torch.as_tensor(order),
            turn=0,
            beta=nodes.beta.clone(),
            found=nodes.beta.new_zeros(len(nodes.beta), len(self.attack.network.config.radii)),
            passed=torch.zeros_like(nodes.state),
        )


def _joined(samples: Sequence[Sample]) -> Sample:
    """Join samples to one batch; small clouds have fewer candidates and are padded."""
    k = max(sample.label.shape[1] for sample in samples)
    columns = zip(*(sample.edges for sample in samples), strict=True)
    return Sample(
        edges=Edges(*(torch.cat([_padded(value, k) for value in values]) for values in columns)),
        label=torch.cat([_padded(sample.label, k) for sample in samples]),
        true_beta=torch.cat([sample.true_beta for sample in samples]),
        spacing=torch.cat([sample.spacing for sample in samples]),
    )


def _padded(value: Float[Tensor, "lines k *rest"], k: int) -> Float[Tensor, "lines padded *rest"]:
    missing = k - value.shape[1]
    return torch.nn.functional.pad(value, (*(0,) * (2 * (value.dim() - 2)), 0, missing)) if missing else value
