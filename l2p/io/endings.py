"""Endings of files to write, and the published attributes that each format can hold."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from os import PathLike
from pathlib import Path

from l2p.errors import InputError

# Attributes as users name them.
_NAMES = {"rgb": "colours", "descriptor": "descriptors"}


def checked_ending(
    path: str | PathLike[str], what: str, held: Mapping[str, Sequence[str]], attributes: Collection[str] = ()
) -> str:
    """Return the ending of a file to write, in lower case.

    Parameters
    ----------
    what : str
        What is written, for messages.
    held : mapping
        Attributes that each format can hold, by its ending; npz holds all.
    attributes : collection of str
        Attributes that are published.

    Raises
    ------
    InputError
        If l2p does not write such files, or they cannot hold one of the attributes.

    Examples
    --------
    >>> checked_ending("Lines.PLY", "a line cloud", {".npz": ("rgb",), ".ply": ()})
    '.ply'
    """
    ending = Path(path).suffix.lower()
    if ending not in held:
        *others, last = held
        known = f"{', '.join(others)} or {last}" if others else last
        raise InputError(f"{path} ends with {ending!r}; expected {what} to end with {known}")
    for name in attributes:
        if name not in held[ending]:
            raise InputError(f"{path} cannot hold {_NAMES[name]}; write .npz, or leave them out")
    return ending
