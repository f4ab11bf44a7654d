"""Points to learn pictures from: those of a map, and those that the shipped attack recovers of its line clouds."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from l2p.attacks.learned.checkpoint import digest, shipped
from l2p.attacks.run import recover
from l2p.errors import InputError
from l2p.images.photographs import folder_beside, photograph
from l2p.images.views import View, view_of
from l2p.io.atomic import atomic_file
from l2p.io.colmap import read_model
from l2p.io.descriptors import load_described
from l2p.maps.scene import Scene
from l2p.schemes.hide import hide
from l2p.work.progress import Progress

#: What the attack knows: lines alone, or all that the map has.
KNOWN = ("lines", "all")


@dataclass(frozen=True, eq=False)
class PictureCloud:
    """Points to make pictures of.

    Attributes
    ----------
    xyz : (points, 3) float64
    index : (points,) int64
        Row of each in the scene, whose appearance it has.
    confidence : (points,) float32
        1 for true points.
    """

    xyz: Float[np.ndarray, "points 3"]
    index: Int[np.ndarray, " points"]
    confidence: Float[np.ndarray, " points"]


@dataclass(frozen=True, eq=False)
class PictureMap:
    """A map with photographs: its points, views, and recovered points."""

    path: Path
    scene: Scene
    recovered: Sequence[PictureCloud]

    @property
    def name(self) -> str:
        """Name of its folder."""
        return self.path.name

    @cached_property
    def true(self) -> PictureCloud:
        """The points of the map."""
        count = len(self.scene)
        return PictureCloud(self.scene.xyz, np.arange(count), np.ones(count, dtype=np.float32))

    @cached_property
    def views(self) -> list[tuple[View, UInt8[np.ndarray, "height width 3"]]]:
        """All views with their photographs, by name."""
        folder = folder_beside(self.path)
        if folder is None:
            raise InputError(f"{self.path} has no photographs; expected a folder images or thumbs beside the model")
        model = read_model(self.path)
        names = sorted(image.name for image in model.images.values() if image.has_pose)
        return [(view, photograph(folder, view)) for view in (view_of(model, name) for name in names)]


def picture_maps(
    paths: Sequence[str], fractions: Sequence[float], seed: int, folder: Path, progress: Progress
) -> list[PictureMap]:
    """Read maps, and recover their points at each share and by each knowledge; done once for a run, in ``folder``.

    Raises
    ------
    FileNotFoundError, InputError
        If a map, its descriptors or its photographs are missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    scenes = {Path(path): load_described(path, None)[0] for path in paths}
    jobs = [(path, fraction, known) for path in scenes for fraction in fractions for known in KNOWN]
    found: dict[Path, list[PictureCloud]] = {path: [] for path in scenes}
    with progress.task("recovered points", total=sum(round(len(scenes[path]) * part) for path, part, _ in jobs)) as add:
        for path, fraction, known in jobs:
            file = folder / f"{path.name}-{_identity(scenes[path])}-{fraction:g}-{known}-{seed}.npz"
            if not file.exists():
                _save(file, _recovered(scenes[path], fraction, known, seed))
            found[path].append(_load(file))
            add(round(len(scenes[path]) * fraction))
    return [PictureMap(path, scene, found[path]) for path, scene in scenes.items()]


def _identity(scene: Scene) -> str:
    """Digest of the points, and of the weights of the attack."""
    return f"{hashlib.sha256(scene.xyz.tobytes()).hexdigest()[:8]}-{digest(shipped())}"


def _recovered(scene: Scene, fraction: float, known: str, seed: int) -> PictureCloud:
    everything = known == "all"
    hidden = hide(scene, seed, fraction, rgb=everything and scene.rgb is not None, descriptor=everything)
    recovery = recover(hidden.map)
    return PictureCloud(recovery.xyz, hidden.truth.index, recovery.confidence)


def _save(file: Path, cloud: PictureCloud) -> None:
    with atomic_file(file, overwrite=True) as out:
        np.savez(out, xyz=cloud.xyz, index=cloud.index, confidence=cloud.confidence)


def _load(file: Path) -> PictureCloud:
    with np.load(file) as arrays:
        return PictureCloud(arrays["xyz"], arrays["index"], arrays["confidence"])
