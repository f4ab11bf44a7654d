"""Descriptors beside a COLMAP model: an npz of ``point3D_id`` and ``descriptor``."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from l2p.errors import InputError
from l2p.io.npz import Fields
from l2p.maps.appearance import SIFT
from l2p.maps.scene import Scene

#: File of descriptors that is looked for beside a model.
BESIDE = "descriptors.npz"


def with_descriptors(scene: Scene, path: str | PathLike[str]) -> Scene:
    """Add the descriptors of a file to the scene of a COLMAP model, by point id.

    Raises
    ------
    FileNotFoundError, InputError
        If the file is missing or damaged, the scene has no ids, or a point has no descriptor.
    """
    if scene.ids is None:
        raise InputError(f"got descriptors {path} for a scene without point ids; expected a COLMAP model")
    if not Path(path).exists():
        raise FileNotFoundError(f"{path} does not exist; expected a file of descriptors")
    fields = Fields(path, ("point3D_id", "descriptor", "descriptor_kind"))
    ids = fields.take("point3D_id", "iu", (None,), np.int64)
    descriptor, kind = fields.take_descriptor(len(ids))
    if descriptor is None:
        raise InputError(f"{path} has no descriptor; expected point3D_id and descriptor")
    order = np.argsort(ids, kind="stable")
    place = np.searchsorted(ids[order], scene.ids).clip(max=max(len(ids) - 1, 0))
    missing = scene.ids != ids[order][place] if len(ids) else np.ones(len(scene), dtype=bool)
    if missing.any():
        raise InputError(
            f"{path} lacks {int(missing.sum())} of the {len(scene)} points, {int(scene.ids[missing][0])} among them; "
            "give the descriptors of this model"
        )
    return replace(scene, descriptor=descriptor[order][place], descriptor_kind=kind or _kind_of(descriptor))


def _kind_of(descriptor: np.ndarray) -> str | None:
    """The kind of descriptors that do not name it: COLMAP's SIFT is the only one of 128 bytes."""
    return SIFT if descriptor.dtype == np.uint8 and descriptor.shape[1] == 128 else None
