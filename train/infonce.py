"""Training of the embedding whose products are log likelihood ratios, by InfoNCE: of many points of one map, which is a
neighbour of this one?

The embedding knows the maps that it was trained on better than others. A network that was trained on its likeness for
the same maps would trust it too much on new ones. So each map's likeness in training comes from an embedding that did
not see the map (cross-fitting); the one that is exported saw all.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from l2p.attacks.attack import attributes_of
from l2p.attacks.learned.embedding import Embedding
from l2p.attacks.learned.network import NetworkConfig
from l2p.attacks.learned.teaching import contrast, descended
from l2p.errors import InputError
from l2p.geometry.points import nearest_neighbors
from l2p.io.atomic import atomic_file
from l2p.maps.appearance import ATTRIBUTES
from l2p.maps.scene import Scene
from l2p.work.progress import NO_PROGRESS, Progress

#: Nearest points that count as neighbours.
NEIGHBORS = 25
#: Standard deviation of the noise on unit descriptors and on colours in [0, 1].
_DESCRIPTOR_NOISE, _COLOUR_NOISE = 0.01, 0.02
#: Chance that a batch has single observations in place of means over the track.
_OBSERVED = 0.5
#: Chances that a batch has colours alone, or descriptors alone, if the map has both.
_COLOURS_ALONE, _DESCRIPTORS_ALONE = 0.1, 0.2
#: Chance that a batch is seen in a mirror.
_MIRRORED = 0.5
#: Rows and columns of cells of a SIFT descriptor, and directions of the histogram of each.
_CELLS, _DIRECTIONS = 4, 8
#: Weight of a map with descriptors, which are rarer and tell more than colours.
_DESCRIBED = 16
#: Largest variance of an observation about its mean, of squared length 1.
_MOST_VARIANCE = 0.5
#: Share of the steps in which the learning rate rises.
_WARM = 0.05


@dataclass(frozen=True)
class EmbeddingSettings:
    """Settings of the training of the embedding.

    Attributes
    ----------
    steps, batch : int
        Steps, and points of one map in each.
    learning_rate, weight_decay : float
        Of AdamW.
    folds : int
        Embeddings for cross-fitting.
    """

    steps: int = 24000
    batch: int = 512
    learning_rate: float = 2e-3
    weight_decay: float = 0.3
    folds: int = 4

    def __post_init__(self) -> None:
        for name, least in (("steps", 0), ("batch", 2), ("folds", 0)):
            if getattr(self, name) < least:
                raise InputError(f"got embedding.{name} {getattr(self, name)}; expected at least {least}")


@dataclass(frozen=True, eq=False)
class Described:
    """A map with colours, descriptors or both: its attributes, the neighbours of each point, and whether its
    descriptors are SIFT, whose mirror image is known."""

    attributes: Mapping[str, Float[Tensor, "points width"]]
    variance: Float[Tensor, " points"]
    near: Int[Tensor, "points k"]
    sift: bool = False

    @classmethod
    def of(cls, scene: Scene, config: NetworkConfig) -> Described | None:
        """Describe a scene; None if it has neither colours nor descriptors of the network's kind."""
        appearance = scene.appearance
        if appearance.descriptor_kind not in (None, config.kind):
            appearance = appearance.without(["descriptor"])
        if not appearance.names:
            return None
        near = nearest_neighbors(scene.xyz, NEIGHBORS, workers=torch.get_num_threads()).index
        sift = appearance.descriptor_kind == "sift" and config.length == _CELLS**2 * _DIRECTIONS
        return cls(attributes_of(appearance, torch.device("cpu")), variance_of(scene), torch.as_tensor(near), sift)


def variance_of(scene: Scene) -> Float[Tensor, " points"]:
    """Variance of single descriptors about the mean over the track, relative to their squared length.

    A mean over n unit vectors with variance v has the squared length 1 - v (1 - 1 / n).
    """
    if scene.descriptor is None or scene.track_length is None:
        return torch.zeros(len(scene))
    length = np.linalg.norm(scene.descriptor.astype(np.float64), axis=1)
    # The mean of equal descriptors is as long as a single one.
    single = max(float(length.max()), 1e-12)
    many = np.maximum(scene.track_length, 2)
    variance = (1 - (length / single) ** 2) / (1 - 1 / many)
    return torch.as_tensor(variance.clip(0, _MOST_VARIANCE), dtype=torch.float32)


def observed(
    descriptor: Float[Tensor, "rows length"], variance: Float[Tensor, " rows"], draw: torch.Generator
) -> Float[Tensor, "rows length"]:
    """Draw one observation of each point from the mean: the bins of a histogram vary in proportion to their root."""
    mean = functional.normalize(descriptor, dim=1)
    noise = (mean.abs() + 1 / mean.shape[1]).sqrt()
    noise = noise / noise.norm(dim=1, keepdim=True) * variance.sqrt()[:, None]
    noisy = mean + noise * torch.randn(mean.shape, generator=draw)
    # The bins of a histogram are not negative.
    return functional.normalize(noisy.clamp_min(0) if bool((descriptor >= 0).all()) else noisy, dim=1)


def mirrored(descriptor: Float[Tensor, "rows 128"]) -> Float[Tensor, "rows 128"]:
    """SIFT descriptors (Lowe, IJCV 60, 2004) of the same points in a mirror.

    The patch is turned so that its main direction is the first one. A mirror that keeps this direction reverses the
    rows of cells and the sense in which directions are counted. That COLMAP stores them in this order is seen in the
    mean of many, which a mirror hardly changes (a test).
    """
    cells = descriptor.reshape(-1, _CELLS, _CELLS, _DIRECTIONS)
    return cells.flip(1)[..., -torch.arange(_DIRECTIONS) % _DIRECTIONS].reshape(descriptor.shape)


class Embeddings:
    """Embeddings of a run: that of all maps, and one for each fold that saw all other maps."""

    def __init__(self, whole: Embedding, folds: Sequence[Embedding]) -> None:
        self.whole, self.folds = whole, list(folds)

    def blind_to(self, scene: str) -> Embedding:
        """Return the embedding that did not see the place of this name."""
        return self.folds[fold_of(scene, len(self.folds))] if self.folds else self.whole


def fold_of(scene: str, folds: int) -> int:
    """Fold of a place, by the name of its file or folder."""
    return zlib.crc32(Path(scene).stem.encode()) % folds


def fitted(
    scenes: Mapping[str, Scene],
    config: NetworkConfig,
    settings: EmbeddingSettings,
    seed: int,
    progress: Progress = NO_PROGRESS,
) -> Embeddings:
    """Train the embeddings on scenes by name."""
    described = {name: Described.of(scene, config) for name, scene in sorted(scenes.items())}
    known = {name: one for name, one in described.items() if one is not None}
    tasks: list[list[Described]] = [list(known.values())]
    for fold in range(settings.folds):
        tasks.append([one for name, one in known.items() if fold_of(name, settings.folds) != fold])
    found = []
    with progress.task("embeddings", total=len(tasks) * settings.steps) as advance:
        for number, maps in enumerate(tasks):
            found.append(_trained(maps, config, settings, [seed, number], advance))
    return Embeddings(found[0], found[1:])


def _trained(
    maps: Sequence[Described], config: NetworkConfig, settings: EmbeddingSettings, seed: Sequence[int], advance
) -> Embedding:
    rng = np.random.default_rng([*seed, 4])
    draw = torch.Generator().manual_seed(int(rng.integers(1 << 31)))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(1 << 31)))
        embedding = Embedding(config.length, config.hidden, config.embedding)
    weight = np.array([len(one.near) ** 0.5 * (_DESCRIBED if "descriptor" in one.attributes else 1) for one in maps])

    def step() -> Tensor:
        return lesson(embedding, maps[rng.choice(len(maps), p=weight / weight.sum())], settings.batch, rng, draw)

    steps = settings.steps if len(maps) else 0
    return descended(embedding, step, steps, settings.learning_rate, settings.weight_decay, _WARM, advance)


def lesson(
    embedding: Embedding, one: Described, batch: int, rng: np.random.Generator, draw: torch.Generator
) -> Float[Tensor, ""]:
    """InfoNCE of points and one neighbour each, with some of the map's attributes."""
    count, near = one.near.shape
    first = torch.randint(count, (min(batch, count),), generator=draw)
    second = one.near[first, torch.randint(near, (len(first),), generator=draw)]
    names = chosen(tuple(one.attributes), rng)
    single, mirror = rng.random() < _OBSERVED, one.sift and rng.random() < _MIRRORED
    here, there = (embedding(_noisy(one, rows, names, single, mirror, draw)) for rows in (first, second))
    return contrast(here, there)


def chosen(names: Sequence[str], rng: np.random.Generator) -> tuple[str, ...]:
    """Draw the attributes of a batch: all, or one of two."""
    if len(names) < len(ATTRIBUTES):
        return tuple(names)
    place = rng.random()
    if place < _COLOURS_ALONE:
        return ("rgb",)
    return ("descriptor",) if place < _COLOURS_ALONE + _DESCRIPTORS_ALONE else tuple(names)


def _noisy(
    one: Described,
    rows: Int[Tensor, " rows"],
    names: Sequence[str],
    single: bool,
    mirror: bool,
    draw: torch.Generator,
) -> dict[str, Float[Tensor, "rows width"]]:
    found = {}
    for name in names:
        value = one.attributes[name][rows]
        if name == "descriptor":
            value = observed(value, one.variance[rows], draw) if single else functional.normalize(value, dim=1)
            value = mirrored(value) if mirror else value
        noise = _DESCRIPTOR_NOISE if name == "descriptor" else _COLOUR_NOISE
        found[name] = value + noise * torch.randn(value.shape, generator=draw)
    return found


def save(embeddings: Embeddings, path: Path) -> None:
    """Save them for a run that is continued, and for the other processes."""
    parts = [embeddings.whole, *embeddings.folds]
    with atomic_file(path, overwrite=True) as file:
        torch.save([part.state_dict() for part in parts], file)


def load(path: Path, config: NetworkConfig) -> Embeddings:
    """Load what :func:`save` wrote."""
    found = []
    for state in torch.load(path, map_location="cpu", weights_only=True):
        embedding = Embedding(config.length, config.hidden, config.embedding)
        embedding.load_state_dict(state)
        found.append(embedding.requires_grad_(False).eval())
    return Embeddings(found[0], found[1:])
