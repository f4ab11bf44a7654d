"""Sides of the box with which the viewer looks at a region: ranges of sliders, in scene units."""

from __future__ import annotations

import math

import numpy as np

from l2p.show.exhibit import Exhibit
from l2p.show.stance import Stance

#: Least length of a range, as a share of the longest one: maps may be flat.
_FLAT = 0.01
#: Least length of a range, as a share of the coordinates, which have about 16 digits.
_DIGITS = 1e-9
#: Least number of steps of a slider; ten times as many at most.
_STEPS = 100


def sides_of(exhibit: Exhibit, stance: Stance) -> list[dict[str, str]]:
    """Choose the range, the step and the first values of the two sides along each axis of the scene.

    Returns
    -------
    list of dict
        For x, y and z: ``axis``, ``least``, ``most``, ``step``, ``low`` and ``high`` (the middle half), as decimals of
        equally many places, without exponent; the steps meet all of them. Ranges hold the points in the unit ball of
        the view. Empty if neither true points nor recovered ones with a calibrated confidence are known, so that there
        is nothing to tell about a region.
    """
    points = exhibit.points if exhibit.points is not None else exhibit.recovered if exhibit.calibrated else None
    if points is None or len(points) == 0:
        return []
    near = points[np.linalg.norm(stance.enter(points), axis=1) <= 1]
    near = near if len(near) else points
    low, high = near.min(axis=0), near.max(axis=0)
    size = np.maximum(high - low, max(_FLAT * float((high - low).max()), _DIGITS * float(np.abs(near).max())))
    size = np.where(size > 0, size, 1.0)
    middle = (low + high) / 2
    ranges = zip("xyz", (middle - size / 2).tolist(), size.tolist(), strict=True)
    return [_side(axis, start, length) for axis, start, length in ranges]


def _side(axis: str, start: float, length: float) -> dict[str, str]:
    """Sides along one axis, whose points are between ``start`` and ``start + length``."""
    exponent = math.floor(math.log10(length / _STEPS))
    step, places = 10.0**exponent, max(0, -exponent)
    least, most = math.floor(start / step), math.ceil((start + length) / step)
    quarter = (most - least) // 4
    whole = {"least": least, "most": most, "low": least + quarter, "high": most - quarter, "step": 1}
    return {"axis": axis, **{name: f"{number * step:.{places}f}" for name, number in whole.items()}}
