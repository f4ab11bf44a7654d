"""Line clouds for training: lifted from scenes, with their tomography."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.attack import Elements, attributes_of
from l2p.attacks.learned.embedding import Embedding
from l2p.attacks.learned.learned import Learned, State
from l2p.attacks.learned.nodes import Nodes
from l2p.attacks.structured import expanded, frame_of, structure_of
from l2p.attacks.tomography.posterior import Posterior
from l2p.attacks.tomography.reconstruct import reconstruct
from l2p.geometry.points import nearest_neighbors
from l2p.judging.accuracy import spacing
from l2p.maps.appearance import UNKNOWN_KIND
from l2p.maps.scene import Scene
from l2p.maps.truth import Hiding
from l2p.programs.scenes import scene_at
from l2p.schemes.hide import hide
from l2p.schemes.recognition import recognise
from l2p.schemes.scheme import DEFAULT_SCHEME
from train.infonce import Embeddings, observed, variance_of
from train.losses import Sample, soft_labels

#: Number of true neighbours whose distance is the local radius.
TRUE_NEIGHBORS = 25


@dataclass(frozen=True)
class CloudSource:
    """One line cloud of a scene: ``scene`` is a file or ``sim:kind:points:seed``.

    ``known`` names the attributes that are published with the lines; ``observed`` replaces means over tracks by single
    observations of the descriptors, ``unknown`` hides their kind; ``scheme`` draws the lines.
    """

    scene: str
    fraction: float
    seed: int
    known: tuple[str, ...] = ()
    observed: bool = False
    unknown: bool = False
    scheme: str = DEFAULT_SCHEME

    @property
    def name(self) -> str:
        """Name of the scene, for tables."""
        return Path(self.scene).stem


@dataclass(frozen=True, eq=False)
class Cloud:
    """A line cloud in its working frame, its tomography and its truth.

    ``spacing`` is that of the lifted points, ``radius`` the distance of each true point to its 25th true neighbour
    among them; both are in the frame's unit. If lines pass through pairs of points, each has two elements.
    """

    elements: Elements
    posterior: Posterior
    first_nodes: Nodes
    embedding: Embedding | None
    true_beta: Float[Tensor, " lines"]
    radius: Float[Tensor, " lines"]
    spacing: float

    def true_near(self, beta: Float[Tensor, " lines"]) -> Float[Tensor, " lines"]:
        """True positions; of pairs whose appearances do not tell which point is which, in the order that fits better
        to the estimates ``beta``."""
        twin = self.elements.structure.twin
        if twin is None or "appearance" in self.elements.attributes:
            return self.true_beta
        other = self.true_beta[twin]
        gain = (beta - self.true_beta).abs() - (beta - other).abs()
        return torch.where(gain + gain[twin] > 0, other, self.true_beta)

    def state(self, nodes: Nodes | None = None) -> State:
        """Return the state of an attack with these nodes; default: those before the first round."""
        return State(self.elements, self.posterior, self.first_nodes if nodes is None else nodes, self.embedding)

    def sample(
        self, attack: Learned, state: State, candidates: Int[Tensor, "lines k"], rows: Int[Tensor, " rows"]
    ) -> Sample:
        """Compute features, votes and truth of some lines."""
        chosen, true = candidates[rows], self.true_near(state.nodes.beta)
        truth = self.elements.lines.at(true)
        distance = (truth[chosen.clamp_min(0).long()] - truth[rows][:, None]).norm(dim=2)
        return Sample(
            edges=attack.edges(state, rows, chosen),
            label=soft_labels(distance, self._radius_at(true)[rows]),
            true_beta=true[rows] - state.nodes.beta[rows],
            spacing=torch.full((len(rows),), self.spacing),
        )

    def _radius_at(self, true: Float[Tensor, " lines"]) -> Float[Tensor, " lines"]:
        twin = self.elements.structure.twin
        return self.radius if twin is None else torch.where(true == self.true_beta, self.radius, self.radius[twin])


def lifted(
    source: CloudSource, attack: Learned, embeddings: Embeddings | None = None, device: torch.device | str = "cpu"
) -> Cloud:
    """Lift the cloud of a source, reproducibly, and run the attack's tomography.

    The likeness is that of the embedding that did not see the scene; without ``embeddings``, that of the attack's own.
    """
    scene = read(source.scene)
    descriptor = _descriptors(scene, source)
    hidden = hide(
        scene,
        source.seed,
        source.fraction,
        source.scheme,
        rgb="rgb" in source.known,
        descriptor=descriptor,
        descriptor_kind=None if descriptor is None else UNKNOWN_KIND if source.unknown else scene.descriptor_kind,
    )
    recognition = recognise(hidden.map)
    frame = frame_of(hidden.map, source.scheme, recognition)
    lines, row = expanded(hidden.map, source.scheme)
    truth, structure = _behind(hidden, row), structure_of(lines, source.scheme, recognition, frame, device)
    inside = frame.enter(lines, device)
    near = nearest_neighbors(truth, TRUE_NEIGHBORS, workers=torch.get_num_threads()).distance[:, -1]
    point = frame.enter_points(truth, device)
    posterior = reconstruct(inside, attack.config.tomography, structure=structure)
    published = attributes_of(lines.appearance, torch.device(device))
    order = torch.arange(len(lines), device=device)
    elements = Elements(inside, order, frame, published, lines.descriptor_kind, structure)
    elements, embedding = attack.seen(elements, None if embeddings is None else embeddings.blind_to(source.scene))
    return Cloud(
        elements=elements,
        embedding=embedding,
        posterior=posterior,
        first_nodes=attack.first_nodes(elements, posterior),
        true_beta=((point - inside.foot) * inside.direction).sum(dim=1),
        radius=torch.as_tensor(near / frame.unit, dtype=torch.float32, device=device),
        spacing=spacing(truth) / frame.unit,
    )


def _behind(hidden: Hiding, row: Int[np.ndarray, " elements"]) -> Float[np.ndarray, "elements 3"]:
    """True point of each element, of those of one line in the order of their appearances."""
    order = np.argsort(hidden.truth.element, kind="stable")
    if not np.array_equal(hidden.truth.element[order], row):
        raise ValueError(f"scheme {hidden.map.scheme} hides another number of points behind its lines")
    return hidden.truth.xyz[order]


def _descriptors(scene: Scene, source: CloudSource) -> np.ndarray | None:
    if "descriptor" not in source.known or scene.descriptor is None:
        return None
    if not source.observed:
        return scene.descriptor
    draw = torch.Generator().manual_seed(source.seed)
    return observed(torch.as_tensor(scene.descriptor.astype(np.float32)), variance_of(scene), draw).numpy()


@lru_cache(maxsize=256)
def read(scene: str) -> Scene:
    """Read or simulate a scene; the last results are cached."""
    return scene_at(scene)
