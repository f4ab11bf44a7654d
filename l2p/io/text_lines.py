"""Lines as text: the records of an OBJ."""

from __future__ import annotations

from os import PathLike

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.io.text_tables import shown


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
            raise InputError(f"{path} line {number}: got {shown(words)}; expected {expected}") from error
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), np.array(ends, dtype=np.int64).reshape(-1, 2)


def _records(path: str | PathLike[str]) -> list[tuple[int, list[str]]]:
    """Number (from 1) and words of each line that is not empty."""
    with open(path, "rb") as file:
        try:
            text = file.read().decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(f"{path} is neither npz, PLY, OBJ nor text; expected one of these") from error
    lines = (line.split("#", 1)[0].split() for line in text.split("\n"))
    return [(number, words) for number, words in enumerate(lines, start=1) if words]


def _vertex(word: str, count: int) -> int:
    """Index from 0 of an OBJ vertex such as ``3``, ``-1`` or ``3/2``."""
    index = int(word.split("/", 1)[0])
    if index == 0 or not -count <= index < 2**63:
        raise ValueError(f"no vertex {index}")
    # A vertex may come after the line that names it, so indices above ``count`` are checked later.
    return index - 1 if index > 0 else count + index
