"""Checks of arrays from users, each with a one-sentence error."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.errors import InputError

#: Largest absolute coordinate: products of a few are finite, also in single precision if in units of the scene's size.
FARTHEST = 1e30


#: Description of a number that fails :func:`in_range`, for error messages.
OUT_OF_RANGE = "NaN, infinite or beyond 1e30"


def finite_rows(name: str, value: object) -> Float[np.ndarray, "lines 3"]:
    """Copy ``value`` to a (lines, 3) float64 array; InputError if its shape, type or a number does not fit."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise InputError(f"got {name} of type {array.dtype}; expected numbers")
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"got {name} of shape {array.shape}; expected (lines, 3)")
    array = array.astype(np.float64)
    refuse(np.asarray(~in_range(array).all(axis=1)), f"{name} that is {OUT_OF_RANGE}", "remove the line")
    return array


def check_fraction(value: float, name: str = "fraction") -> None:
    """Refuse a fraction of the points that is not in (0, 1]."""
    if not 0 < value <= 1:
        raise InputError(f"got {name} {value}; expected a number in (0, 1], a share of the points")


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
