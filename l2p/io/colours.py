"""Colours of other programs as 8-bit red, green, blue."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

_MOST_8, _MOST_16 = 255, 65535


def byte_rgb(values: np.ndarray) -> UInt8[np.ndarray, "rows 3"] | None:
    """Convert numbers of 0 to 255, of a format that has no others, to 8 bits, halves up; None if they are no colours.

    >>> byte_rgb(np.array([[0.0, 1.0, 254.6]])).tolist()
    [[0, 1, 255]]
    """
    if not ((values >= 0) & (values <= _MOST_8)).all():
        return None
    return np.floor(values + 0.5).astype(np.uint8)


def as_rgb(values: np.ndarray) -> UInt8[np.ndarray, "rows 3"] | None:
    """Convert colours of any type to 8 bits, by their largest number; None if they are no colours.

    Parameters
    ----------
    values : (rows, 3)
        Floating-point numbers up to 1 are shares of the brightest; others, and integers, have 8 bits if they reach no
        more than 255, else 16.

    Examples
    --------
    >>> as_rgb(np.array([[0.0, 0.5, 1.0]])).tolist()
    [[0, 128, 255]]
    >>> as_rgb(np.array([[0, 257, 65535]], dtype=np.uint16)).tolist()
    [[0, 1, 255]]
    """
    if values.dtype == np.uint8 or not values.size:
        return values.astype(np.uint8)
    most, least = float(np.max(values)), float(np.min(values))
    if not (least >= 0 and most <= _MOST_16):  # NaN is neither
        return None
    scale = 1.0
    if values.dtype.kind == "f" and most <= 1:
        scale = _MOST_8
    elif most > _MOST_8:
        scale = _MOST_8 / _MOST_16
    return byte_rgb(values.astype(np.float64) * scale)
