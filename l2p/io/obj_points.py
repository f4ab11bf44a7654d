"""Vertices of OBJ files as points."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError


def read_obj_points(
    path: str | PathLike[str],
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"] | None]:
    """Read ``v x y z`` and, if each has them, colours: ``v x y z r g b``, as shares or 0 to 255; else None.

    All other records are ignored; a vertex of four or seven numbers has a weight in fourth place.

    Raises
    ------
    InputError
        For the first vertex that is malformed.
    """
    rows: list[list[float]] = []
    colours: list[list[float]] = []
    for number, line in enumerate(Path(path).read_bytes().split(b"\n"), start=1):
        words = line.split(b"#", 1)[0].split()
        if words[:1] != [b"v"]:
            continue
        try:
            values = [float(word) for word in words[1:]]
        except ValueError:
            values = []
        if len(values) not in (3, 4, 6, 7):
            shown = repr(line[:60].decode("utf-8", errors="replace").strip())
            raise InputError(f"{path} line {number}: got {shown}; expected three numbers after v, and perhaps a colour")
        rows.append(values[:3])
        if len(values) >= 6:
            colours.append(values[-3:])
    xyz = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return xyz, np.array(colours, dtype=np.float64) if rows and len(colours) == len(rows) else None
