"""Descriptors of a scene: its own, or from files beside a COLMAP model (npz, database.db, hloc's features)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int

from l2p.errors import InputError
from l2p.io.colmap import read_model, read_scene
from l2p.io.colmap_folders import model_folder
from l2p.io.kinds import Kind, kind_of
from l2p.io.npz import Fields
from l2p.io.scene_files import checked_scene, load_scene
from l2p.io.track_means import Features, mean_over_tracks
from l2p.maps.appearance import SIFT
from l2p.maps.scene import Scene

if TYPE_CHECKING:
    from l2p.io.colmap_database import ColmapDatabase
    from l2p.io.hloc_features import HlocFeatures

#: npz of descriptors that is looked for in the folder of a model.
BESIDE = "descriptors.npz"
#: COLMAP's database, looked for in the folder of a model and the two above (``sparse/0``).
DATABASE = "database.db"

# First bytes of SQLite and HDF5 files.
_SQLITE, _HDF5 = b"SQLite format 3\0", b"\x89HDF\r\n\x1a\n"

_OF_IMAGES = f"expected COLMAP's {DATABASE} or hloc's features (h5)"
_EXPECTED = f"expected an npz with point3D_id and descriptor, COLMAP's {DATABASE} or hloc's features (h5)"


def load_described(path: str | PathLike[str], source: str | PathLike[str] | None = None) -> tuple[Scene, Path]:
    """Read a scene with descriptors.

    Parameters
    ----------
    path : path
        Any scene.
    source : path, optional
        File of descriptors. None takes those of the scene itself, or searches beside a COLMAP model
        (:func:`file_beside`).

    Returns
    -------
    (Scene, Path)
        The scene, and the file that its descriptors are from.

    Raises
    ------
    FileNotFoundError, InputError
        As :func:`load_scene` and :func:`with_descriptors`, and if there are no descriptors.
    """
    if kind_of(path) is Kind.SCENE_MODEL:
        scene, model = read_scene(path)
        scene = checked_scene(path, scene)
        source = file_beside(path) if source is None else Path(source)
        if source is None:
            raise InputError(f"{path} has no descriptors in its folder or two above; give their file: {_EXPECTED}")
        if model is None and source.is_file() and not _head(source).startswith(b"PK"):
            model = read_model(path)  # means over tracks need them: the error says what is wrong
        return with_descriptors(scene, source, model), source
    scene = load_scene(path)
    if source is not None:
        return with_descriptors(scene, source), Path(source)
    if scene.descriptor is None:
        raise InputError(f"{path} has no descriptors; give a scene npz that has them, or a COLMAP model")
    return scene, Path(path)


def with_descriptors(scene: Scene, path: str | PathLike[str], model: Any | None = None) -> Scene:
    """Add the descriptors of a file to a scene with point ids.

    Parameters
    ----------
    scene : Scene
        Points with ids.
    path : path
        An npz of ``point3D_id`` and ``descriptor``, COLMAP's ``database.db``, or hloc's features of images (h5); its
        content decides, not its name.
    model : pycolmap.Reconstruction, optional
        Model of the scene, whose tracks a database or features of images need.

    Raises
    ------
    FileNotFoundError, InputError
        If the file is missing or damaged, the scene has no ids, or a point has no descriptor.
    """
    if scene.ids is None:
        raise InputError(f"got descriptors {path} for a scene without point ids; expected a COLMAP model")
    if not os.path.lexists(path):
        raise FileNotFoundError(f"{path} does not exist; expected a file of descriptors")
    if not os.path.isfile(path):
        raise InputError(f"{path} is no regular file; {_EXPECTED}")
    if _head(path).startswith(b"PK"):
        descriptor, kind = _read_npz(path, scene.ids)
    else:
        descriptor, kind = _read_features(path, scene.ids, model)
    return replace(scene, descriptor=descriptor, descriptor_kind=kind)


def file_beside(model_path: str | PathLike[str]) -> Path | None:
    """Find the descriptors of a COLMAP model; None if there are none.

    An npz is looked for in the folder of the model only, as the ids in it are those of one model. A database, then
    hloc's features, may also lie one or two folders above. Databases without descriptors, such as hloc's, do not count.

    Raises
    ------
    InputError
        If a database is damaged, a folder has several files of features, or h5py is missing to read the only ones.
    """
    folder = _absolute(model_path)
    return folder / BESIDE if (folder / BESIDE).is_file() else features_beside(model_path)


def features_beside(model_path: str | PathLike[str]) -> Path | None:
    """Find the features of the images of a COLMAP model, as :func:`file_beside` does; None if there are none."""
    folder = _absolute(model_path)
    folders = [folder, *folder.parents][:3]
    for files in ([each / DATABASE] for each in folders):
        found = _with_features(files)
        if found:
            return found[0]
    for files in (sorted(each.glob("*.h5")) for each in folders):
        found = _with_features(files)
        if len(found) > 1:
            raise InputError(f"{found[0]} and {found[1].name} both have features; give the file that the model is from")
        if found:
            return found[0]
    return None


def _absolute(model_path: str | PathLike[str]) -> Path:
    return Path(os.path.abspath(model_folder(model_path, say=False)))


@contextmanager
def opened_features(model_path: str | PathLike[str], source: str | PathLike[str] | None) -> Iterator[Features]:
    """Open the features of the images of a COLMAP model.

    Parameters
    ----------
    source : path, optional
        COLMAP's ``database.db`` or hloc's features; None searches beside the model (:func:`features_beside`).

    Raises
    ------
    FileNotFoundError, InputError
        If there are none, or the file is something else.
    """
    path = features_beside(model_path) if source is None else Path(source)
    if path is None:
        raise InputError(f"{model_path} has no features of its images in its folder or two above; {_OF_IMAGES}")
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; {_OF_IMAGES}")
    opened = _opened(path, _head(path)) if path.is_file() else None
    if opened is None:
        raise InputError(f"{path} has no features of images; {_OF_IMAGES}")
    with opened as features:
        yield features


def _with_features(files: list[Path]) -> list[Path]:
    """Those of the files that hold features of images."""
    found = []
    for file in files:
        opened = _opened(file, _head(file)) if file.is_file() else None
        if opened is not None:
            with opened as features:
                found += [file] if features.has_features() else []
    return found


def _head(path: str | PathLike[str]) -> bytes:
    with open(path, "rb") as file:
        return file.read(len(_SQLITE))


def _opened(path: str | PathLike[str], head: bytes) -> ColmapDatabase | HlocFeatures | None:
    """Open a file of features of images; None if it begins as neither kind does."""
    if head.startswith(_SQLITE):
        from l2p.io.colmap_database import ColmapDatabase

        return ColmapDatabase(path)
    if head.startswith(_HDF5):
        from l2p.io.hloc_features import HlocFeatures

        return HlocFeatures(path)
    return None


def _read_features(
    path: str | PathLike[str], ids: Int[np.ndarray, " points"], model: Any | None
) -> tuple[np.ndarray, str]:
    """Mean descriptors over the tracks of the points, and their kind."""
    opened = _opened(path, _head(path))
    if opened is None:
        raise InputError(f"{path} is no file of descriptors; {_EXPECTED}")
    with opened as features:
        if model is None:
            raise InputError(f"got features of images, {path}, for a scene without tracks; expected a COLMAP model")
        kind = features.kind
        return mean_over_tracks(model, ids, features), kind


def _read_npz(path: str | PathLike[str], wanted: Int[np.ndarray, " points"]) -> tuple[np.ndarray, str | None]:
    """Descriptors by point id, and their kind, if the file or their shape says it."""
    fields = Fields(path, ("point3D_id", "descriptor", "descriptor_kind"))
    ids = fields.take("point3D_id", "iu", (None,), np.int64)
    descriptor, kind = fields.take_descriptor(len(ids))
    if descriptor is None:
        raise InputError(f"{path} has no descriptor; expected point3D_id and descriptor")
    order = np.argsort(ids, kind="stable")
    ids = ids[order]
    if (ids[1:] == ids[:-1]).any():
        raise InputError(f"{path} has {int((ids[1:] == ids[:-1]).sum())} repeated point ids; expected each point once")
    place = np.searchsorted(ids, wanted).clip(max=max(len(ids) - 1, 0))
    missing = wanted != ids[place] if len(ids) else np.ones(len(wanted), dtype=bool)
    if missing.any():
        raise InputError(
            f"{path} lacks {int(missing.sum())} of the {len(wanted)} points, {int(wanted[missing][0])} among them; "
            "give the descriptors of this model"
        )
    # COLMAP's SIFT is the only kind of 128 bytes.
    sift = descriptor.dtype == np.uint8 and descriptor.shape[1] == 128
    return descriptor[order][place], kind or (SIFT if sift else None)
