"""Point clouds as text: .xyz, .xyzrgb, .xyzn, .pts, .asc, with colours where they can be told."""

from __future__ import annotations

import io
import warnings
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from l2p.errors import InputError
from l2p.io.colours import as_rgb
from l2p.maps.scene import Scene

_PLACE = (("x", "y", "z"),)
_COLOUR = (("r", "g", "b"), ("red", "green", "blue"))
# Largest difference from 1 of the lengths of normals, as texts round them.
_UNIT = 0.02


def read_xyz(path: str | PathLike[str]) -> Scene:
    """Read rows of x y z, and what may follow them: an intensity, colours, normals.

    Separators are blanks, commas or semicolons. Comments (``#``, ``//``) and one row of names are skipped, as are
    counts of points on lines of their own (.pts). Columns of colours are found by their names, else by their numbers:
    three neighbouring columns of integers of 0 to 255, or, in fourth to sixth place, of shares up to 1 that are no unit
    vectors. All other columns are ignored.

    Raises
    ------
    InputError
        For the first line that is no point, or if the file ends before the number of points that it announces.
    """
    content = Path(path).read_bytes().removeprefix(b"\xef\xbb\xbf").translate(bytes.maketrans(b",;\t", b"   "))
    lines = [
        line
        for line in content.split(b"\n")
        # Counts are single words.
        if len(line.split(None, 1)) > 1 and not line.lstrip().startswith((b"#", b"//"))
    ]
    names = _names(content)
    if lines and not any(_is_number(word) for word in _words(lines[0])):
        lines = lines[1:]
    table = _table(path, content, lines)
    if table.shape[1] < 3:
        raise InputError(f"{path} has {table.shape[1]} columns; expected x, y, z, and perhaps colours or normals")
    _check_count(path, content, len(table))
    place = _columns(names, _PLACE, table.shape[1]) or [0, 1, 2]
    colour = _columns(names, _COLOUR, table.shape[1])
    rgb = as_rgb(table[:, colour]) if colour else _found_rgb(table[:, 3:], Path(path).suffix.lower() == ".xyzrgb")
    return Scene(table[:, place], rgb)


def _names(content: bytes) -> list[str]:
    """Names of the columns, in lower case, from the first line that is not empty, which may be a comment, or none."""
    first = next((line for line in content.split(b"\n", 20) if line.strip()), b"")
    words = _words(first.lstrip(b"#/ "))
    return words if {"x", "y", "z"} <= set(words) else []


def _words(line: bytes) -> list[str]:
    return line.decode("utf-8", errors="replace").lower().split()


def _table(path: str | PathLike[str], content: bytes, lines: list[bytes]) -> Float[np.ndarray, "points columns"]:
    """All numbers; InputError with the number of the first line that has others, or more or fewer."""
    if not lines:
        return np.zeros((0, 3))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.loadtxt(io.BytesIO(b"\n".join(lines)), dtype=np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise _first_wrong(path, content, len(lines[0].split())) from error


def _first_wrong(path: str | PathLike[str], content: bytes, columns: int) -> InputError:
    for number, line in enumerate(content.split(b"\n"), start=1):
        words = line.decode("utf-8", errors="replace").split()
        if len(words) < 2 or words[0].startswith(("#", "//")):
            continue
        if len(words) != columns or not all(map(_is_number, words)):
            shown = repr(" ".join(words)[:60])
            return InputError(f"{path} line {number}: got {shown}; expected {columns} numbers, as in the first row")
    return InputError(f"{path} is no text of points; expected rows of x, y, z")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _check_count(path: str | PathLike[str], content: bytes, rows: int) -> None:
    """Refuse a file with fewer points than its first line announces."""
    first = content[:40].split(b"\n", 1)[0].strip()
    if first.isdigit() and int(first) > rows:
        raise InputError(f"{path} is truncated: it announces {int(first)} points, and has {rows}")


def _columns(names: list[str], wanted: tuple[tuple[str, ...], ...], width: int) -> list[int]:
    """Places of the first group of names that are all there."""
    for group in wanted:
        if len(names) == width and all(name in names for name in group):
            return [names.index(name) for name in group]
    return []


def _found_rgb(rest: Float[np.ndarray, "points columns"], surely: bool) -> UInt8[np.ndarray, "points 3"] | None:
    """Colours among the columns after the place, by their numbers."""
    if surely and rest.shape[1] >= 3:
        return as_rgb(rest[:, :3])
    byte = np.asarray(np.isin(rest, np.arange(256)).all(axis=0) & bool(len(rest)))
    width = rest.shape[1]
    # Beside x y z: r g b; i r g b; nx ny nz r g b.
    for start in dict.fromkeys((0, width - 3, *range(width - 2))):
        group = slice(start, start + 3)
        if start >= 0 and byte[group].sum() == 3 and rest[:, group].max() > 1:
            return rest[:, group].astype(np.uint8)
    share = rest[:, :3]
    if width >= 3 and len(rest) and share.min() >= 0 and share.max() <= 1:
        unit = np.abs(np.linalg.norm(share, axis=1) - 1) < _UNIT
        return None if unit.mean() > 0.9 else as_rgb(share)
    return None
