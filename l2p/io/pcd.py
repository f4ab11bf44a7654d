"""PCD point clouds of the Point Cloud Library, by Open3D: ascii, binary and compressed."""

from __future__ import annotations

import re
from os import PathLike
from pathlib import Path

import numpy as np

from l2p.errors import InputError, warn
from l2p.io.colours import as_rgb
from l2p.io.open3d import load_open3d
from l2p.maps.scene import Scene

# Largest number of points that a byte of a compressed file may stand for.
_MOST_DENSE = 300


def read_pcd(path: str | PathLike[str]) -> Scene:
    """Read the points and colours of a PCD file; points that are not finite (nothing was measured) are left out.

    Raises
    ------
    InputError
        If it is damaged, has no x, y, z, or Open3D does not load.
    """
    size, points = Path(path).stat().st_size, _announced(path)
    if points > _MOST_DENSE * size:
        raise InputError(f"{path} is truncated or damaged: it announces {points} points in {size} bytes")
    _check_rows(path, points)
    open3d = load_open3d(otherwise="convert the file to PLY")
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.io.read_point_cloud(str(path), format="pcd", remove_nan_points=False)
    xyz = np.asarray(cloud.points, dtype=np.float64).reshape(-1, 3)
    if len(xyz) != points:
        raise InputError(f"{path} is truncated or damaged: it announces {points} points, of which {len(xyz)} are read")
    rgb = as_rgb(np.asarray(cloud.colors)) if cloud.has_colors() else None
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        warn(f"{path}: {int((~finite).sum())} of {len(xyz)} points are not finite; they are left out")
    return Scene(xyz[finite], None if rgb is None else rgb[finite])


def _announced(path: str | PathLike[str]) -> int:
    """Number of points in the header."""
    with open(path, "rb") as file:
        head = file.read(4096)
    found = re.search(rb"^POINTS\s+(\d{1,15})\s*$", head, re.MULTILINE)
    if found is None or re.search(rb"^DATA\s+\w", head, re.MULTILINE) is None:
        raise InputError(f"{path} is truncated or damaged: its header has no POINTS or no DATA; export it again")
    return int(found[1])


def _check_rows(path: str | PathLike[str], points: int) -> None:
    """Refuse text that ends too early: Open3D makes up the rest."""
    content = Path(path).read_bytes()
    begin = re.search(rb"^DATA\s+ascii\s*?\n", content[:4096], re.MULTILINE)
    if begin is None:
        return
    rows = [line for line in content[begin.end() :].split(b"\n") if line.strip()]
    if len(rows) < points or (rows and len(rows[-1].split()) != len(rows[0].split())):
        raise InputError(f"{path} is truncated or damaged: it announces {points} points, and ends with row {len(rows)}")
