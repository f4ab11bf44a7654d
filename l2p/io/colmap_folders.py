"""Folders of COLMAP models: which of its tables one has, and the model within the folder of a project."""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path

from l2p.errors import InputError, warn
from l2p.io.signatures import refuse_pointer

#: Tables that each whole model has.
TABLES = ("cameras", "images", "points3D")
# Folders in which no model lies, with many files.
_SKIPPED = frozenset({"images", "thumbs", "thumbnails", "stereo", "masks", "depth", "depths", "rgb"})
# Levels below the folder of a project that are searched, as for dense/0/sparse.
_DEEPEST = 3
# Folders that are looked at before the search ends.
_MOST_FOLDERS = 2000
# Models that are named, the largest first.
_NAMED = 6


def is_model(path: str | PathLike[str]) -> bool:
    """Whether a folder itself has the points of a COLMAP model."""
    return any((Path(path) / f"points3D.{ending}").is_file() for ending in ("bin", "txt"))


def is_binary(path: str | PathLike[str]) -> bool:
    """Whether the binary files of a model folder are read: as COLMAP does, if they are complete.

    If neither format is complete, points in binary are preferred.
    """
    for ending in ("bin", "txt"):
        if all((Path(path) / f"{table}.{ending}").is_file() for table in TABLES):
            return ending == "bin"
    return (Path(path) / "points3D.bin").is_file()


def points_file(path: str | PathLike[str]) -> Path:
    """The file of points that is read in a model folder."""
    return Path(path) / f"points3D.{'bin' if is_binary(path) else 'txt'}"


def model_folder(path: str | PathLike[str], say: bool = True) -> Path:
    """Find the folder of a COLMAP model: the given one, or the only one within the folder of a project.

    Parameters
    ----------
    path : path
        A model, or a folder above it: ``project``, ``project/sparse``, ``models``.
    say : bool
        Warn if the model lies deeper than ``path``.

    Raises
    ------
    InputError
        If there is none, or there are several; the message names them and their sizes.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> with tempfile.TemporaryDirectory() as project:
    ...     model = pathlib.Path(project, "sparse", "0")
    ...     model.mkdir(parents=True)
    ...     _ = (model / "points3D.txt").write_text("1 0.5 0 0 9 9 9 0")
    ...     model_folder(project, say=False) == model
    True
    """
    if is_model(path):
        return Path(path)
    if not os.path.isdir(path):
        raise InputError(f"{path} is not a folder; expected a COLMAP model folder")
    models = _models_below(Path(path))
    if not models:
        raise InputError(
            f"{path} is a folder without points3D.bin or points3D.txt; expected a COLMAP model or a file{_other(path)}"
        )
    if len(models) > 1:
        raise InputError(f"{path} has {len(models)} COLMAP models, {_named(Path(path), models)}; give one of them")
    if say:
        warn(f"{path}: its only COLMAP model, {models[0].relative_to(path)}, is read")
    return models[0]


def _models_below(path: Path) -> list[Path]:
    """Folders of models, none within another, in the order of their names."""
    found: list[Path] = []
    edge, seen = [path], 0
    for _ in range(_DEEPEST):
        below = []
        for folder in edge:
            below += _folders_in(folder)
        seen += len(below)
        if seen > _MOST_FOLDERS:
            break
        found += [each for each in below if is_model(each)]
        edge = [each for each in below if not is_model(each)]
    return found


def _folders_in(path: Path) -> list[Path]:
    """Folders in which a model may lie; none of a folder that cannot be read."""
    try:
        with os.scandir(path) as entries:
            names = [entry.name for entry in entries if entry.is_dir()]
    except OSError:
        return []
    return [path / name for name in sorted(names) if name not in _SKIPPED and not name.startswith(".")]


def _named(path: Path, models: list[Path]) -> str:
    """Names and sizes of models, the largest first."""
    sizes = sorted(((_points_in(model), model) for model in models), key=lambda each: (-each[0], each[1]))
    names = [f"{model.relative_to(path)} ({size:,} points)" for size, model in sizes[:_NAMED]]
    more = len(models) - _NAMED
    return ", ".join([*names, *([f"{more} smaller ones"] if more > 0 else [])])


def _points_in(model: Path) -> int:
    """Number of points that a model claims to have; 0 if it cannot be told."""
    file = points_file(model)
    try:
        if file.suffix == ".bin":
            with open(file, "rb") as binary:
                head = binary.read(8)
            return 0 if len(head) < 8 or head.startswith(b"version ") else int.from_bytes(head, "little")
        with open(file, "rb") as text:
            return sum(1 for line in text if line.strip() and not line.startswith(b"#"))
    except OSError:
        return 0


def _other(path: str | PathLike[str]) -> str:
    """A map of another program in the folder, as a hint."""
    for name in ("reconstruction.json", "transforms.json", "bundle.out", "sfm_data.json", "sparse_pc.ply", "fused.ply"):
        if (Path(path) / name).is_file():
            return f", such as {name} in it"
    return ""


def refuse_pointers(path: str | PathLike[str]) -> None:
    """Raise InputError if a table of a model is a pointer of Git LFS."""
    for table in TABLES:
        for ending in ("bin", "txt"):
            file = Path(path) / f"{table}.{ending}"
            if file.is_file():
                with open(file, "rb") as opened:
                    refuse_pointer(file, opened.read(64))
