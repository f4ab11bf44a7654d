"""Files of line clouds: the npz of ``docs/formats.md``, PLY and OBJ line sets, rows of numbers, other tools' npz."""

from __future__ import annotations

import io
from collections.abc import Collection
from functools import partial
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.io.endings import checked_ending
from l2p.io.kinds import LINE_CLOUDS, SCENES, TABLES, Kind, kind_of
from l2p.io.npz import Fields, npz_bytes
from l2p.io.other_lines import read_other_lines
from l2p.io.ply import ply_bytes, ply_columns, ply_elements, ply_rgb
from l2p.io.table_files import FOREIGN_SCHEME, lines_of_table, no_lines, table_layout
from l2p.io.text_lines import read_obj_segments
from l2p.maps.appearance import NO_APPEARANCE, Appearance
from l2p.maps.lines import LineCloud

#: Version of written npz line clouds; older ones stay readable.
LINE_VERSION = 1

#: Published attributes that a file can hold beside the lines, by its ending; a row of a line set has no room for a
#: descriptor that other programs would read.
HELD: dict[str, tuple[str, ...]] = {".npz": ("rgb", "descriptor"), ".ply": ("rgb",), ".obj": ()}

#: Half the length of a drawn line, in units of the median distance of the lines from their centre.
HALF_LENGTH = 3.0


def load_lines(path: str | PathLike[str], columns: str | None = None) -> LineCloud:
    """Read a line cloud, whatever the file name: npz, PLY or OBJ line set, rows of numbers (text, npy).

    Parameters
    ----------
    path : path
    columns : str, optional
        What the columns of a text or npy file hold, such as ``x,y,z,dx,dy,dz``; by default its header or its numbers
        tell it.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is damaged, of another kind, or its lines are invalid; the message names the file.
    """
    kind = kind_of(path, columns)
    if kind not in LINE_CLOUDS:
        raise InputError(f"{path} {not_hidden(path, kind, columns)}")
    readers = {
        Kind.LINES_NPZ: _read_npz,
        Kind.LINES_PLY: _read_ply,
        Kind.LINES_OBJ: _read_obj,
        Kind.LINES_TEXT: partial(lines_of_table, columns=columns),
        Kind.LINES_ARRAY: partial(lines_of_table, columns=columns),
        Kind.LINES_FOREIGN: read_other_lines,
    }
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # overflows are refused as not finite
            cloud = readers[kind](path)
    except InputError as error:
        # Errors of LineCloud do not name the file; all others do.
        raise error if str(path) in str(error) else InputError(f"{path}: {error}") from error
    if len(cloud) == 0:
        raise InputError(f"{path} has no lines; expected at least one")
    return cloud


def not_hidden(path: str | PathLike[str], kind: Kind, columns: str | None = None) -> str:
    """Say that a file of this kind holds no line cloud or other hidden map, as the end of a sentence."""
    if kind in TABLES:
        return no_lines(path, table_layout(path, columns))
    made = f"hide the points first with l2p lift {path}" if kind in SCENES else "make one with l2p lift"
    return f"is {kind.value}; expected a line cloud or another hidden map: {made}"


def save_lines(cloud: LineCloud, path: str | PathLike[str], *, overwrite: bool = False) -> None:
    """Write a line cloud as npz, or as PLY or OBJ line set to look at, by the ending of ``path``.

    A PLY holds no descriptors, an OBJ neither these nor colours: they are left out.
    The lines are written unchanged, in their order: only :func:`l2p.lift` hides which point is behind which line.
    """
    writers = {".npz": _npz_bytes, ".ply": _ply_bytes, ".obj": _obj_bytes}
    ending = line_ending(path)
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(writers[ending](cloud))


def line_ending(path: str | PathLike[str], attributes: Collection[str] = ()) -> str:
    """Return the ending of a line cloud to write.

    Raises
    ------
    InputError
        If l2p does not write such files, or they cannot hold one of the published ``attributes``.
    """
    return checked_ending(path, "a line cloud", HELD, attributes)


def segments(cloud: LineCloud) -> tuple[Float[np.ndarray, "lines 3"], Float[np.ndarray, "lines 3"]]:
    """Return both ends of the drawn segment of each line, in scene units.

    Segments are centred at the foot of the perpendicular from the centre of the lines
    (:class:`l2p.geometry.frame.Frame`) and equally long. Both follow from the lines alone and reveal nothing else.
    """
    from l2p.geometry.frame import Frame

    frame = Frame.of(cloud)
    middle = cloud.origin + np.sum((frame.center - cloud.origin) * cloud.direction, axis=1)[:, None] * cloud.direction
    half = HALF_LENGTH * frame.unit * cloud.direction
    return middle - half, middle + half


def _read_npz(path: str | PathLike[str]) -> LineCloud:
    seconds = ("second_rgb", "second_descriptor")
    fields = Fields(
        path, ("direction", "moment", "rgb", "descriptor", "descriptor_kind", *seconds, "scheme", "version")
    )
    fields.take_version(LINE_VERSION)
    direction = fields.take("direction", "fiu", (None, 3))
    moment = fields.take("moment", "fiu", (len(direction), 3))
    rows = len(direction)
    rgb, scheme = fields.take_rgb(rows), fields.take_text("scheme")
    second = Appearance(fields.take_rgb(rows, seconds[0]), *fields.take_descriptor(rows, seconds[1]))
    return LineCloud(direction, moment, rgb, scheme, *fields.take_descriptor(rows), second if second.names else None)


def _npz_bytes(cloud: LineCloud) -> bytes:
    second = NO_APPEARANCE if cloud.second is None else cloud.second
    return npz_bytes(
        {
            "direction": cloud.direction,
            "moment": cloud.moment,
            **appearance_arrays(cloud.appearance),
            "second_rgb": _plain(second.rgb),
            "second_descriptor": _plain(second.descriptor),
            "scheme": np.array(cloud.scheme),
            "version": np.array(LINE_VERSION),
        }
    )


def appearance_arrays(appearance: Appearance) -> dict[str, Any]:
    """The arrays of an npz that hold colours and descriptors; None for those that are not there."""
    kind = appearance.descriptor_kind
    return {
        "rgb": _plain(appearance.rgb),
        "descriptor": _plain(appearance.descriptor),
        "descriptor_kind": None if kind is None else np.array(kind),
    }


def _plain(array: np.ndarray | None) -> Any:
    """The array in the memory order of C: the header of npy would tell another order, and so where it came from."""
    return None if array is None else np.ascontiguousarray(array)


def _read_ply(path: str | PathLike[str]) -> LineCloud:
    elements = ply_elements(path)
    vertex, edge = elements.get("vertex"), elements["edge"]
    if vertex is None:
        raise InputError(f"{path} has edges but no vertices; expected both")
    ends = ply_columns(path, edge, ("vertex1", "vertex2"))
    if not np.issubdtype(ends.dtype, np.integer):
        raise InputError(f"{path} has vertex1 and vertex2 of type {ends.dtype}; expected integers")
    return _through_segments(path, ply_columns(path, vertex, ("x", "y", "z")), ends.astype(np.int64), ply_rgb(edge))


def _read_obj(path: str | PathLike[str]) -> LineCloud:
    return _through_segments(path, *read_obj_segments(path), None)


def _through_segments(
    path: str | PathLike[str], vertex: np.ndarray, ends: Int[np.ndarray, "lines 2"], rgb: np.ndarray | None
) -> LineCloud:
    outside = (ends < 0) | (ends >= len(vertex))
    if len(ends) and not len(vertex):
        raise InputError(f"{path} has lines and no vertices; expected both")
    if outside.any():
        wrong = int(ends[outside][0])
        raise InputError(f"{path} has a line to vertex {wrong}; expected 0 to {len(vertex) - 1}, counted from 0")
    start, stop = vertex[ends[:, 0]].astype(np.float64), vertex[ends[:, 1]].astype(np.float64)
    # Half of each end: so the difference of two finite numbers is finite.
    return LineCloud.through(start, stop / 2 - start / 2, Appearance(rgb), FOREIGN_SCHEME)


def _ply_bytes(cloud: LineCloud) -> bytes:
    start, stop = segments(cloud)
    vertex = np.empty(2 * len(cloud), dtype=[("x", "<f8"), ("y", "<f8"), ("z", "<f8")])
    for axis, name in enumerate("xyz"):
        vertex[name][0::2], vertex[name][1::2] = start[:, axis], stop[:, axis]
    colour = [] if cloud.rgb is None else [(name, "u1") for name in ("red", "green", "blue")]
    edge = np.empty(len(cloud), dtype=[("vertex1", "<i4"), ("vertex2", "<i4"), *colour])
    edge["vertex1"], edge["vertex2"] = np.arange(0, 2 * len(cloud), 2), np.arange(1, 2 * len(cloud), 2)
    for channel, (name, _) in enumerate(colour):
        edge[name] = cloud.rgb[:, channel]  # type: ignore[index]
    return ply_bytes({"vertex": vertex, "edge": edge})


def _obj_bytes(cloud: LineCloud) -> bytes:
    start, stop = segments(cloud)
    text = io.StringIO()
    np.savetxt(text, np.stack([start, stop], axis=1).reshape(-1, 3), fmt="v %.17g %.17g %.17g")
    number = np.arange(1, 2 * len(cloud) + 1).reshape(-1, 2)
    np.savetxt(text, number, fmt="l %d %d")
    return text.getvalue().encode("ascii")
