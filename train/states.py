"""What every cloud looks like before a round: the work of the rounds before it, kept on disk."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from safetensors.torch import load_file, save
from torch import Tensor

from l2p import features, learned, network, peak, search, tomography
from l2p.features import Nodes, edges
from l2p.io.atomic import atomic_file
from l2p.learned import RoundConfig, find_candidates, first_nodes, judge_round
from l2p.network import LineTransformer
from l2p.progress import terminal_progress
from train.clouds import Cloud, CloudSource, prepare
from train.losses import Sample, soft_labels

#: Modules whose code makes a state.
_MAKERS = (features, learned, network, peak, search, tomography)


@dataclass(frozen=True)
class State:
    """A cloud before a round: its nodes and its candidates."""

    cloud: Cloud
    nodes: Nodes
    candidates: Int[Tensor, "lines k"]

    def sample(self, rows: Int[Tensor, " rows"]) -> Sample:
        """Features, votes and truth of some lines."""
        candidates, truth = self.candidates[rows], self.cloud.true_point
        distance = (truth[candidates.clamp_min(0).long()] - truth[rows][:, None]).norm(dim=2)
        return Sample(
            edges=edges(self.cloud.lines, self.nodes, self.cloud.posterior, rows, candidates),
            label=soft_labels(distance, self.cloud.radius[rows]),
            true_beta=self.cloud.true_beta[rows],
            before=self.nodes.beta[rows],
            spacing=torch.tensor(self.cloud.spacing),
        )


class StateStore:
    """States of all rounds in a cache folder, by cloud, round configuration and the weights of the rounds before.

    A state that was made by other code is not taken; comments and docstrings may change.
    """

    def __init__(self, cache: Path, config: RoundConfig) -> None:
        self.cache = cache
        self.config = config

    def states(self, sources: Sequence[CloudSource], networks: Sequence[LineTransformer], title: str) -> list[State]:
        """The states of all clouds after the rounds of ``networks``."""
        found = []
        with terminal_progress().task(title, total=len(sources)) as advance:
            for source in sources:
                found.append(self.state(source, networks))
                advance(1)
        return found

    def state(self, source: CloudSource, networks: Sequence[LineTransformer]) -> State:
        """The state of one cloud after the rounds of ``networks``, from disk or computed from the state before."""
        cloud = prepare(source, self.cache / "clouds")
        file = self._file(source, networks)
        if not file.exists():
            self._write(file, self._computed(source, cloud, networks))
        part = load_file(file)
        candidates = part.pop("candidates")
        return State(cloud, Nodes(point=cloud.lines.at(part["beta"]), **part), candidates)

    @torch.no_grad()
    def _computed(self, source: CloudSource, cloud: Cloud, networks: Sequence[LineTransformer]) -> dict[str, Tensor]:
        if networks:
            before = self.state(source, networks[:-1]).nodes
            nodes = judge_round(cloud.lines, before, cloud.posterior, networks[-1].eval(), self.config).nodes
        else:
            nodes = first_nodes(cloud.lines, cloud.posterior)
        candidates = find_candidates(cloud.lines, nodes, self.config)
        parts = {name: value for name, value in nodes._asdict().items() if name != "point"}
        return {**parts, "candidates": candidates.int()}

    def _file(self, source: CloudSource, networks: Sequence[LineTransformer]) -> Path:
        digest = hashlib.sha256(f"{self.config}|{_code_digest()}".encode())
        for judge in networks:
            digest.update(str(judge.config).encode())
            for value in judge.state_dict().values():
                digest.update(np.ascontiguousarray(value.detach().cpu().numpy()).tobytes())
        return self.cache / "rounds" / f"{source.key}-{len(networks)}-{digest.hexdigest()[:12]}.safetensors"

    @staticmethod
    def _write(file: Path, parts: dict[str, Tensor]) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(file, overwrite=True) as out:
            out.write(save({name: value.contiguous() for name, value in parts.items()}))


@cache
def _code_digest() -> str:
    """A digest of the code that makes a state, without comments and docstrings."""
    digest = hashlib.sha256()
    for module in _MAKERS:
        tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
        for part in ast.walk(tree):
            if isinstance(part, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(part) is not None:
                part.body = part.body[1:] or [ast.Pass()]
        digest.update(ast.dump(tree).encode())
    return digest.hexdigest()
