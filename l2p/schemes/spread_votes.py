"""Lines whose neighbours vote for wrong places: the first idea of Chelani et al. (CVPR 2021, section 6)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.appearance import Appearance
from l2p.maps.truth import Hiding
from l2p.schemes.aimed import aimed_lines, isotropic, near_points, unit_size
from l2p.schemes.rounding import within_lattice

#: Nearest points whose votes count.
_NEIGHBORS = 32
#: Directions tried for each point in a sweep: random ones, and those of neighbours with noise.
_RANDOM, _COPIED, _NOISE = 8, 8, 0.1
#: Sweeps over all points. The votes near the points fall by half in the first and by a tenth in the last.
_SWEEPS = 8
#: Parts of the points that choose in turn: if all chose at once, neighbours would turn past each other.
_PARTS = 4
#: Points that choose at a time, for the memory.
_BLOCK = 4096
#: Added to squares, in units of the map, so that parallel lines through one place have a vote of 0.
_TINY = 1e-30


class SpreadVotes:
    """Scheme with one line per point, whose direction is chosen so that the votes of its neighbours are spread.

    Two lines vote for the places where they are nearest to each other. Random lines of neighbours are nearest close to
    their points, which is what attacks on line clouds use. Here each point tries directions, random ones and those of
    its neighbours with some noise, and keeps the one with the least votes near both points; the others then choose
    anew. Neighbours end nearly parallel, or turned so that they pass each other elsewhere.

    By design neighbours often have nearly the same direction, which tells who they are, but not where.
    """

    name = "spread-votes"
    answers = 1

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Choose the directions in turns."""
        moved = within_lattice(points, chosen, rng)
        direction = spread_directions(unit_size(moved), rng)
        return aimed_lines(points, chosen, moved, direction, rng, appearance, self.name)


def spread_directions(
    xyz: Float[np.ndarray, "points 3"], rng: np.random.Generator, sweeps: int = _SWEEPS
) -> Float[np.ndarray, "points 3"]:
    """Unit vectors with few votes of the nearest points near each point; random ones without ``sweeps``."""
    direction = isotropic((len(xyz),), rng)
    if len(xyz) == 1:
        return direction
    near, distance = near_points(xyz, _NEIGHBORS)
    reach = distance[:, -1]
    for _ in range(sweeps):
        for part in np.array_split(rng.permutation(len(xyz)), max(_PARTS, -(-len(xyz) // _BLOCK))):
            own = near[part]
            tried = _tried(direction[part], direction[own], rng)
            votes = votes_nearby(xyz[own] - xyz[part, None], tried, direction[own], reach[part], reach[own])
            direction[part] = tried[np.arange(len(part)), votes.argmin(axis=1)]
    return direction


def votes_nearby(
    apart: Float[np.ndarray, "points near 3"],
    direction: Float[np.ndarray, "points tried 3"],
    other: Float[np.ndarray, "points near 3"],
    reach: Float[np.ndarray, " points"],
    other_reach: Float[np.ndarray, "points near"],
) -> Float[np.ndarray, "points tried"]:
    """Sum the votes near the points of two lines, over the neighbours of each point.

    Parameters
    ----------
    apart : (points, near, 3) float64
        Vectors from each point to its neighbours.
    direction : (points, tried, 3) float64
        Unit directions that are compared.
    other : (points, near, 3) float64
        Unit directions of the neighbours.
    reach, other_reach : (points,) and (points, near) float64
        Distance from each point, and from each neighbour, at which a vote counts half.

    Returns
    -------
    (points, tried) float64
        A vote at distance b of the own point counts 1 / (1 + (b / reach)^2), on both lines; parallel lines have none.
    """
    cosine = direction @ other.swapaxes(1, 2)
    along, along_other = direction @ apart.swapaxes(1, 2), np.sum(apart * other, axis=2)[:, None]
    # The distances of the votes times sin^2, which is 0 for parallel lines.
    sine4 = (1 - cosine**2) ** 2
    own, others = (along - cosine * along_other) ** 2, (cosine * along - along_other) ** 2
    half, other_half = sine4 * reach[:, None, None] ** 2, sine4 * other_reach[:, None] ** 2
    return np.sum(half / (half + own + _TINY) + other_half / (other_half + others + _TINY), axis=2)


def _tried(
    present: Float[np.ndarray, "points 3"], others: Float[np.ndarray, "points near 3"], rng: np.random.Generator
) -> Float[np.ndarray, "points tried 3"]:
    """The present direction of each point, random ones, and those of neighbours with noise."""
    count, near = others.shape[:2]
    copied = others[np.arange(count)[:, None], rng.integers(near, size=(count, _COPIED))]
    copied = copied + _NOISE * rng.normal(size=copied.shape)
    copied /= np.linalg.norm(copied, axis=2, keepdims=True)
    return np.concatenate([present[:, None], isotropic((count, _RANDOM), rng), copied], axis=1)
