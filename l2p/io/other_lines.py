"""Line clouds that other tools wrote as npz: points and directions, two points, Plücker coordinates, by usual names."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from os import PathLike

import numpy as np

from l2p.errors import InputError
from l2p.io.colours import as_rgb
from l2p.io.column_names import DIRECTION, END, MOMENT, POINT, Layout
from l2p.io.column_values import plucker_layout, recognised_layout
from l2p.io.npz import Fields, npz_keys
from l2p.io.table_files import lines_of_rows
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud

_POINTS = ("points", "point", "origins", "origin", "rays_o", "o", "p", "pts", "positions", "points3d", "xyz")
_DIRECTIONS = ("directions", "direction", "dirs", "dir", "rays_d", "d", "v", "vectors")
_MOMENTS = ("moments", "moment", "m")
_ENDS = (("start", "end"), ("starts", "ends"), ("start_points", "end_points"), ("p1", "p2"), ("p0", "p1"), ("a", "b"))
_PLUCKER = ("pluecker", "plucker", "plücker", "plucker_lines", "pluecker_lines", "plucker_coords", "pluecker_coords")
_LINES = ("lines", "line", "line_cloud", "segments", "endpoints")
_RGB = ("rgb", "colors", "colours", "color", "colour")
_DESCRIPTORS = ("descriptor", "descriptors", "desc", "descs")
#: Names of arrays, without regard to case, that make lines together, and what their columns hold; the first counts.
_READINGS: tuple[tuple[tuple[str, ...], tuple[str, ...] | None], ...] = (
    *(((point, direction), POINT + DIRECTION) for point in _POINTS for direction in _DIRECTIONS),
    *(((direction, moment), DIRECTION + MOMENT) for direction in _DIRECTIONS for moment in _MOMENTS),
    *((pair, POINT + END) for pair in _ENDS),
    *(((name,), DIRECTION + MOMENT) for name in _PLUCKER),
    *(((name,), None) for name in _LINES),
)
#: Names that may be anything beside the points of a scene.
_VAGUE = frozenset(("d", "v", "m"))


def holds_lines(keys: Collection[str]) -> bool:
    """Whether arrays of these names are a line cloud."""
    return _reading(keys) is not None


def missing(keys: Collection[str]) -> str:
    """Say of arrays that are nothing that l2p knows what is expected."""
    plain = {key.lower() for key in keys}
    half = ""
    for names, others in ((_POINTS, "directions"), (_DIRECTIONS, "points or moments"), (_MOMENTS, "directions")):
        half = half or next((f"{name} needs {others} beside it; " for name in names if name in plain), "")
    return (
        f"{half}expected direction and moment (a line cloud), normal and offset (planes), permuted (permuted points), "
        "xyz (a scene, a recovery, a truth), or lines of another tool: points and directions, start and end, lines "
        "(N, 6) or pluecker (N, 6); l2p.LineCloud.through(points, directions) makes lines in Python"
    )


def read_other_lines(path: str | PathLike[str]) -> LineCloud:
    """Read the line cloud of another tool, with colours, descriptors and scheme where they fit.

    Raises
    ------
    InputError
        If a shape or type does not fit, a line is invalid, or nothing tells what six columns hold.
    """
    keys = npz_keys(path)
    found = _reading(keys)
    if found is None:
        raise InputError(f"{path} holds {', '.join(sorted(keys))}; {missing(keys)}")
    names, holds = found
    fields = Fields(path, keys)
    rows, layout = _rows(fields, names, holds)
    lines = lines_of_rows(path, rows, layout, _appearance(fields, len(rows)))
    scheme = fields.take_optional_text("scheme")
    return lines if scheme is None else replace(lines, scheme=scheme)


def _reading(keys: Collection[str]) -> tuple[tuple[str, ...], tuple[str, ...] | None] | None:
    """Names of the arrays that make lines, as the file writes them, and what their columns hold."""
    plain = {key.lower(): key for key in keys}
    for names, holds in _READINGS:
        if set(names) <= set(plain) and not ("xyz" in plain and _VAGUE & set(names)):
            return tuple(plain[name] for name in names), holds
    return None


def _rows(fields: Fields, names: tuple[str, ...], holds: tuple[str, ...] | None) -> tuple[np.ndarray, Layout]:
    """Six numbers of each line, and what they are."""
    if len(names) == 2:
        first = fields.take(names[0], "fiu", (None, 3), np.float64)
        second = fields.take(names[1], "fiu", (len(first), 3), np.float64)
        return np.concatenate((first, second), axis=1), Layout(holds or ())
    name = names[0]
    if len(fields.shape(name)) == 3:  # (N, 2, 3)
        rows = fields.take(name, "fiu", (None, 2, 3), np.float64).reshape(-1, 6)
    else:
        rows = fields.take(name, "fiu", (None, 6), np.float64)
    where = f"{fields.path}: {name}"
    return rows, plucker_layout(where, rows) if holds else recognised_layout(where, rows)


def _appearance(fields: Fields, rows: int) -> Appearance:
    """Colours and descriptors that have a row for each line."""
    rgb = next((fields.take(key, "fiu", (rows, 3)) for key in _fitting(fields, _RGB, (rows, 3))), None)
    descriptor = next((fields.take(key, "fiu", (rows, None)) for key in _fitting(fields, _DESCRIPTORS, (rows,))), None)
    kind = None if descriptor is None else fields.take_optional_text("descriptor_kind")
    return Appearance(None if rgb is None else as_rgb(rgb), descriptor, kind)


def _fitting(fields: Fields, names: Collection[str], shape: tuple[int, ...]) -> list[str]:
    """Arrays of one of the names whose shape begins so."""
    return [key for key in fields.names if key.lower() in names and fields.shape(key)[: len(shape)] == shape]
