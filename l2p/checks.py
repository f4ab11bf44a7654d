"""Checks of arrays from users, each with a one-sentence error."""

from __future__ import annotations

import numbers

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.errors import InputError

#: Largest absolute coordinate: products of a few are finite, also in single precision if in units of the scene's size.
FARTHEST = 1e30


#: Description of a number that fails :func:`in_range`, for error messages.
OUT_OF_RANGE = "NaN, infinite or beyond 1e30"


def point_rows(name: str, value: object) -> Float[np.ndarray, "points 3"]:
    """Return ``value`` as a (points, 3) array of floats, itself if it is one; InputError if it does not fit."""
    try:
        array = np.asarray(value)
    except ValueError as error:  # rows of different lengths
        raise InputError(f"got {name} in rows of different lengths; expected (lines, 3)") from error
    if array.dtype.kind not in "fiu":
        raise InputError(f"got {name} of type {array.dtype}; expected numbers")
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"got {name} of shape {array.shape}; expected (lines, 3)")
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def finite_rows(name: str, value: object) -> Float[np.ndarray, "lines 3"]:
    """Copy ``value`` to a (lines, 3) float64 array; InputError if its shape, type or a number does not fit."""
    array = point_rows(name, value).astype(np.float64)
    refuse(np.asarray(~in_range(array).all(axis=1)), f"{name} that is {OUT_OF_RANGE}", "remove the line")
    return array


def named(value: object) -> str:
    """Name a value in a message, without its numbers: ``an array of shape (5, 2)``, ``a Scene``, ``'text'``."""
    if hasattr(value, "shape"):
        return f"an array of shape {tuple(value.shape)}"  # type: ignore[attr-defined]
    if value is None or isinstance(value, str | int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__} of {len(value)}"
    kind = type(value).__name__
    return f"{'an' if kind[0] in 'AEIOUaeio' else 'a'} {kind}"


def check_seed(seed: object) -> None:
    """Refuse a seed that is neither None nor a whole number from 0 on."""
    whole = isinstance(seed, numbers.Integral) and not isinstance(seed, bool)
    if seed is not None and not (whole and seed >= 0):  # type: ignore[operator]
        raise InputError(f"got seed {named(seed)}; expected a whole number, 0 or more, or None")


def check_fraction(value: object, name: str = "fraction") -> None:
    """Refuse a fraction of the points that is not a number in (0, 1]."""
    number = isinstance(value, numbers.Real)
    if not number or not 0 < value <= 1:  # type: ignore[operator]
        came = value if number else named(value)
        raise InputError(f"got {name} {came}; expected a number in (0, 1], a share of the points")


def element_rows(value: object, rows: int) -> Int[np.ndarray, " rows"]:
    """Convert ``value`` to the element (line) of each row, int64; None gives each row its own index."""
    if value is None:
        return np.arange(rows)
    array = np.asarray(value)
    if array.dtype.kind not in "iu" or array.shape != (rows,):
        raise InputError(f"got element of type {array.dtype}, shape {array.shape}; expected integers, one for each row")
    if array.min(initial=0) < 0:
        raise InputError(f"got element {array.min()}; expected rows of the lines, counted from 0")
    return array.astype(np.int64)


def in_range(array: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Test whether each number is finite and at most ``FARTHEST`` from 0."""
    return np.abs(array) <= FARTHEST


def refuse(bad: np.ndarray, what: str, mend: str) -> None:
    """Raise InputError if ``bad`` marks a line; ``mend`` is the advice to the user."""
    if bad.any():
        message = f"got {int(bad.sum())} line(s) with a {what}, first at line {int(np.argmax(bad))}"
        raise InputError(f"{message}; {mend} (lines are counted from 0)")
