"""Points as text, for spreadsheets, NumPy and programs that read neither npz nor PLY."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, UInt8

#: Endings: bare coordinates, as viewers expect of ``.xyz``; columns below a heading that ``numpy.loadtxt`` skips; CSV.
ENDINGS = (".xyz", ".txt", ".csv")


def text_bytes(
    ending: str,
    xyz: Float[np.ndarray, "points 3"],
    rgb: UInt8[np.ndarray, "points 3"] | None = None,
    confidence: Float[np.ndarray, " points"] | None = None,
) -> bytes:
    """Encode points, one a line, by the ending of their file; coordinates are read back equal to the bit.

    ``.xyz`` holds nothing but x, y and z: programs take a fourth to sixth column for a normal.

    >>> text_bytes(".csv", np.array([[0.1, 2.0, 3.0]]), confidence=np.array([0.75], dtype=np.float32))
    b'x,y,z,confidence\\n0.1,2.0,3.0,0.75\\n'
    """
    columns: list[Iterable[str]] = [map(repr, xyz[:, axis].tolist()) for axis in range(3)]
    names = ["x", "y", "z"]
    if rgb is not None and ending != ".xyz":
        columns += [map(str, rgb[:, channel].tolist()) for channel in range(3)]
        names += ["red", "green", "blue"]
    if confidence is not None and ending != ".xyz":
        columns.append(f"{value:.6g}" for value in confidence.tolist())
        names.append("confidence")
    between = "," if ending == ".csv" else " "
    heading = {".xyz": "", ".txt": f"# {between.join(names)}\n", ".csv": f"{between.join(names)}\n"}[ending]
    return (heading + "".join(between.join(row) + "\n" for row in zip(*columns, strict=True))).encode("ascii")
