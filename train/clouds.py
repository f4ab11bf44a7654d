"""Line clouds for training: lifted from scenes, with their tomography."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.attack import Elements, attributes_of
from l2p.attacks.learned.embedding import Embedding
from l2p.attacks.learned.learned import Learned, State
from l2p.attacks.learned.nodes import Nodes
from l2p.attacks.tomography.posterior import Posterior
from l2p.attacks.tomography.reconstruct import reconstruct
from l2p.geometry.frame import Frame
from l2p.geometry.points import nearest_neighbors
from l2p.judging.accuracy import spacing
from l2p.maps.appearance import UNKNOWN_KIND
from l2p.maps.scene import Scene
from l2p.programs.scenes import scene_at
from l2p.schemes.hide import hide
from train.infonce import Embeddings, observed, variance_of
from train.losses import Sample, soft_labels

#: Number of true neighbours whose distance is the local radius.
TRUE_NEIGHBORS = 25


@dataclass(frozen=True)
class CloudSource:
    """One line cloud of a scene: ``scene`` is a file or ``sim:kind:points:seed``.

    ``known`` names the attributes that are published with the lines; ``observed`` replaces means over tracks by single
    observations of the descriptors, ``unknown`` hides their kind.
    """

    scene: str
    fraction: float
    seed: int
    known: tuple[str, ...] = ()
    observed: bool = False
    unknown: bool = False

    @property
    def name(self) -> str:
        """Name of the scene, for tables."""
        return Path(self.scene).stem


@dataclass(frozen=True, eq=False)
class Cloud:
    """A line cloud in its working frame, its tomography and its truth.

    ``spacing`` is that of the lifted points, ``radius`` the distance of each true point to its 25th true neighbour
    among them; both are in the frame's unit.
    """

    elements: Elements
    posterior: Posterior
    first_nodes: Nodes
    embedding: Embedding | None
    true_beta: Float[Tensor, " lines"]
    radius: Float[Tensor, " lines"]
    spacing: float

    @cached_property
    def true_point(self) -> Float[Tensor, "lines 3"]:
        """True points, in the frame."""
        return self.elements.lines.at(self.true_beta)

    def state(self, nodes: Nodes | None = None) -> State:
        """Return the state of an attack with these nodes; default: those before the first round."""
        return State(self.elements, self.posterior, self.first_nodes if nodes is None else nodes, self.embedding)

    def sample(
        self, attack: Learned, state: State, candidates: Int[Tensor, "lines k"], rows: Int[Tensor, " rows"]
    ) -> Sample:
        """Compute features, votes and truth of some lines."""
        chosen, truth = candidates[rows], self.true_point
        distance = (truth[chosen.clamp_min(0).long()] - truth[rows][:, None]).norm(dim=2)
        return Sample(
            edges=attack.edges(state, rows, chosen),
            label=soft_labels(distance, self.radius[rows]),
            true_beta=self.true_beta[rows] - state.nodes.beta[rows],
            spacing=torch.full((len(rows),), self.spacing),
        )


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
        rgb="rgb" in source.known,
        descriptor=descriptor,
        descriptor_kind=None if descriptor is None else UNKNOWN_KIND if source.unknown else scene.descriptor_kind,
    )
    lines, truth = hidden.map, hidden.truth.xyz
    frame = Frame.of(lines)
    inside = frame.enter(lines, device)
    near = nearest_neighbors(truth, TRUE_NEIGHBORS, workers=torch.get_num_threads()).distance[:, -1]
    point = frame.enter_points(truth, device)
    posterior = reconstruct(inside, attack.config.tomography)
    published = attributes_of(lines.appearance, torch.device(device))
    elements = Elements(inside, torch.arange(len(lines), device=device), frame, published, lines.descriptor_kind)
    elements, embedding = attack.seen(elements, None if embeddings is None else embeddings.blind_to(source.scene))
    return Cloud(
        elements=elements,
        embedding=embedding,
        posterior=posterior,
        first_nodes=attack.first_nodes(inside, posterior),
        true_beta=((point - inside.foot) * inside.direction).sum(dim=1),
        radius=torch.as_tensor(near / frame.unit, dtype=torch.float32, device=device),
        spacing=spacing(truth) / frame.unit,
    )


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
