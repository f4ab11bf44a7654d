"""The lattice to which the points of a scene were rounded; with it, lines could reveal their points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def lattice_step(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    """Step, at each point, of the coarsest lattice to which the scene was rounded; 0 if there is none.

    Notes
    -----
    Three kinds of rounding are recognised, also combined: to decimals (0 to 9, the same step everywhere), to
    significant digits (1 to 9) and to single precision (both with a step that grows with the point's largest
    coordinate). A decimal lattice counts if it contains at least half of the points: a few points of another source
    must not mask it. A scene in double precision lies on none.
    """
    size = np.abs(points).max(axis=1)
    if not size.any():
        return np.zeros(len(points))
    single = (points.astype(np.float32) == points).all(axis=1)
    rounding = np.where(single[:, None], np.spacing(np.abs(points).astype(np.float32)), np.spacing(np.abs(points)))
    step = np.where(single, np.spacing(size.astype(np.float32)), 0.0)
    for digits in range(10):
        if _rounded(points, np.full_like(points, 10.0**-digits), rounding):
            step = np.maximum(step, 10.0**-digits)
            break
    for digits in range(1, 10):
        if _rounded(points, _last_digit(points, digits), rounding):
            step = np.maximum(step, _last_digit(size, digits))
            break
    return step


def within_lattice(
    points: Float[np.ndarray, "points 3"], chosen: Int[np.ndarray, " chosen"], rng: np.random.Generator
) -> Float[np.ndarray, "chosen 3"]:
    """Move each chosen point at random within its cell of the lattice to which it was rounded."""
    return points[chosen] + lattice_step(points)[chosen, None] * rng.uniform(-0.5, 0.5, size=(len(chosen), 3))


def _rounded(
    points: Float[np.ndarray, "points 3"], unit: Float[np.ndarray, "points 3"], rounding: Float[np.ndarray, "points 3"]
) -> bool:
    """Return whether at least half of the points are multiples of their unit, up to rounding."""
    with np.errstate(divide="ignore", invalid="ignore"):  # the last digit of the tiniest numbers is 0
        multiple, slack = points / unit, 4 * rounding / unit
        # A unit of only a few rounding errors would accept any point.
        on = (np.abs(multiple - np.rint(multiple)) <= slack) & (slack < 0.05)
    return bool(on.all(axis=1).mean() >= 0.5)


def _last_digit(value: Float[np.ndarray, "*shape"], digits: int) -> Float[np.ndarray, "*shape"]:
    """One unit in the last of ``digits`` significant digits."""
    return 10.0 ** (np.floor(np.log10(np.where(value == 0, 1, np.abs(value)))) - (digits - 1))


def directions(
    points: Float[np.ndarray, "lines 3"], origins: Float[np.ndarray, "lines 3"], rng: np.random.Generator
) -> Float[np.ndarray, "lines 3"]:
    """Unit vectors from origins to points; of random direction where both are the same to the last digit.

    Notes
    -----
    Far from the origin of a map, coordinates have few digits behind the point, so a difference of two of them is a
    multiple of their last digit; a direction is more precise than that, and only few distances along it would give
    such multiples. The difference is therefore moved at random within the last digit of the coordinates.
    """
    step = np.spacing(np.maximum(np.abs(points), np.abs(origins)).max(axis=1, initial=0.0, keepdims=True))
    apart = points - origins
    same = np.abs(apart).max(axis=1, initial=0.0, keepdims=True) <= 2 * step
    moved = apart + step * rng.uniform(-0.5, 0.5, size=apart.shape)
    vector = np.where(same, rng.normal(size=apart.shape), moved)
    vector = vector / np.abs(vector).max(axis=1, initial=0.0, keepdims=True)  # squares of tiny numbers would be 0
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)
