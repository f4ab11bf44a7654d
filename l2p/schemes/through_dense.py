"""Lines that pass through other dense places: the third idea of Chelani et al. (CVPR 2021, section 6)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.appearance import Appearance
from l2p.maps.truth import Hiding
from l2p.schemes.aimed import aimed_lines, check_two_places, isotropic, near_points, unit_size
from l2p.schemes.rounding import within_lattice

#: Places that each point tries to aim at, and points of the map that are counted along each line.
_TRIED, _COUNTED = 8, 500
#: Rank of the neighbour whose median distance is the width of a line: that of the spacing.
_NEIGHBOR = 50
#: Noise of the places aimed at, in widths. A line exactly through another point would meet that one's line in it, and
#: give it away.
_NOISE = 0.25
#: Distance along the line from its own point, in widths, from which on points count.
_ELSEWHERE = 3.0
#: Points at a time, for the memory.
_BLOCK = 256


class ThroughDense:
    """Scheme with one line per point, which passes through other places that are dense.

    A point tries eight places near random other points, and takes the one whose line has the most points of the map
    near it, beyond the neighbourhood of its own. Lines then stay in the surfaces of the map, or join two of them.

    By design a point lies where the map is dense along its line, but not only there; directions are more frequent along
    the surfaces.
    """

    name = "through-dense"
    answers = 1

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Choose a place for each point; InputError if all points are the same."""
        check_two_places(points, chosen, self.name)
        moved = within_lattice(points, chosen, rng)
        direction = dense_directions(unit_size(moved), rng)
        return aimed_lines(points, chosen, moved, direction, rng, appearance, self.name)


def dense_directions(xyz: Float[np.ndarray, "points 3"], rng: np.random.Generator) -> Float[np.ndarray, "points 3"]:
    """Unit vector of each point to the place, of those tried, with the most points of the map along the line."""
    width = float(np.median(near_points(xyz, _NEIGHBOR)[1][:, -1]))
    counted = xyz[rng.permutation(len(xyz))[:_COUNTED]]
    chosen = np.empty_like(xyz)
    for start in range(0, len(xyz), _BLOCK):
        some = xyz[start : start + _BLOCK]
        place = xyz[rng.integers(len(xyz), size=(len(some), _TRIED))]
        noise = _NOISE * width * rng.normal(size=place.shape)
        tried = _units(place - some[:, None] + noise, rng)
        found = points_along(some, tried, counted, width)
        chosen[start : start + _BLOCK] = tried[np.arange(len(some)), found.argmax(axis=1)]
    return chosen


def points_along(
    xyz: Float[np.ndarray, "points 3"],
    direction: Float[np.ndarray, "points tried 3"],
    counted: Float[np.ndarray, "counted 3"],
    width: float,
) -> Int[np.ndarray, "points tried"]:
    """Count the points within ``width`` of each line, farther than three widths along it from its own point."""
    apart = counted - xyz[:, None]
    along = direction @ apart.swapaxes(1, 2)
    across = np.sum(apart**2, axis=2)[:, None] - along**2
    return np.sum((across <= width**2) & (np.abs(along) > _ELSEWHERE * width), axis=2)


def _units(
    vector: Float[np.ndarray, "points tried 3"], rng: np.random.Generator
) -> Float[np.ndarray, "points tried 3"]:
    """Unit vectors; of random direction where a point was aimed at itself, without noise."""
    length = np.linalg.norm(vector, axis=2, keepdims=True)
    drawn = isotropic(vector.shape[:2], rng)
    return np.where(length > 0, vector / np.where(length > 0, length, 1), drawn)
