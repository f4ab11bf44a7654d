"""Ray cloud by voxels: lines to two centres, which alternate from cell to cell (Moon et al., CVPR 2024)."""

from __future__ import annotations

import numbers

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.truth import Hiding
from l2p.schemes.centers import lines_to_centers, moved_points, two_centers

#: Side of a cell in a map of unknown unit, as a share of the largest side of the box of its middle points: the
#: authors' half metre in a room of ten metres.
_SHARE = 0.05
#: Percentiles of the coordinates between which the middle points lie.
_MIDDLE = (1, 99)


class RaysVoxel:
    """Scheme with one line per point, through one of two centres; the cell of the point decides which.

    Space is cut into cubes, from half a cube below the least coordinates, and the centre of a point in cube (i, j, k)
    has the number (i + j + k) mod 2. Neighbours then mostly have the same centre. By design the map tells the centres,
    and whoever guesses the grid knows that a point lies in every other cube along its ray.

    Parameters
    ----------
    cell : float, optional
        Side of a cube in scene units; the authors take 0.5 m. Default: a twentieth of the map's largest side, from the
        1st to the 99th percentile of its coordinates.
    """

    name = "rays-voxel"
    answers = 1

    def __init__(self, cell: float | None = None) -> None:
        if cell is not None and not (isinstance(cell, numbers.Real) and 0 < cell < np.inf):
            raise InputError(f"got cell {cell}; expected the side of a cube in scene units, above 0")
        self.cell = cell

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Find the cell of each point; InputError if all points are the same."""
        moved = moved_points(points, chosen, rng)
        centers = two_centers(moved, rng)
        own = centers[parity(moved, self.cell or cell_of(moved))]
        return lines_to_centers(points, chosen, moved, own, rng, appearance, self.name)


def cell_of(points: Float[np.ndarray, "points 3"]) -> float:
    """Side of the cells in a map of unknown unit."""
    low, high = np.percentile(points, _MIDDLE, axis=0)
    # Of points that are mostly at one place, the whole extent counts.
    return _SHARE * float((high - low).max() or np.ptp(points, axis=0).max())


def parity(points: Float[np.ndarray, "points 3"], cell: float) -> Int[np.ndarray, " points"]:
    """Number of the centre of each point, 0 or 1."""
    index = np.floor((points - points.min(axis=0)) / cell + 0.5)
    return (np.sum(index % 2, axis=1) % 2).astype(np.int64)
