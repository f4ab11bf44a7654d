"""Points or lines as rows of numbers: their columns are told by names, by ``--columns`` or by the numbers."""

from __future__ import annotations

import os
from functools import lru_cache
from os import PathLike

import numpy as np
from jaxtyping import Float, UInt8

from l2p.errors import InputError
from l2p.io.colours import as_rgb
from l2p.io.column_names import (
    DIRECTION,
    END,
    END_W,
    MOMENT,
    NORMAL,
    POINT,
    POINT_W,
    RGB,
    Layout,
    asked_layout,
    named_layout,
)
from l2p.io.column_values import recognised_layout
from l2p.io.text_tables import Table, read_table
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud

#: Scheme of lines from other programs, which do not state how their directions were drawn.
FOREIGN_SCHEME = "unknown"


def table_layout(path: str | PathLike[str], columns: str | None = None) -> Layout:
    """Tell what the columns of a text or npy file hold.

    Parameters
    ----------
    columns : str, optional
        Names in the order of the columns, comma separated (``--columns``).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is malformed, ``columns`` does not fit, or nothing decides.
    """
    about = os.stat(path)
    return _layout(os.fspath(path), columns, about.st_mtime_ns, about.st_size)


@lru_cache(maxsize=64)
def _layout(path: str, columns: str | None, _changed: int, _size: int) -> Layout:
    return _layout_of(path, read_table(path), columns)


def _layout_of(path: str | PathLike[str], table: Table, columns: str | None) -> Layout:
    if columns is not None:
        asked, count = asked_layout(columns), table.values.shape[1]
        if len(asked.columns) != count:
            raise InputError(
                f"got --columns {columns} for {path}, which has {count} columns; expected a name for each, - for one "
                "that is not used"
            )
        return asked
    named = (layout for names in table.headers if (layout := named_layout(names)) is not None)
    return next(named, None) or _by_ending(path, table) or recognised_layout(str(path), table.values)


def _by_ending(path: str | PathLike[str], table: Table) -> Layout | None:
    """Layout of Open3D's endings, which say it."""
    group = {".xyzn": NORMAL, ".xyzrgb": RGB}.get(os.path.splitext(path)[1].lower())
    if group is None or table.values.shape[1] != 6:
        return None
    return Layout((*POINT, *group), "by the ending of the file")


def points_of_table(
    path: str | PathLike[str], columns: str | None = None
) -> tuple[Float[np.ndarray, "points 3"], UInt8[np.ndarray, "points 3"] | None]:
    """Read points, and their colours if there are any; InputError if the rows are lines, or as :func:`table_layout`."""
    table, layout = read_table(path), table_layout(path, columns)
    if layout.are_lines:
        raise InputError(f"{path} holds {layout.content} ({layout.words}); expected points")
    return _places(path, table.values, layout, POINT, POINT_W), _rgb(path, table.values, layout)


def lines_of_table(path: str | PathLike[str], columns: str | None = None) -> LineCloud:
    """Read lines, with their colours; InputError if the rows are points, or as :func:`table_layout`."""
    table, layout = read_table(path), table_layout(path, columns)
    return lines_of_rows(path, table.values, layout, Appearance(_rgb(path, table.values, layout)))


def lines_of_rows(
    path: str | PathLike[str], values: Float[np.ndarray, "rows columns"], layout: Layout, appearance: Appearance
) -> LineCloud:
    """Make lines of rows of numbers.

    Raises
    ------
    InputError
        If the rows are points, or a line is invalid.
    """
    if not layout.are_lines:
        raise InputError(f"{path} {no_lines(path, layout)}")
    if layout.has(POINT):
        point = _places(path, values, layout, POINT, POINT_W)
        if layout.has(DIRECTION):
            return LineCloud.through(point, _taken(values, layout, DIRECTION), appearance, FOREIGN_SCHEME)
        # Half of each end: so the difference of two finite numbers is finite.
        half = _places(path, values, layout, END, END_W) / 2 - point / 2
        return LineCloud.through(point, half, appearance, FOREIGN_SCHEME)
    return line_of_moments(_taken(values, layout, DIRECTION), _taken(values, layout, MOMENT), appearance)


def line_of_moments(
    direction: Float[np.ndarray, "lines 3"], moment: Float[np.ndarray, "lines 3"], appearance: Appearance
) -> LineCloud:
    """Make lines of Plücker coordinates of any scale, up to rounding; InputError if they are not perpendicular."""
    square = np.sum(direction**2, axis=1, keepdims=True)
    along = np.abs(np.sum(direction * moment, axis=1))
    skew = along > 0.02 * np.linalg.norm(direction, axis=1) * np.linalg.norm(moment, axis=1)
    if skew.any():
        raise InputError(
            f"got {int(skew.sum())} of {len(skew)} lines whose moment is not perpendicular to the direction, first "
            f"line {int(np.argmax(skew))}; expected the moment p x d of a point p on the line"
        )
    foot = np.cross(direction, moment) / np.where(square > 0, square, 1.0)
    return LineCloud.through(foot, direction, appearance, FOREIGN_SCHEME)


def no_lines(path: str | PathLike[str], layout: Layout) -> str:
    """Say of points that lines were expected, and what to do, as the end of a sentence."""
    return (
        f"holds {layout.content} ({layout.words}), not lines; hide the points first with l2p lift {path}, or, if they "
        "are lines, say so with --columns x,y,z,dx,dy,dz"
    )


def _taken(values: np.ndarray, layout: Layout, group: tuple[str, ...]) -> Float[np.ndarray, "rows 3"]:
    return values[:, [layout.columns.index(name) for name in group]]


def _places(
    path: str | PathLike[str], values: np.ndarray, layout: Layout, group: tuple[str, ...], fourth: str
) -> Float[np.ndarray, "rows 3"]:
    """Points, of homogeneous coordinates if there is a fourth number."""
    xyz = _taken(values, layout, group)
    if fourth not in layout.columns:
        return xyz
    scale = values[:, [layout.columns.index(fourth)]]
    if (scale == 0).any():
        row = int(np.argmax(scale == 0))
        raise InputError(f"{path} has a point with w = 0 in row {row}; expected no points at infinity")
    return xyz / scale


def _rgb(path: str | PathLike[str], values: np.ndarray, layout: Layout) -> UInt8[np.ndarray, "rows 3"] | None:
    """Colours of 8 or 16 bits, or from 0 to 1, as 8 bits; InputError if they are none of these."""
    if not layout.has(RGB):
        return None
    colours = _taken(values, layout, RGB)
    rgb = as_rgb(colours)
    if rgb is None:
        low, high = colours.min(), colours.max()
        raise InputError(f"{path} has colours from {low:g} to {high:g}; expected 0 to 255, 0 to 1 or 0 to 65535")
    return rgb
