"""Regions of a map that are left out of a release: boxes, and the rows that stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.errors import InputError

#: Position, scene units.
Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A box whose sides are parallel to the axes of the scene; its sides belong to it.

    Attributes
    ----------
    low, high : (x, y, z)
        Two opposite corners, scene units, in any order when the box is made; then the least and the greatest
        coordinates. They may be infinite.

    Raises
    ------
    InputError
        If a coordinate is NaN, or a corner has not three.
    """

    low: Corner
    high: Corner

    def __post_init__(self) -> None:
        corners = np.array([*self.low, *self.high], dtype=np.float64)
        if len(self.low) != 3 or len(self.high) != 3 or np.isnan(corners).any():
            raise InputError(f"got a box from {self.low} to {self.high}; expected two corners x y z that are numbers")
        one, other = corners.reshape(2, 3)
        object.__setattr__(self, "low", tuple(np.minimum(one, other).tolist()))
        object.__setattr__(self, "high", tuple(np.maximum(one, other).tolist()))

    @classmethod
    def of(cls, numbers: Sequence[float]) -> Box:
        """Make a box of six numbers ``x0 y0 z0 x1 y1 z1``, scene units; InputError if they are not six."""
        values = [float(number) for number in numbers]
        if len(values) != 6:
            raise InputError(f"got {len(values)} numbers for a box; expected six, x0 y0 z0 x1 y1 z1")
        return cls((values[0], values[1], values[2]), (values[3], values[4], values[5]))

    def contains(self, xyz: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
        """Mask of the points in the box or on a side of it."""
        return np.all((xyz >= np.array(self.low)) & (xyz <= np.array(self.high)), axis=1)


def kept_rows(drop: object, points: int) -> Int[np.ndarray, " kept"]:
    """Rows that stay when the points that ``drop`` marks are left out.

    Parameters
    ----------
    drop : (points,) bool
        True for each point to leave out.
    points : int
        Number of points.

    Raises
    ------
    InputError
        If ``drop`` is no boolean array of so many points, or marks none of them, or all.
    """
    mask = np.asarray(drop)
    if mask.dtype != np.bool_ or mask.shape != (points,):
        raise InputError(
            f"got points to drop of type {mask.dtype}, shape {mask.shape}; expected booleans, one for each of the "
            f"{points} points"
        )
    if not mask.any():
        raise InputError(f"got none of the {points} points to drop; expected at least one, in the units of the scene")
    if mask.all():
        raise InputError(f"got all {points} points to drop; expected some that stay")
    return np.flatnonzero(~mask)
