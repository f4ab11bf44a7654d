"""Paired-point lines: a line through each two points of random pairs (PPL; Lee et al., CVPR 2023)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.maps.truth import Hiding, Truth
from l2p.schemes.cleaning import without_outliers
from l2p.schemes.rounding import directions, within_lattice
from l2p.schemes.uniform import half_space


class Ppl:
    """Scheme with half as many lines as points, each through two of them.

    The map is cleaned first (:func:`l2p.schemes.cleaning.without_outliers`), the last point of an odd number is left
    out, and the others are paired at random, however far from each other. A line has the appearances of both points,
    in random order. By design directions are not uniform: there are more along the longer sides of the map.
    """

    name = "ppl"
    answers = 2

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Draw the pairs; InputError if fewer than two points are left."""
        pair = rng.permutation(paired_rows(points, chosen, self.name)).reshape(-1, 2)
        return pair_lines(points, pair, rng, appearance, self.name)


def paired_rows(
    points: Float[np.ndarray, "points 3"], chosen: Int[np.ndarray, " chosen"], scheme: str
) -> Int[np.ndarray, " even"]:
    """Rows of the chosen points that are left after cleaning, an even number; InputError if there are none."""
    row = chosen[without_outliers(points[chosen])]
    if len(row) < 2:
        raise InputError(f"got {len(row)} point(s) for {scheme}, outliers left out; expected at least 2, to pair them")
    return row[: len(row) // 2 * 2]


def pair_lines(
    points: Float[np.ndarray, "points 3"],
    pair: Int[np.ndarray, "lines 2"],
    rng: np.random.Generator,
    appearance: Appearance,
    scheme: str,
) -> Hiding:
    """Make a line through each two points, lines and the points of a line in random order.

    Parameters
    ----------
    points : (points, 3) float64
        All points of the scene, scene units.
    pair : (lines, 2) int64
        Rows of the points of each line.
    rng : numpy.random.Generator
    appearance : Appearance
        Of all points of the scene.
    scheme : str
    """
    pair = rng.permuted(rng.permutation(pair), axis=1)
    index = pair.ravel()
    moved = within_lattice(points, index, rng).reshape(-1, 2, 3)
    direction = half_space(directions(moved[:, 1], moved[:, 0], rng))
    first, second = (appearance.rows(pair[:, side]) for side in (0, 1))
    lines = LineCloud.through(moved[:, 0], direction, first, scheme, second if second.names else None)
    return Hiding(lines, Truth(points[index], index, element=np.arange(len(pair)).repeat(2)))
