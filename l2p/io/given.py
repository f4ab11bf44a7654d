"""Scenes, recoveries and truths that users have in hand: an object of l2p, the path of a file, or an array."""

from __future__ import annotations

import os
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Float

from l2p.checks import finite_rows, named
from l2p.errors import InputError
from l2p.io.kinds import LINE_CLOUDS, kind_of
from l2p.io.line_files import load_lines
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_scene, load_truth
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene
from l2p.maps.truth import Hiding, Truth

#: What can be given where a scene or a line cloud is expected.
GivenScene = Scene | LineCloud | Float[np.ndarray, "points 3"] | str | PathLike[str]
#: What can be given where a recovery is expected.
GivenRecovery = Recovery | Float[np.ndarray, "lines 3"] | str | PathLike[str]
#: What can be given where a truth is expected.
GivenTruth = Truth | Hiding | Float[np.ndarray, "lines 3"] | str | PathLike[str]


def given_scene(thing: GivenScene) -> Scene | LineCloud:
    """Return a scene or a line cloud as it is, read it from its path, or make a scene of an array of points.

    Raises
    ------
    FileNotFoundError
        If there is nothing at the path.
    InputError
        If it is anything else.
    """
    if isinstance(thing, Scene | LineCloud):
        return thing
    if isinstance(thing, str | os.PathLike):
        return load_lines(thing) if kind_of(thing) in LINE_CLOUDS else load_scene(thing)
    if _has_rows(thing):
        return Scene(finite_rows("points", thing))
    raise InputError(
        f"got {named(thing)}; expected a Scene, points of shape (points, 3), a LineCloud, or the path of a file"
    )


def given_recovery(thing: GivenRecovery) -> Recovery:
    """Return a recovery as it is, read it from its path, or make one of points in the order of the lines.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is anything else.
    """
    if isinstance(thing, Recovery):
        return thing
    if isinstance(thing, str | os.PathLike):
        return load_recovery(thing)
    if _has_rows(thing):
        points = finite_rows("recovered points", thing)
        return Recovery(points, np.zeros(len(points), dtype=np.float32), np.zeros(len(points)))
    raise InputError(
        f"got {named(thing)} for a recovery; expected a Recovery, its npz, or points of shape (lines, 3) in the order "
        "of the lines"
    )


def given_truth(thing: GivenTruth) -> Truth | Float[np.ndarray, "lines 3"]:
    """Return a truth, that of a hiding, or the points as they are; read it from its path.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is anything else; also a scene, whose points are in another order than the lines.
    """
    if isinstance(thing, Truth):
        return thing
    if isinstance(thing, Hiding):
        return thing.truth
    if isinstance(thing, str | os.PathLike):
        return load_truth(thing)
    if _has_rows(thing):
        return finite_rows("truth", thing)
    what = ", whose points are in another order than the lines" if isinstance(thing, Scene) else ""
    raise InputError(
        f"got {named(thing)} for the truth{what}; expected a Truth (l2p.hide(scene).truth), its npz, or points of "
        "shape (lines, 3) in the order of the lines"
    )


def _has_rows(thing: Any) -> bool:
    return hasattr(thing, "shape") or (isinstance(thing, list | tuple) and len(thing) > 0)
