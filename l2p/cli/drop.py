"""Points that ``--drop-box``, ``--drop-ids`` and ``--drop-masks`` leave out, and what would undo a hiding."""

from __future__ import annotations

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


def asks_to_drop(arguments: Namespace) -> bool:
    """Whether a flag leaves points out."""
    return bool(arguments.drop_box) or arguments.drop_ids is not None or arguments.drop_masks is not None


def dropped(arguments: Namespace, scene: Scene) -> tuple[Bool[np.ndarray, " points"] | None, str]:
    """Find the points that the flags leave out.

    Returns
    -------
    ((points,) bool or None, str)
        True for each point to leave out, and a line that tells how many; None and an empty line without flags.

    Raises
    ------
    FileNotFoundError, InputError
        If a flag leaves out no point, all points are left out, a file is missing or damaged, or the scene has no ids or
        images where they are needed.
    """
    if not asks_to_drop(arguments):
        return None, ""
    drop, used = np.zeros(len(scene), dtype=np.bool_), ""
    for numbers in arguments.drop_box:
        inside = Box.of(numbers).contains(scene.xyz)
        if not inside.any():
            raise InputError(_no_point_in(numbers, scene))
        drop |= inside
    if arguments.drop_ids is not None:
        drop |= marked_by_ids(arguments.drop_ids, scene.ids)
    if arguments.drop_masks is not None:
        masked, used = _masked(arguments, scene)
        drop |= masked
    kept_rows(drop, len(scene))
    return drop, f"left out: {int(drop.sum())} of {len(scene)} points{used}"


def drop_words(arguments: Namespace) -> list[str]:
    """Return the flags as words of a command line."""
    words = []
    for numbers in arguments.drop_box:
        # All digits, without an exponent.
        digits = (np.format_float_positional(n, trim="-") if np.isfinite(n) else str(n) for n in numbers)
        words += ["--drop-box", *digits]
    words += [] if arguments.drop_ids is None else ["--drop-ids", arguments.drop_ids]
    return words + ([] if arguments.drop_masks is None else ["--drop-masks", arguments.drop_masks])


def warn_of_leaks(scene_path: str) -> None:
    """Name on stderr the files beside a COLMAP model that would undo its hiding; nothing for other scenes."""
    if kind_of(scene_path) is not Kind.SCENE_MODEL:
        return
    leaks = leaks_beside(scene_path)
    named = "; ".join(f"{path} ({gives})" for path, gives in leaks)
    print(" ".join(f"l2p: do not publish beside it, of {scene_path}: {named}".split()), file=sys.stderr)


def _masked(arguments: Namespace, scene: Scene) -> tuple[Bool[np.ndarray, " points"], str]:
    """Points that masks leave out, and how many images have one."""
    if kind_of(arguments.scene) is not Kind.SCENE_MODEL or scene.ids is None:
        raise InputError("got --drop-masks for a scene without images; expected a COLMAP model")
    masked = marked_by_masks(arguments.drop_masks, read_model(arguments.scene), scene.ids)
    if not masked.points.any():
        raise InputError(
            f"no image sees a point in a black pixel of its mask in {arguments.drop_masks} ({masked.masks} masks); "
            "expected black (0) where points are to be left out"
        )
    return masked.points, f" ({masked.masks} of {masked.images} images have a mask)"


def _no_point_in(numbers: list[float], scene: Scene) -> str:
    low, high = (
        " ".join(f"{value:.4g}" for value in corner) for corner in (scene.xyz.min(axis=0), scene.xyz.max(axis=0))
    )
    asked = " ".join(f"{value:g}" for value in numbers)
    return (
        f"got --drop-box {asked}, which holds none of the {len(scene)} points; expected a box in scene units, where "
        f"they lie between {low} and {high}"
    )
