"""Points that flags choose, to leave out (``--drop-box``, ``--drop-ids``, ``--drop-masks``) or to look at
(``--region-box`` and so on), and what would undo a hiding."""

from __future__ import annotations

import os
import sys
from argparse import Namespace

import numpy as np
from jaxtyping import Bool

from l2p.errors import InputError
from l2p.io.colmap import read_model
from l2p.io.id_files import marked_by_ids
from l2p.io.kinds import Kind, kind_of
from l2p.io.leaks import leaks_beside
from l2p.io.mask_files import marked_by_masks
from l2p.maps.region import Box, kept_rows
from l2p.maps.scene import Scene


def asks_for_points(arguments: Namespace, flag: str) -> bool:
    """Whether a flag chooses points; ``flag`` is ``drop`` or ``region``."""
    box, ids, masks = _given(arguments, flag)
    return bool(box) or ids is not None or masks is not None


def chosen(arguments: Namespace, scene: Scene, flag: str) -> tuple[Bool[np.ndarray, " points"] | None, str]:
    """Find the points that the flags choose.

    Returns
    -------
    ((points,) bool or None, str)
        True for each chosen point, and how many of how many they are; None and an empty line without flags.

    Raises
    ------
    FileNotFoundError, InputError
        If a flag chooses no point, a file is missing or damaged, or the scene has no ids or images where they are
        needed.
    """
    if not asks_for_points(arguments, flag):
        return None, ""
    boxes, ids, masks = _given(arguments, flag)
    found, used = np.zeros(len(scene), dtype=np.bool_), ""
    for numbers in boxes:
        inside = Box.of(numbers).contains(scene.xyz)
        if not inside.any():
            raise InputError(_no_point_in(f"--{flag}-box", numbers, scene))
        found |= inside
    if ids is not None:
        found |= marked_by_ids(ids, scene.ids)
    if masks is not None:
        masked, used = _masked(arguments.scene, f"--{flag}-masks", masks, scene)
        found |= masked
    return found, f"{int(found.sum())} of {len(scene)} points{used}"


def dropped(arguments: Namespace, scene: Scene) -> tuple[Bool[np.ndarray, " points"] | None, str]:
    """Find the points to leave out, as :func:`chosen`, and a line that tells how many; InputError also if they are
    all."""
    drop, how_many = chosen(arguments, scene, "drop")
    if drop is None:
        return None, ""
    kept_rows(drop, len(scene))
    return drop, f"left out: {how_many}"


def point_words(arguments: Namespace, flag: str) -> list[str]:
    """Return the flags as words of a command line."""
    boxes, ids, masks = _given(arguments, flag)
    words = []
    for numbers in boxes:
        # All digits, without an exponent.
        digits = (np.format_float_positional(n, trim="-") if np.isfinite(n) else str(n) for n in numbers)
        words += [f"--{flag}-box", *digits]
    words += [] if ids is None else [f"--{flag}-ids", ids]
    return words + ([] if masks is None else [f"--{flag}-masks", masks])


def _given(arguments: Namespace, flag: str) -> tuple[list[list[float]], str | None, str | None]:
    """Boxes, file of ids and folder of masks of the flags."""
    return tuple(getattr(arguments, f"{flag}_{what}") for what in ("box", "ids", "masks"))  # type: ignore[return-value]


def warn_of_leaks(scene_path: str) -> None:
    """Name on stderr the files beside a COLMAP model that would undo its hiding; nothing for other scenes."""
    kind = kind_of(scene_path)
    if kind not in (Kind.SCENE_MODEL, Kind.SCENE_POINTS):
        return
    leaks = leaks_beside(scene_path if kind is Kind.SCENE_MODEL else os.path.dirname(os.path.abspath(scene_path)))
    named = "; ".join(f"{path} ({gives})" for path, gives in leaks)
    print(" ".join(f"l2p: do not publish beside it, of {scene_path}: {named}".split()), file=sys.stderr)


def _masked(model: str, flag: str, folder: str, scene: Scene) -> tuple[Bool[np.ndarray, " points"], str]:
    """Points that masks choose, and how many images have one."""
    if kind_of(model) is not Kind.SCENE_MODEL or scene.ids is None:
        raise InputError(f"got {flag} for a scene without images; expected a COLMAP model")
    masked = marked_by_masks(folder, read_model(model), scene.ids)
    if not masked.points.any():
        raise InputError(
            f"no image sees a point in a black pixel of its mask in {folder} ({masked.masks} masks); expected black "
            "(0) where points are meant"
        )
    return masked.points, f" ({masked.masks} of {masked.images} images have a mask)"


def _no_point_in(flag: str, numbers: list[float], scene: Scene) -> str:
    low, high = (
        " ".join(f"{value:.4g}" for value in corner) for corner in (scene.xyz.min(axis=0), scene.xyz.max(axis=0))
    )
    asked = " ".join(f"{value:g}" for value in numbers)
    return (
        f"got {flag} {asked}, which holds none of the {len(scene)} points; expected a box in scene units, where "
        f"they lie between {low} and {high}"
    )
