"""The points behind a line cloud, kept apart from it to judge an attack."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class Truth:
    """The points behind the lines of a line cloud, kept apart from it to judge an attack.

    Attributes
    ----------
    xyz : (lines, 3) float64
        The point behind each line, in the order of the lines, scene units.
    index : (lines,) int64
        Row of the point in the scene that was lifted.
    spacing : float
        Median distance to the 50th neighbour in the whole scene, also when only a fraction was lifted; scene units.
    ids : (lines,) int64 or None
        Identifiers of the source (COLMAP ``point3D_id``).
    seed : int or None
        Seed of the lifting, where one was given.
    """

    xyz: Float[np.ndarray, "lines 3"]
    index: Int[np.ndarray, " lines"]
    spacing: float
    ids: Int[np.ndarray, " lines"] | None = None
    seed: int | None = None

    def __len__(self) -> int:
        return len(self.xyz)
