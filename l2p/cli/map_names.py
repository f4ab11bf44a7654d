"""Name of a map, from its path."""

from __future__ import annotations

import os
from pathlib import Path

from l2p.cli.lift import printable

#: Folders that programs make inside that of a map, and files of a model: they name no map.
_GENERIC = frozenset(
    ("sparse", "dense", "colmap", "model", "models", "reconstruction", "reconstructions", "sfm", "bin", "txt", "text")
)
_TABLES = frozenset(("points3d", "cameras", "images", "rigs", "frames"))


def map_name(path: str) -> str:
    """Return the name of a map: that of its file without the ending, or of the first folder above that tells.

    >>> map_name("/home/me/office/sparse/0"), map_name("scans/church.npz"), map_name("office/sparse/0/points3D.bin")
    ('office', 'church', 'office')
    """
    whole = Path(os.path.abspath(path))
    steps = list(whole.parts[1:])
    if whole.suffix and not whole.is_dir():
        if whole.stem.lower() not in _TABLES:
            return printable(whole.stem)
        steps.pop()
    telling = [step for step in steps if step.lower() not in _GENERIC and not step.isdecimal()]
    return printable((telling or steps or ["map"])[-1])


def shown_name(path: str) -> str:
    """Return the name of a file, or of the map in a folder, for a page that shows it."""
    return map_name(path) if os.path.isdir(path) else printable(os.path.basename(path))
