"""The scenes of a run: files, folders of files, and simulated ones, each with its kind."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from zipfile import is_zipfile

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError
from l2p.io.colmap_folders import is_model
from l2p.io.descriptors import BESIDE, with_descriptors
from l2p.io.kinds import SCENES, kind_of
from l2p.io.scene_files import load_scene
from l2p.judging.accuracy import spacing
from l2p.maps.appearance import Appearance
from l2p.maps.scene import Scene
from l2p.maps.short_repr import short_repr
from l2p.simulator import KINDS as SIMULATED
from l2p.simulator import MAX_POINTS, MIN_POINTS, simulate

#: Kind in the paper's table of neighbours, by kind of scene; objects, mapped from near, count as indoor.
PAPER_KIND = {"indoor": "indoor", "outdoor": "outdoor", "object": "indoor"}
#: Kind of scene, by the first word of a kind in SOURCES.md or by the kind of a simulated scene.
KINDS = {
    **{kind: kind for kind in PAPER_KIND},
    **dict.fromkeys(("aerial", "street", "facade", "terrain"), "outdoor"),
    **dict.fromkeys(("room", "hall"), "indoor"),
}
#: Kind of a scene that is not in SOURCES.md; also the default of ``l2p recover``.
UNDESCRIBED = "indoor"
SOURCES = "SOURCES.md"


@dataclass(frozen=True)
class SceneSource:
    """Name, source (a path or ``sim:KIND:POINTS:SEED``) and kind of a scene."""

    name: str
    source: str
    kind: str


@dataclass(frozen=True, eq=False)
class Loaded:
    """The points of a scene, their spacing (scene units) and a digest of their bytes.

    Attributes
    ----------
    appearance : Appearance
        Colours and descriptors of the points, those that the scene has.
    attributes : dict
        Digest of the bytes of each, by name.
    """

    xyz: Float[np.ndarray, "points 3"]
    spacing: float
    digest: str
    appearance: Appearance
    attributes: dict[str, str]

    __repr__ = short_repr


def scenes_of(entries: Sequence[str], kinds: dict[str, str]) -> tuple[SceneSource, ...]:
    """List the scenes of the entries; ``kinds``, by name of the scene, take precedence over SOURCES.md.

    Raises
    ------
    FileNotFoundError, InputError
        If an entry does not exist or has no scene, a kind is unknown, or two scenes have one name.
    """
    scenes: list[SceneSource] = []
    for entry in entries:
        scenes += [_simulated(entry)] if entry.startswith("sim:") else _from_files(Path(entry))
    names = [scene.name for scene in scenes]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"got {names.count(name)} scenes named {name}; rename one of the files")
    unknown = sorted(set(kinds) - set(names))
    if unknown:
        raise InputError(f"got a kind for {unknown[0]}, which is no scene of this run; expected one of {names}")
    return tuple(SceneSource(s.name, s.source, _kind(kinds.get(s.name, s.kind), s.name)) for s in scenes)


@lru_cache(maxsize=16)
def load(source: str) -> Loaded:
    """Read or simulate the points of a scene and their appearance; the last results are cached."""
    scene = scene_at(source)
    appearance = scene.appearance
    digests = {name: _digest(getattr(appearance, name)) for name in appearance.names}
    if appearance.descriptor is not None:
        digests["descriptor"] = f"{appearance.descriptor_kind} {digests['descriptor']}"
    return Loaded(scene.xyz, spacing(scene.xyz), _digest(scene.xyz), appearance, digests)


def _digest(values: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:16]


def scene_at(source: str) -> Scene:
    """Read or simulate a scene with all attributes of its points."""
    if not source.startswith("sim:"):
        scene, beside = load_scene(source), Path(source) / BESIDE
        return with_descriptors(scene, beside) if beside.is_file() else scene
    _, kind, points, seed = source.split(":")
    return simulate(kind, int(points), int(seed))


def _simulated(entry: str) -> SceneSource:
    parts = entry.split(":")
    if len(parts) != 4 or parts[1] not in SIMULATED or not (parts[2].isdecimal() and parts[3].isdecimal()):
        raise InputError(f"got scene {entry!r}; expected sim:KIND:POINTS:SEED with a kind of {', '.join(SIMULATED)}")
    if not MIN_POINTS <= int(parts[2]) <= MAX_POINTS:
        raise InputError(f"got scene {entry!r}; expected at least {MIN_POINTS} points, at most {MAX_POINTS}")
    return SceneSource("-".join(parts), entry, parts[1])


def _from_files(path: Path) -> list[SceneSource]:
    if not path.exists():
        raise FileNotFoundError(
            f"{path} does not exist; give scenes=[FOLDER] or simulated ones, scenes=[sim:room:3000:0]"
        )
    kinds = _described_kinds(path)
    files = [path] if _is_scene(path) else sorted(p for p in path.iterdir() if _is_scene(p)) if path.is_dir() else []
    if not files:
        raise InputError(f"{path} holds no scene; expected COLMAP models, PLY files or npz files with xyz")
    return [SceneSource(file.stem, str(file), kinds.get(file.stem, UNDESCRIBED)) for file in files]


def _is_scene(path: Path) -> bool:
    if path.is_dir():
        return is_model(path)
    try:
        return kind_of(path) in SCENES
    except InputError:
        # Accept truncated npz files: the reader reports the error.
        return path.suffix == ".npz" and path.is_file() and not is_zipfile(path)


def _described_kinds(path: Path) -> dict[str, str]:
    """Kinds from the Markdown table with columns ``scene`` and ``kind`` of a SOURCES.md in the folder or above it."""
    folder = path if path.is_dir() else path.parent
    table = next((p / SOURCES for p in (folder, folder.resolve().parent) if (p / SOURCES).is_file()), None)
    rows = table.read_text(encoding="utf-8").splitlines() if table else []
    cells = [[cell.strip() for cell in row.strip().strip("|").split("|")] for row in rows if row.startswith("|")]
    head = next((row for row in cells if "scene" in row and "kind" in row), None)
    if head is None:
        return {}
    scene, kind = head.index("scene"), head.index("kind")
    return {row[scene]: row[kind] for row in cells if len(row) == len(head)}


def _kind(text: str, scene: str) -> str:
    word = text.split()[0] if text.split() else ""
    if word not in KINDS:
        raise InputError(f"got kind {text!r} for scene {scene}; expected {', '.join(PAPER_KIND)}")
    return KINDS[word]
