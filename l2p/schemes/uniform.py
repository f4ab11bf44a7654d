"""Lifting: from the points of a scene to a line cloud that does not show them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8

from l2p.checks import finite_rows
from l2p.errors import InputError
from l2p.maps.lines import LineCloud
from l2p.schemes.rounding import lattice_step

SCHEMES = ("uniform",)
_STREAM = 0x11FE


def lift(
    points: Float[np.ndarray, "points 3"],
    seed: int | None = None,
    fraction: float = 1.0,
    scheme: str = "uniform",
    rgb: UInt8[np.ndarray, "points 3"] | None = None,
) -> LineCloud:
    """Replace points by lines of random direction through them; see :func:`lift_indexed`.

    >>> import numpy as np
    >>> len(lift(np.zeros((4, 3)), seed=0))
    4
    """
    return lift_indexed(points, seed, fraction, scheme, rgb)[0]


def lift_indexed(
    points: Float[np.ndarray, "points 3"],
    seed: int | None = None,
    fraction: float = 1.0,
    scheme: str = "uniform",
    rgb: UInt8[np.ndarray, "points 3"] | None = None,
) -> tuple[LineCloud, Int[np.ndarray, " lines"]]:
    """Lift a scene and say which point is behind each line.

    Parameters
    ----------
    points : (points, 3) float
        Scene points, scene units.
    seed : int, optional
        Seed of directions and subset. None draws one from the system: whoever can guess the seed can redraw the
        directions in the order of the points, so a line cloud that is to be published is lifted without one.
    fraction : float
        Share of the points that is lifted, in (0, 1]; at least one point is kept.
    scheme : str
        ``uniform``: directions uniform on the sphere (Speciale et al., CVPR 2019).
    rgb : (points, 3) uint8, optional
        Colours to store with the lines. They help an attacker; leave them out of a published map.

    Returns
    -------
    LineCloud, (lines,) int64
        The lines, ordered by direction, and ``index`` such that ``points[index[i]]`` lies behind line i.

    Raises
    ------
    InputError
        If there are no points, a point is not finite, the fraction is outside (0, 1] or the scheme is unknown.

    Notes
    -----
    What could reveal a point, and what is done about it:

    - *Order*: SfM models store neighbours side by side. Lines are sorted by their direction, which is independent
      of the point.
    - *Sign and origin*: the direction is turned into one half-space and the moment says nothing about the position.
    - *Rounding*: points that were once stored with few digits (single precision, text) lie on a lattice, and a line
      in double precision comes close to one lattice point only: its own. Each point is therefore moved within its
      lattice cell before it is lifted (:func:`lattice_step`); the shift is below the precision of the input.
    """
    points = finite_rows("points", points)
    if len(points) == 0:
        raise InputError("got a scene without points; expected at least one point to lift")
    if not 0 < fraction <= 1:
        raise InputError(f"got fraction {fraction}; expected a number in (0, 1], the share of the points to lift")
    if scheme not in SCHEMES:
        raise InputError(f"got scheme {scheme!r}; expected one of {', '.join(SCHEMES)}")
    if rgb is not None and rgb.shape != points.shape:
        raise InputError(f"got rgb of shape {rgb.shape}; expected {points.shape}, one colour a point")
    # A stream of its own: default_rng(seed) may have drawn the points, and would draw them again as directions.
    rng = np.random.default_rng(None if seed is None else [seed, _STREAM])
    chosen = _subset(len(points), fraction, rng)
    direction = _upper(rng.normal(size=(len(chosen), 3)))
    order = np.lexsort(direction.T)
    chosen, direction = chosen[order], direction[order]
    hidden = points[chosen] + lattice_step(points)[chosen, None] * rng.uniform(-0.5, 0.5, size=(len(chosen), 3))
    colour = None if rgb is None else rgb[chosen]
    return LineCloud.through(hidden, direction, colour, scheme), chosen


def _subset(count: int, fraction: float, rng: np.random.Generator) -> Int[np.ndarray, " lines"]:
    if fraction == 1:
        return np.arange(count)
    return rng.choice(count, size=max(1, round(count * fraction)), replace=False)


def _upper(direction: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "lines 3"]:
    """Unit vectors turned into the half-space z > 0; (d, m) and (-d, -m) are one line, so one of them is written."""
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return np.where(direction[:, 2:] < 0, -direction, direction)
