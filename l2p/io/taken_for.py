"""What a file was taken for, in a line: how many points or lines, with what beside them, and how that is known."""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path

from l2p.io.column_names import NORMAL
from l2p.io.kinds import TABLES, Kind, kind_of
from l2p.io.ply import ply_elements
from l2p.io.table_files import table_layout
from l2p.maps.lines import LineCloud
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud
from l2p.maps.scene import Scene

_ELEMENTS = {Scene: "points", LineCloud: "lines", PlaneCloud: "planes", PermutedCloud: "permuted points"}


def taken_for(
    path: str | PathLike[str], content: Scene | LineCloud | PlaneCloud | PermutedCloud, columns: str | None = None
) -> str:
    """Say what a file was taken for.

    Parameters
    ----------
    path : path
    content : Scene or hidden map
        What was read of it.
    columns : str, optional
        What its columns hold (``--columns``).

    Returns
    -------
    str
        Such as ``x.txt: 1,200 points with colours (columns x y z r g b)``.
    """
    kind, name = kind_of(path, columns), Path(path).name or os.fspath(path)
    name = os.fsencode(name).decode("utf-8", errors="replace")
    if kind in TABLES:
        layout = table_layout(path, columns)
        return f"{name}: {len(content):,} {layout.content} ({layout.words})"
    given = {"colours": content.rgb is not None, "normals": kind is Kind.SCENE_PLY and _has_normals(path)}
    given["descriptors"] = content.descriptor is not None
    *most, last = [word for word, there in given.items() if there] or [""]
    beside = f" with {', '.join(most)}{' and ' if most else ''}{last}" if last else ""
    # "a point cloud (PLY)" as "point cloud, PLY"
    what = kind.value.removeprefix("a ").replace(" (", ", ").rstrip(")")
    return f"{name}: {len(content):,} {_ELEMENTS[type(content)]}{beside} ({what})"


def _has_normals(path: str | PathLike[str]) -> bool:
    return set(NORMAL) <= set(ply_elements(path)["vertex"].dtype.names or ())
