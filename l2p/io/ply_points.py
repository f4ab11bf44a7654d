"""Points of PLY files, with their colours."""

from __future__ import annotations

from os import PathLike

import numpy as np

from l2p.errors import InputError
from l2p.io.ply import ply_columns, ply_elements, ply_rgb
from l2p.maps.scene import Scene


def read_ply(path: str | PathLike[str]) -> Scene:
    """Read the vertices of a PLY file as a scene, with their colours; edges and faces do not matter."""
    vertex = ply_elements(path).get("vertex")
    if vertex is None:
        raise InputError(f"{path} has no vertices; expected an element vertex with x, y, z")
    return Scene(ply_columns(path, vertex, ("x", "y", "z")).astype(np.float64), ply_rgb(vertex))
