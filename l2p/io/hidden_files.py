"""Files of hidden maps, whatever a scheme publishes: line clouds, and the npz of planes and of permuted points."""

from __future__ import annotations

from collections.abc import Collection
from os import PathLike
from typing import Any

import numpy as np

from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.io.endings import checked_ending
from l2p.io.kinds import LINE_CLOUDS, Kind, kind_of
from l2p.io.line_files import appearance_arrays, line_ending, load_lines, not_hidden, save_lines
from l2p.io.npz import Fields, npz_bytes
from l2p.maps.lines import LineCloud
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud

#: Version of written npz files of planes and of permuted points.
VERSION = 1

#: Published attributes that a file of planes or permuted points can hold, by its ending.
_HELD: dict[str, tuple[str, ...]] = {".npz": ("rgb", "descriptor")}


def load_hidden(path: str | PathLike[str], columns: str | None = None) -> LineCloud | PlaneCloud | PermutedCloud:
    """Read a hidden map of any type; the content of the file decides which.

    Parameters
    ----------
    path : path
    columns : str, optional
        What the columns of a text or npy file hold (:func:`l2p.io.line_files.load_lines`).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is damaged or holds no hidden map; the message names the file.
    """
    kind = kind_of(path, columns)
    if kind is Kind.PLANES:
        return load_planes(path)
    if kind is Kind.PERMUTED:
        return load_permuted(path)
    if kind not in LINE_CLOUDS:
        raise InputError(f"{path} {not_hidden(path, kind, columns)}")
    return load_lines(path, columns)


def load_planes(path: str | PathLike[str]) -> PlaneCloud:
    """Read the npz of a plane cloud; errors as :func:`load_hidden`."""
    fields = _fields(path, Kind.PLANES, ("normal", "offset"))
    normal = fields.take("normal", "fiu", (None, 3))
    rows = len(normal)
    offset = fields.take("offset", "fiu", (rows,))
    return _made(fields, rows, PlaneCloud, normal, offset)


def load_permuted(path: str | PathLike[str]) -> PermutedCloud:
    """Read the npz of permuted points; errors as :func:`load_hidden`."""
    fields = _fields(path, Kind.PERMUTED, ("permuted",))
    stored = fields.take("permuted", "fiu", (None, 3))
    return _made(fields, len(stored), PermutedCloud, stored)


def save_hidden(
    hidden: LineCloud | PlaneCloud | PermutedCloud, path: str | PathLike[str], *, overwrite: bool = False
) -> None:
    """Write a hidden map: lines as :func:`l2p.io.line_files.save_lines`, planes and permuted points as npz.

    Raises
    ------
    InputError
        If ``path`` does not end with an ending of such files, or must not be written.
    """
    if isinstance(hidden, LineCloud):
        save_lines(hidden, path, overwrite=overwrite)
        return
    hidden_ending(path, type(hidden))
    if isinstance(hidden, PlaneCloud):
        own = {"normal": hidden.normal, "offset": hidden.offset}
    else:
        own = {"permuted": hidden.xyz}
    about = {"scheme": np.array(hidden.scheme), "version": np.array(VERSION)}
    content = npz_bytes({**own, **appearance_arrays(hidden.appearance), **about})
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(content)


def hidden_ending(path: str | PathLike[str], published: type[Any], attributes: Collection[str] = ()) -> str:
    """Return the ending of a hidden map to write.

    Parameters
    ----------
    path : path
    published : type
        ``LineCloud``, ``PlaneCloud`` or ``PermutedCloud``.
    attributes : collection of str
        Published attributes.

    Raises
    ------
    InputError
        If l2p does not write such files, or they cannot hold one of the attributes.
    """
    if published is LineCloud:
        return line_ending(path, attributes)
    what = "a plane cloud" if published is PlaneCloud else "permuted points"
    return checked_ending(path, what, _HELD, attributes)


def _fields(path: str | PathLike[str], kind: Kind, names: tuple[str, ...]) -> Fields:
    """Fields of a file of this kind and of a version that can be read."""
    got = kind_of(path)
    if got is not kind:
        raise InputError(f"{path} is {got.value}; expected {kind.value} (make one with l2p lift --scheme)")
    fields = Fields(path, (*names, "rgb", "descriptor", "descriptor_kind", "scheme", "version"))
    fields.take_version(VERSION)
    return fields


def _made(fields: Fields, rows: int, kind: type[Any], *own: np.ndarray) -> Any:
    """A map of these rows with its appearance; errors name the file."""
    if rows == 0:
        raise InputError(f"{fields.path} is empty; expected at least one point")
    rgb, scheme = fields.take_rgb(rows), fields.take_text("scheme")
    try:
        return kind(*own, rgb, scheme, *fields.take_descriptor(rows))
    except InputError as error:
        raise error if str(fields.path) in str(error) else InputError(f"{fields.path}: {error}") from error
