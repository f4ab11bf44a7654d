"""Files beside a COLMAP model that would undo its hiding if they were published with the line cloud."""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path

from l2p.errors import InputError
from l2p.io.colmap_folders import model_folder
from l2p.io.descriptors import BESIDE
from l2p.io.kinds import Kind, kind_of

#: What files give away.
_POINTS, _OBSERVED, _PICTURES = "the points", "where images see the points", "pictures of the place"
_FEATURES, _TRUTH = "features of the images", "true points"
#: Folders of pictures and of what COLMAP computes from them.
_FOLDERS = {"images": _PICTURES, "thumbs": _PICTURES, "thumbnails": _PICTURES, "stereo": "depth maps"}
#: Patterns of files in the folder of the model, and there or above it.
_OF_MODEL = {
    "points3D.*": _POINTS,
    "images.bin": _OBSERVED,
    "images.txt": _OBSERVED,
    BESIDE: "descriptors of the points",
}
_BESIDE_MODEL = {
    "*.db": _FEATURES,
    "*.h5": _FEATURES,
    "*.nvm": "points and features",
    "*.ply": "a point cloud",
    "*.npz": _TRUTH,
}
#: Files of a pattern that are named before the others are counted.
_NAMED = 3


def leaks_beside(model_path: str | PathLike[str]) -> list[tuple[str, str]]:
    """List the files that give away the points of a COLMAP model, and what each gives away.

    Looks into the folder of the model and the one above; if that one is ``sparse``, also above it. Line clouds and
    recoveries are not listed.

    Returns
    -------
    list of (str, str)
        Paths from the folder of the model, such as ``../database.db``, and what they give away, such as ``features of
        the images``; more than three files of one ending in a folder are cut short.
    """
    folder = Path(os.path.abspath(model_folder(model_path, say=False)))
    # By path, as several patterns may match a file: the first says what it gives away.
    found: dict[str, str] = {}
    for pattern, gives in _OF_MODEL.items():
        found |= _matching(folder, pattern, gives, found)
    for place in (folder, folder.parent, *([folder.parent.parent] if folder.parent.name == "sparse" else [])):
        for pattern, gives in _BESIDE_MODEL.items():
            found |= _matching(place, pattern, gives, found)
        found |= {os.path.join(place, name, ""): gives for name, gives in _FOLDERS.items() if _is_filled(place / name)}
    return [(_from(folder, path), gives) for path, gives in found.items()]


def _matching(folder: Path, pattern: str, gives: str, known: dict[str, str]) -> dict[str, str]:
    """Files of one pattern in a folder that are not known; the others than the first few as one entry."""
    files = [str(path) for path in sorted(folder.glob(pattern)) if str(path) not in known and _tells(path)]
    more = len(files) - _NAMED
    named = files if more <= 0 else [*files[:_NAMED], os.path.join(folder, f"{more} more {pattern}")]
    return dict.fromkeys(named, gives)


def _tells(path: Path) -> bool:
    """Whether a file gives points away: line clouds and recoveries do not, nor do npz files that l2p cannot read."""
    if path.suffix not in (".ply", ".npz") or path.name == BESIDE:
        return os.path.isfile(path)
    try:
        kind = kind_of(path)
    except (InputError, OSError):
        kind = None
    return kind is not Kind.LINES_PLY if path.suffix == ".ply" else kind in (Kind.TRUTH, Kind.SCENE_NPZ)


def _is_filled(folder: Path) -> bool:
    """Whether there is a folder with something in it; what cannot be read may be full."""
    try:
        return folder.is_dir() and any(folder.iterdir())
    except OSError:
        return True


def _from(folder: Path, path: str) -> str:
    """Path from the folder of the model; that of a folder ends as such."""
    return os.path.relpath(path, folder) + (os.sep if path.endswith(os.sep) else "")
