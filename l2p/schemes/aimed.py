"""Lines whose directions were chosen by the places of the points, as a line cloud."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.maps.truth import Hiding, Truth
from l2p.schemes.uniform import half_space


def aimed_lines(
    points: Float[np.ndarray, "points 3"],
    chosen: Int[np.ndarray, " chosen"],
    moved: Float[np.ndarray, "chosen 3"],
    direction: Float[np.ndarray, "chosen 3"],
    rng: np.random.Generator,
    appearance: Appearance,
    scheme: str,
) -> Hiding:
    """Make a line through each chosen point, in random order, since the directions tell of the places.

    Parameters
    ----------
    points : (points, 3) float64
        All points of the scene, scene units.
    chosen : (chosen,) int64
        Rows of the points to hide.
    moved : (chosen, 3) float64
        The chosen points, moved within their lattice cells.
    direction : (chosen, 3) float64
        Unit vector of each.
    rng : numpy.random.Generator
    appearance : Appearance
        Of all points of the scene.
    scheme : str
    """
    order = rng.permutation(len(chosen))
    chosen = chosen[order]
    lines = LineCloud.through(moved[order], half_space(direction[order]), appearance.rows(chosen), scheme)
    return Hiding(lines, Truth(points[chosen], chosen))


def unit_size(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Move and scale points into the box from -1 to 1, so that squares neither vanish nor overflow."""
    middle = points - points.mean(axis=0)
    return middle / (np.abs(middle).max() or 1.0)


def isotropic(shape: tuple[int, ...], rng: np.random.Generator) -> Float[np.ndarray, "*shape 3"]:
    """Draw unit vectors of uniform direction."""
    vector = rng.normal(size=(*shape, 3))
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def near_points(
    points: Float[np.ndarray, "points 3"], count: int
) -> tuple[Int[np.ndarray, "points near"], Float[np.ndarray, "points near"]]:
    """Find the nearest other points of each of two or more points, nearest first: their rows and distances.

    There are ``count`` of them, or all. Of points at one place, one may be its own neighbour.
    """
    from scipy.spatial import KDTree

    distance, index = map(np.asarray, KDTree(points).query(points, k=min(count + 1, len(points))))
    return index[:, 1:], distance[:, 1:]


def check_two_places(points: Float[np.ndarray, "points 3"], chosen: Int[np.ndarray, " chosen"], scheme: str) -> None:
    """InputError if all chosen points are at one place, so that there is no other one to aim at."""
    if (points[chosen] == points[chosen[0]]).all():
        raise InputError(
            f"got {len(chosen)} point(s) at one place for {scheme}; expected two different ones, to aim lines at others"
        )
