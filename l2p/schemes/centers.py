"""Lines from points to a few common centres."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.maps.truth import Hiding, Truth
from l2p.schemes.rounding import directions, within_lattice
from l2p.schemes.uniform import half_space

#: Starts of k-means, of which the best counts; as in the authors' code.
_STARTS = 10
#: Change of the mean distance to the centres at which k-means ends, in units of the points' spread.
_CONVERGED = 1e-9


def two_centers(points: Float[np.ndarray, "points 3"], rng: np.random.Generator) -> Float[np.ndarray, "2 3"]:
    """Centres of the two clusters of points that k-means finds.

    Parameters
    ----------
    points : (points, 3) float64
        Scene units; not all at one place.
    rng : numpy.random.Generator
        Draws the starts, each of two different points.

    Returns
    -------
    (2, 3) float64
        Scene units, in no order.
    """
    from scipy.cluster.vq import kmeans

    middle = points.mean(axis=0)
    unit = np.abs(points - middle).max()
    scaled = (points - middle) / unit
    found = []
    for _ in range(_STARTS):
        first = scaled[rng.integers(len(scaled))]
        weight = np.sum((scaled - first) ** 2, axis=1)
        second = scaled[rng.choice(len(scaled), p=weight / weight.sum())]
        found.append(kmeans(scaled, np.stack([first, second]), thresh=_CONVERGED))
    return middle + unit * min(found, key=lambda each: each[1])[0]


def moved_points(
    points: Float[np.ndarray, "points 3"], chosen: Int[np.ndarray, " chosen"], rng: np.random.Generator
) -> Float[np.ndarray, "chosen 3"]:
    """Move the chosen points within their lattice cells; InputError if they are all at one place, their own centre."""
    if (points[chosen] == points[chosen[0]]).all():
        raise InputError(f"got {len(chosen)} point(s) at one place; expected two different ones, to find centres")
    return within_lattice(points, chosen, rng)


def lines_to_centers(
    points: Float[np.ndarray, "points 3"],
    chosen: Int[np.ndarray, " chosen"],
    moved: Float[np.ndarray, "chosen 3"],
    center: Float[np.ndarray, "chosen 3"],
    rng: np.random.Generator,
    appearance: Appearance,
    scheme: str,
) -> Hiding:
    """Make a line through each chosen point and its centre, in random order.

    Parameters
    ----------
    points : (points, 3) float64
        All points of the scene, scene units.
    chosen : (chosen,) int64
        Rows of the points to hide.
    moved : (chosen, 3) float64
        The chosen points, moved within their lattice cells.
    center : (chosen, 3) float64
        Centre of each, scene units.
    rng : numpy.random.Generator
    appearance : Appearance
        Of all points of the scene.
    scheme : str

    Notes
    -----
    A moment is computed from the centre and the direction, so its rounding does not depend on the distance of the
    point, and centres can be found again to the last digits. The sign of a direction is dropped, so the side of the
    centre on which the point lies is not told.
    """
    order = rng.permutation(len(chosen))
    chosen, moved, center = chosen[order], moved[order], center[order]
    direction = half_space(directions(moved, center, rng))
    lines = LineCloud.through(center, direction, appearance.rows(chosen), scheme)
    return Hiding(lines, Truth(points[chosen], chosen))
