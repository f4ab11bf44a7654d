"""Files that list points by their ids (COLMAP ``point3D_id``): text, npy or npz."""

from __future__ import annotations

import os
from os import PathLike

import numpy as np
from jaxtyping import Bool, Int

from l2p.errors import InputError
from l2p.io.npz import Fields, read_npy

_EXPECTED = "expected point ids as text, or an npy or npz (point3D_id) of integers"
#: Largest id that an int64 holds.
_LARGEST = 2**63 - 1


def load_ids(path: str | PathLike[str]) -> Int[np.ndarray, " ids"]:
    """Read the point ids of a file, int64: text (blanks, commas or lines between them, ``#`` comments), npy or npz.

    Raises
    ------
    FileNotFoundError
        If there is no file.
    InputError
        If it is a folder, damaged or empty, or a word or a number is no id.
    """
    if os.path.isdir(path):
        raise InputError(f"{path} is a folder; {_EXPECTED}")
    with open(path, "rb") as file:
        head = file.read(8)
    if head.startswith(b"PK"):
        ids = Fields(path, ("point3D_id",)).take("point3D_id", "iu", (None,), np.int64)
    elif head.startswith(b"\x93NUMPY"):
        ids = _checked(path, read_npy(path))
    else:
        ids = _read_text(path)
    if len(ids) == 0:
        raise InputError(f"{path} has no point ids; {_EXPECTED}")
    return ids


def marked_by_ids(path: str | PathLike[str], ids: Int[np.ndarray, " points"] | None) -> Bool[np.ndarray, " points"]:
    """Mask of the points of a scene, whose ids are ``ids``, that a file lists (:func:`load_ids`).

    Raises
    ------
    FileNotFoundError, InputError
        As :func:`load_ids`, and if the scene has no ids or lacks one that is listed.
    """
    if ids is None:
        raise InputError(f"got point ids {path} for a scene without ids; expected a COLMAP model, or an npz with ids")
    listed = np.unique(load_ids(path))
    unknown = listed[~np.isin(listed, ids)]
    if len(unknown):
        raise InputError(
            f"{path} lists {len(unknown)} of its {len(listed)} point ids that the scene lacks, {int(unknown[0])} among "
            "them; give ids of this scene"
        )
    return np.isin(ids, listed)


def _read_text(path: str | PathLike[str]) -> Int[np.ndarray, " ids"]:
    with open(path, "rb") as file:
        try:
            text = file.read().decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(f"{path} is neither text, npy nor npz; {_EXPECTED}") from error
    ids = []
    for number, line in enumerate(text.split("\n"), start=1):
        for word in line.split("#", 1)[0].replace(",", " ").split():
            # isdecimal takes digits of all scripts, and int long numbers only for a while.
            if not (word.isascii() and word.isdecimal()) or len(word) > 19 or int(word) > _LARGEST:
                shown = word if len(word) <= 40 else f"{word[:37]}..."
                raise InputError(f"{path} line {number}: got {shown!r}; expected a point id, 0 to 2^63 - 1")
            ids.append(int(word))
    return np.array(ids, dtype=np.int64)


def _checked(path: str | PathLike[str], array: np.ndarray) -> Int[np.ndarray, " ids"]:
    if array.dtype.kind not in "iu" or array.ndim != 1 or (array > _LARGEST).any():
        raise InputError(f"{path} has an array of type {array.dtype}, shape {array.shape}; expected int64, (any,)")
    return array.astype(np.int64)
