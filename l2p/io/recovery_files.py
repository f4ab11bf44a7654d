"""Files of recoveries: npz in the order of the lines, PLY and text with colour and confidence for others."""

from __future__ import annotations

import json
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from l2p.checks import OUT_OF_RANGE, in_range
from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.io.endings import checked_ending
from l2p.io.kinds import Kind, kind_of
from l2p.io.npz import Fields, npz_bytes
from l2p.io.ply import ply_bytes, point_records
from l2p.io.point_text import ENDINGS as TEXT
from l2p.io.point_text import text_bytes
from l2p.maps.recovery import Recovery

#: Version of written npz recoveries; older ones stay readable. Version 1 did not record whether the confidence is
#: calibrated: it is for the learned attack.
RECOVERY_VERSION = 2

#: Endings of the files of a recovery.
ENDINGS = (".npz", ".ply", *TEXT)

#: Entries of ``Recovery.info`` that differ from run to run: written to ``--json`` but not to the file, so that the
#: same lines, seed and threads give the same bytes.
MEASURED = ("seconds", "peak_memory")

# Colours from dark blue (low confidence) over green to yellow (high); equal steps look about equal.
_COLOURS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64)

_NAMES = (
    "xyz",
    "confidence",
    "beta",
    "rgb",
    "neighbors",
    "affinity",
    "kept",
    "info",
    "calibrated",
    "element",
    "version",
)


def save_recovery(
    recovery: Recovery, path: str | PathLike[str], *, overwrite: bool = False, double: bool | None = None
) -> None:
    """Write a recovery by the ending of ``path``: npz (every line, in order), PLY or text (the kept points).

    Coordinates of a PLY have 32 bits, or 64 if these would lose digits; ``double`` decides otherwise.
    """
    ending = checked_ending(path, "a recovery", dict.fromkeys(ENDINGS, ()))
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(_npz_bytes(recovery) if ending == ".npz" else _point_bytes(recovery, ending, double))


def load_recovery(path: str | PathLike[str]) -> Recovery:
    """Read a recovery npz; its points are in the order of the lines.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is damaged or of another kind.
    """
    kind = kind_of(path)
    if kind is not Kind.RECOVERY:
        hint = "; a PLY does not keep the order of the lines" if kind is Kind.SCENE_PLY else ""
        raise InputError(f"{path} is {kind.value}; expected a recovery npz (l2p recover -o OUT.npz){hint}")
    fields = Fields(path, _NAMES)
    version = fields.take_version(RECOVERY_VERSION)
    xyz = fields.take("xyz", "fiu", (None, 3), np.float64)
    rows = len(xyz)
    neighbors = fields.take_optional("neighbors", "iu", (rows, None), np.int64)
    width = None if neighbors is None else neighbors.shape[1]
    info = _info(path, fields)
    calibrated = info.get("method") == "learned" if version == 1 else bool(fields.take("calibrated", "b", ()))
    recovery = Recovery(
        xyz=xyz,
        confidence=fields.take("confidence", "fiu", (rows,), np.float32),
        beta=fields.take("beta", "fiu", (rows,), np.float64),
        rgb=fields.take_rgb(rows),
        neighbors=neighbors,
        affinity=fields.take_optional("affinity", "fiu", (rows, width), np.float32),
        kept=fields.take_optional("kept", "b", (rows,)),
        info=info,
        calibrated=calibrated,
        element=fields.take_element(rows),
    )
    _check_numbers(path, recovery)
    return recovery


def confidence_colours(confidence: Float[np.ndarray, " points"]) -> UInt8[np.ndarray, "points 3"]:
    """Colour of each confidence in [0, 1], from dark blue (0) to yellow (1)."""
    place = np.linspace(0, 1, len(_COLOURS))
    channels = [np.interp(confidence, place, _COLOURS[:, channel]) for channel in range(3)]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


def _npz_bytes(recovery: Recovery) -> bytes:
    info = {name: value for name, value in recovery.info.items() if name not in MEASURED}
    return npz_bytes(
        {
            "xyz": recovery.xyz,
            "confidence": recovery.confidence,
            "beta": recovery.beta,
            "rgb": recovery.rgb,
            "neighbors": recovery.neighbors,
            "affinity": recovery.affinity,
            "kept": recovery.kept,
            "info": np.array(json.dumps(info, sort_keys=True)),
            "calibrated": np.array(recovery.calibrated),
            "element": None if recovery.one_each else recovery.element,
            "version": np.array(RECOVERY_VERSION),
        }
    )


def _point_bytes(recovery: Recovery, ending: str, double: bool | None) -> bytes:
    """Kept points as PLY or text; those without colours are coloured by confidence in a PLY, for viewers."""
    kept = slice(None) if recovery.kept is None else recovery.kept
    xyz, confidence = recovery.xyz[kept], recovery.confidence[kept]
    rgb = None if recovery.rgb is None else recovery.rgb[kept]
    if ending in TEXT:
        return text_bytes(ending, xyz, rgb, confidence)
    shown = confidence_colours(confidence) if rgb is None else rgb
    return ply_bytes({"vertex": point_records(xyz, shown, confidence, double)})


def _info(path: str | PathLike[str], fields: Fields) -> dict[str, Any]:
    text = fields.take_optional_text("info")
    try:
        info = {} if text is None else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} has info that is not JSON; write the file again") from error
    if not isinstance(info, dict):
        raise InputError(f"{path} has info that is a {type(info).__name__}; expected a JSON object")
    return info


def _check_numbers(path: str | PathLike[str], recovery: Recovery) -> None:
    if len(recovery) == 0:
        raise InputError(f"{path} has no points; expected at least one")
    if not (in_range(recovery.xyz).all() and in_range(recovery.beta).all()):
        raise InputError(f"{path} has points that are {OUT_OF_RANGE}; expected one finite point on each line")
    if not ((recovery.confidence >= 0) & (recovery.confidence <= 1)).all():
        raise InputError(f"{path} has confidences outside [0, 1]; expected a probability for each line")
    neighbors, affinity = recovery.neighbors, recovery.affinity
    if neighbors is not None and not ((neighbors >= -1) & (neighbors < len(recovery))).all():
        raise InputError(f"{path} has neighbors outside -1 to {len(recovery) - 1}; expected rows of the lines, or -1")
    if affinity is not None and not ((affinity >= 0) & (affinity < np.inf)).all():
        raise InputError(f"{path} has affinities that are negative or not finite; expected a weight for each neighbour")
