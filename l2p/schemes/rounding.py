"""The lattice to which the points of a scene were rounded; with it, lines could reveal their points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

#: Steps of single precision over the extent of the points, above which they are coarse: the map lies many times its
#: size away from the origin, as in coordinates of a country.
_COARSE = 1e-6
#: Steps over the extent of the points, above which they are worth a sentence.
_NOTICED = 1e-3
#: Least different coordinates of an axis that tell a step of their own: two floors would, too.
_DIFFERENT = 8


def lattice_step(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Step along each axis, at each point, of the coarsest lattice to which the scene was rounded; 0 if there is none.

    Notes
    -----
    Four kinds of rounding are recognised, also combined: to decimals (0 to 9, the same step everywhere), to significant
    digits (1 to 9) and to single precision (both with a step that grows with the point's largest coordinate), and
    single precision that is coarse. A decimal lattice counts if it contains at least half of the points: a few points
    of another source must not mask it. A scene in double precision lies on none.

    Single precision is coarse where the origin is many times the size of the map away (UTM, 5,000 km north). Then each
    coordinate has a step of its own: heights are not jittered by the half metre that northings are rounded to. Such
    coordinates may since have been shifted, so the coarsest power of two that an axis consists of counts, too.
    """
    size = np.abs(points).max(axis=1)
    if not size.any():
        return np.zeros(points.shape)
    single = (points.astype(np.float32) == points).all(axis=1)
    own = np.spacing(np.abs(points).astype(np.float32)).astype(np.float64)
    rounding = np.where(single[:, None], own, np.spacing(np.abs(points)))
    largest = np.spacing(size.astype(np.float32)).astype(np.float64)[:, None]
    extent = _extent(points)
    coarse = np.median(largest) > _COARSE * extent
    step = np.where(single[:, None], own if coarse else np.repeat(largest, 3, axis=1), 0.0)
    if single.mean() >= 0.5:
        step = np.maximum(step, _binary_steps(points, _COARSE * extent))
    for digits in range(10):
        if _rounded(points, np.full_like(points, 10.0**-digits), rounding):
            step = np.maximum(step, 10.0**-digits)
            break
    for digits in range(1, 10):
        if _rounded(points, _last_digit(points, digits), rounding):
            step = np.maximum(step, _last_digit(points, digits) if coarse else _last_digit(size, digits)[:, None])
            break
    return step


def resolution(points: Float[np.ndarray, "points 3"]) -> tuple[float, float, float]:
    """Median step of the coordinates along x, y and z, scene units; 0 where they have those of double precision.

    >>> import numpy as np
    >>> resolution(np.random.default_rng(0).normal(size=(100, 3)).round(2))
    (0.01, 0.01, 0.01)
    """
    x, y, z = np.median(lattice_step(points), axis=0).tolist()
    return x, y, z


def resolution_words(points: Float[np.ndarray, "points 3"], noticed: float | None = None) -> str:
    """Say which steps the coordinates have; empty if none is above ``noticed``, scene units.

    By default, steps above a thousandth of the extent of the points are noticed.

    >>> import numpy as np
    >>> points = np.random.default_rng(0).normal(size=(100, 3)) + [5e5, 5.4e6, 100]
    >>> resolution_words(points.astype(np.float32).astype(float))
    'coordinates have steps of 0.031 in x, 0.5 in y, 7.6e-06 in z'
    """
    step = resolution(points)
    if max(step) <= (_NOTICED * _extent(points) if noticed is None else noticed):
        return ""
    each = [f"{size:.2g} in {axis}" for axis, size in zip("xyz", step, strict=True)]
    return f"coordinates have steps of {', '.join(each)}"


def _extent(points: Float[np.ndarray, "points 3"]) -> float:
    """Median distance of the points from their middle, in the greatest coordinate."""
    return float(np.median(np.abs(points - np.median(points, axis=0)).max(axis=1)))


def _binary_steps(points: Float[np.ndarray, "points 3"], least: float) -> Float[np.ndarray, "3"]:
    """Largest power of two, above ``least``, of which nine in ten coordinates of each axis are multiples.

    Half of the multiples of a number are also multiples of its double, so half would not tell.
    """
    step = np.zeros(3)
    for axis in range(3):
        value = np.unique(points[:, axis])
        if len(value) < _DIFFERENT:
            continue
        # The lowest binary digit of each that is not 0.
        mantissa, exponent = np.frexp(value[value != 0])
        whole = (np.abs(mantissa) * 2.0**53).astype(np.int64)
        lowest = np.ldexp((whole & -whole).astype(np.float64), exponent - 53)
        common = float(np.sort(lowest)[len(lowest) // 10])
        step[axis] = common if common > least else 0.0
    return step


def within_lattice(
    points: Float[np.ndarray, "points 3"], chosen: Int[np.ndarray, " chosen"], rng: np.random.Generator
) -> Float[np.ndarray, "chosen 3"]:
    """Move each chosen point at random within its cell of the lattice to which it was rounded."""
    return points[chosen] + lattice_step(points)[chosen] * rng.uniform(-0.5, 0.5, size=(len(chosen), 3))


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
