"""Short text of what holds arrays: names, types and shapes, never the numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

#: Longest text of one value, and most entries of a collection that are shown.
_LONGEST, _MOST = 60, 3


def short_repr(self: Any) -> str:
    """Text of a dataclass for its ``__repr__``: its fields, without those that are None or have their default.

    >>> import numpy as np
    >>> from l2p.maps.scene import Scene
    >>> Scene(np.zeros((7, 3)), descriptor=np.zeros((7, 128), dtype=np.uint8))
    Scene(xyz=float64 (7, 3), descriptor=uint8 (7, 128), descriptor_kind='unknown')
    """
    shown = [(entry, getattr(self, entry.name)) for entry in fields(self)]
    parts = [f"{entry.name}={short(value)}" for entry, value in shown if not _is_default(value, entry.default)]
    return f"{type(self).__name__}({', '.join(parts)})"


def short(value: Any) -> str:
    """Text of a value: an array by its type and shape, a long collection by its number."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        kind = str(value.dtype).removeprefix("torch.")
        return f"{kind} {tuple(value.shape)}" if value.shape else repr(value.item())
    if isinstance(value, Mapping):
        names = ", ".join(map(str, list(value)[:_MOST]))
        return f"{{{names}{', ...' if len(value) > _MOST else ''}}}"
    if isinstance(value, tuple | list | set | frozenset) and (len(value) > _MOST or any(map(_is_long, value))):
        return f"{len(value)} x {type(next(iter(value))).__name__}"
    text = repr(value)
    return text if len(text) <= _LONGEST or "(" in text else f"{text[: _LONGEST - 3]}..."


def _is_long(value: Any) -> bool:
    return hasattr(value, "shape") or len(repr(value)) > _LONGEST


def _is_default(value: Any, default: Any) -> bool:
    return value is None or (default is not MISSING and (value is default or (_plain(value) and value == default)))


def _plain(value: Any) -> bool:
    return isinstance(value, str | int | float | tuple)
