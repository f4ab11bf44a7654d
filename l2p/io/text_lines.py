"""Lines as text: OBJ records, and rows of point + direction."""

from __future__ import annotations

from os import PathLike

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError


def read_obj_segments(
    path: str | PathLike[str],
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "lines 2"]]:
    """Read vertices (``v x y z``, colours ignored) and the vertex rows (from 0) of each line (``l i j``).

    Negative indices count back from the last vertex, as in the format; all records but ``v`` and ``l`` are ignored.
    Rows may be beyond the last vertex: the caller checks that.

    Raises
    ------
    InputError
        For the first record that is malformed.
    """
    vertices: list[list[float]] = []
    ends: list[tuple[int, int]] = []
    for number, words in _records(path):
        try:
            if words[0] == "v":
                vertices.append([float(words[1]), float(words[2]), float(words[3])])
            elif words[0] == "l":
                start, stop = words[1:]
                ends.append((_vertex(start, len(vertices)), _vertex(stop, len(vertices))))
        except (ValueError, IndexError) as error:
            expected = "three numbers after v" if words[0] == "v" else "exactly two vertices after l"
            raise InputError(f"{path} line {number}: got {_shown(words)}; expected {expected}") from error
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), np.array(ends, dtype=np.int64).reshape(-1, 2)


def read_text_rows(path: str | PathLike[str]) -> Float[np.ndarray, "lines 6"]:
    """Read rows of x y z dx dy dz; InputError for the first row that is malformed.

    Separators are blanks, commas or semicolons; ``#`` comments and one header row are skipped.
    """
    rows: list[list[float]] = []
    header_allowed = True
    for number, words in _records(path):
        values = [_number(word) for word in words]
        if header_allowed and all(value is None for value in values):
            header_allowed = False
            continue
        header_allowed = False
        if len(values) != 6 or None in values:
            expected = "six numbers, a point and a direction"
            raise InputError(f"{path} line {number}: got {_shown(words)}; expected {expected}")
        rows.append(values)  # type: ignore[arg-type]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def _records(path: str | PathLike[str]) -> list[tuple[int, list[str]]]:
    """Number (from 1) and words of each line that is not empty."""
    with open(path, "rb") as file:
        try:
            text = file.read().decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(f"{path} is neither npz, PLY, OBJ nor text; expected one of these") from error
    lines = (line.split("#", 1)[0].replace(",", " ").replace(";", " ").split() for line in text.split("\n"))
    return [(number, words) for number, words in enumerate(lines, start=1) if words]


def _vertex(word: str, count: int) -> int:
    """Index from 0 of an OBJ vertex such as ``3``, ``-1`` or ``3/2``."""
    index = int(word.split("/", 1)[0])
    if index == 0 or not -count <= index < 2**63:
        raise ValueError(f"no vertex {index}")
    # A vertex may come after the line that names it, so indices above ``count`` are checked later.
    return index - 1 if index > 0 else count + index


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None


def _shown(words: list[str]) -> str:
    line = " ".join(words)
    return repr(line if len(line) <= 60 else line[:57] + "...")
