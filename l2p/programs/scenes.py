"""The scenes of a run: files, folders of files, and simulated ones, each with its kind."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from zipfile import is_zipfile

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError
from l2p.io.kinds import SCENES, kind_of
from l2p.io.scene_files import load_scene
from l2p.judging.accuracy import spacing
from l2p.maps.scene import Scene
from l2p.simulator import KINDS as SIMULATED
from l2p.simulator import MAX_POINTS, MIN_POINTS, simulate

#: What the paper's table of neighbours calls each kind of scene: it knows no objects, which are mapped from near.
PAPER_KIND = {"indoor": "indoor", "outdoor": "outdoor", "object": "indoor"}
#: The first word of a kind in SOURCES.md, or the kind of a simulated scene, in the three words of the tables.
KINDS = {
    **{kind: kind for kind in PAPER_KIND},
    **dict.fromkeys(("aerial", "street", "facade", "terrain"), "outdoor"),
    **dict.fromkeys(("room", "hall"), "indoor"),
}
#: Of a scene that nobody described; it is the default of ``l2p recover``, too.
UNDESCRIBED = "indoor"
SOURCES = "SOURCES.md"


@dataclass(frozen=True)
class SceneSource:
    """Where a scene comes from: a path or ``sim:KIND:POINTS:SEED``."""

    name: str
    source: str
    kind: str


@dataclass(frozen=True, eq=False)
class Loaded:
    """The points of a scene, their spacing (scene units) and a digest of their bytes."""

    xyz: Float[np.ndarray, "points 3"]
    spacing: float
    digest: str


def scenes_of(entries: tuple[str, ...], kinds: dict[str, str]) -> tuple[SceneSource, ...]:
    """Every scene that the entries name, with ``kinds`` before what a SOURCES.md says.

    Raises
    ------
    FileNotFoundError, InputError
        If nothing is there, it is no scene, a kind is unknown, or two scenes have one name.
    """
    found: list[SceneSource] = []
    for entry in entries:
        found += [_simulated(entry)] if entry.startswith("sim:") else _from_files(Path(entry))
    names = [scene.name for scene in found]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"got {names.count(name)} scenes named {name}; rename one of the files")
    unknown = sorted(set(kinds) - set(names))
    if unknown:
        raise InputError(f"got a kind for {unknown[0]}, which is no scene of this run; expected one of {names}")
    return tuple(SceneSource(s.name, s.source, _kind(kinds.get(s.name, s.kind), s.name)) for s in found)


@lru_cache(maxsize=16)
def load(source: str) -> Loaded:
    """Read or simulate the points, to keep them."""
    xyz = scene_at(source).xyz
    return Loaded(xyz, spacing(xyz), hashlib.sha256(np.ascontiguousarray(xyz).tobytes()).hexdigest()[:16])


def scene_at(source: str) -> Scene:
    """Read or simulate a scene, with all that is known of its points."""
    if not source.startswith("sim:"):
        return load_scene(source)
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
    try:
        return kind_of(path) in SCENES
    except InputError:
        # One that is cut short may be a scene: whoever reads it says what is wrong with it.
        return path.suffix == ".npz" and path.is_file() and not is_zipfile(path)


def _described_kinds(path: Path) -> dict[str, str]:
    """Kinds from the Markdown table with columns ``scene`` and ``kind`` of a SOURCES.md in the folder or above it."""
    folder = path if path.is_dir() else path.parent
    found = next((p / SOURCES for p in (folder, folder.resolve().parent) if (p / SOURCES).is_file()), None)
    rows = found.read_text(encoding="utf-8").splitlines() if found else []
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
