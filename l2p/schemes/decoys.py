"""Lines of far points that meet in false places: the second idea of Chelani et al. (CVPR 2021, section 6)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.appearance import Appearance
from l2p.maps.truth import Hiding
from l2p.schemes.aimed import aimed_lines, check_two_places, near_points
from l2p.schemes.rounding import directions, within_lattice

#: Lines that meet in a decoy: as many as neighbours make a spacing.
_GROUP = 50
#: Size of a decoy, of the piece of the map that it copies. Of 1 it is as dense as the map, of 0 a single point.
_SHRUNK = 0.5


class Decoys:
    """Scheme with one line per point, which also passes through a point of a decoy.

    The points are put into random groups of up to 50, so that points of one group are far from each other. A decoy is a
    copy of a random piece of the map, half as large and so denser than the map, in a false place: halfway between two
    random points. Each line of a group passes through one point of its decoy.

    By design each line has two places at which lines meet, one of them its point, and directions are more frequent
    along the long sides of the map.
    """

    name = "decoys"
    answers = 1

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Draw the groups and their decoys; InputError if all points are the same."""
        check_two_places(points, chosen, self.name)
        moved = within_lattice(points, chosen, rng)
        direction = directions(moved, false_points(moved, rng), rng)
        return aimed_lines(points, chosen, moved, direction, rng, appearance, self.name)


def false_points(xyz: Float[np.ndarray, "points 3"], rng: np.random.Generator) -> Float[np.ndarray, "points 3"]:
    """Point of a decoy for each point, scene units."""
    near, false = near_points(xyz, _GROUP - 1)[0], np.empty_like(xyz)
    for group in np.array_split(rng.permutation(len(xyz)), -(-len(xyz) // _GROUP)):
        copied, one, other = rng.integers(len(xyz), size=3)
        piece = np.concatenate([[copied], near[copied]])[: len(group)]
        false[group] = xyz[one] / 2 + xyz[other] / 2 + _SHRUNK * (xyz[piece] - xyz[copied])
    return false
