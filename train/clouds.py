"""Line clouds to train on: lifted from scenes, with the tomography already done, kept on disk between runs."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file, save
from torch import Tensor

from l2p.frame import Frame
from l2p.geometry import Lines
from l2p.io.atomic import atomic_file
from l2p.lifting import lift_indexed
from l2p.point_neighbors import nearest_neighbors
from l2p.scene import Scene
from l2p.simulator import simulate
from l2p.tomography import Posterior, TomographyConfig, reconstruct

#: True neighbours of a point that set the local radius of a true neighbour.
TRUE_NEIGHBORS = 25


@dataclass(frozen=True)
class CloudSource:
    """One line cloud of a scene: ``scene`` is a file or ``sim:kind:points:seed``."""

    scene: str
    fraction: float
    seed: int

    @property
    def key(self) -> str:
        """Name of its file in the cache."""
        settings = f"{self.scene}|{self.fraction:.6g}|{self.seed}|{TomographyConfig()}"
        return f"{Path(self.scene).stem.replace(':', '-')}-{hashlib.sha256(settings.encode()).hexdigest()[:12]}"


@dataclass(frozen=True)
class Cloud:
    """A line cloud in its working frame, its tomography and its truth.

    ``spacing`` is that of the full scene in the frame's unit, ``radius`` the distance of each true point to its
    25th true neighbour among the lifted ones.
    """

    lines: Lines
    posterior: Posterior
    true_beta: Float[Tensor, " lines"]
    radius: Float[Tensor, " lines"]
    spacing: float

    @property
    def true_point(self) -> Float[Tensor, "lines 3"]:
        """True points in the frame."""
        return self.lines.at(self.true_beta)


def prepare(source: CloudSource, cache: Path) -> Cloud:
    """The cloud of a source, from the cache if it is there."""
    file = cache / f"{source.key}.safetensors"
    if not file.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with atomic_file(file, overwrite=True) as out:
            out.write(save(_lifted(source)))
    return _loaded(load_file(file))


def _lifted(source: CloudSource) -> dict[str, Tensor]:
    points = read(source.scene).xyz
    lines, index = lift_indexed(points, source.seed, source.fraction)
    frame = Frame.of(lines)
    inside = frame.enter(lines)
    posterior = reconstruct(inside)
    truth = points[index]
    near = nearest_neighbors(truth, TRUE_NEIGHBORS).distance[:, -1]
    point = frame.enter_points(truth)
    spacing = np.median(nearest_neighbors(points, 50).distance[:, -1])
    return {
        "direction": inside.direction,
        "moment": inside.moment,
        "posterior_beta": posterior.beta,
        "posterior_probability": posterior.probability.half(),
        "posterior_step": posterior.step,
        "true_beta": ((point - inside.foot) * inside.direction).sum(dim=1),
        "radius": torch.as_tensor(near / frame.unit, dtype=torch.float32),
        "spacing": torch.tensor(spacing / frame.unit, dtype=torch.float32),
    }


def _loaded(part: dict[str, Tensor]) -> Cloud:
    probability = part["posterior_probability"].float()
    posterior = Posterior(part["posterior_beta"], probability, torch.zeros_like(probability), part["posterior_step"])
    lines = Lines(part["direction"], part["moment"])
    return Cloud(lines, posterior, part["true_beta"], part["radius"], float(part["spacing"]))


def read(scene: str) -> Scene:
    """A scene file, or a simulated scene by its ``sim:kind:points:seed``."""
    if scene.startswith("sim:"):
        kind, points, seed = scene.split(":")[1:]
        return simulate(kind, int(points), int(seed))
    return Scene.load(scene)
