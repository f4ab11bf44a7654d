"""Named arrays in one file: the same bytes for the same arrays, and nothing is ever unpickled."""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Iterable
from os import PathLike
from typing import Any

import numpy as np

from l2p.errors import InputError


def npz_bytes(arrays: dict[str, Any]) -> bytes:
    """The npz file of ``arrays``; entries that are None are left out.

    Notes
    -----
    numpy dates every member 1980-01-01, so the bytes depend on the arrays alone; nothing is compressed, because
    double precision coordinates hardly shrink.
    """
    buffer = io.BytesIO()
    np.savez(buffer, **{name: value for name, value in arrays.items() if value is not None})
    return buffer.getvalue()


def npz_keys(path: str | PathLike[str]) -> set[str]:
    """Names of the arrays in an npz file."""
    with open(path, "rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                return {name.removesuffix(".npy") for name in archive.namelist()}
        except Exception as error:  # zipfile raises many types on damaged bytes
            raise _damaged(path) from error


def read_npz(path: str | PathLike[str], names: Iterable[str]) -> dict[str, np.ndarray]:
    """Those of the named arrays that the file holds.

    Raises
    ------
    InputError
        If the file is damaged or one of the arrays holds Python objects, which are never unpickled.
    """
    with open(path, "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers that Python 2 wrote
        try:
            with np.load(file, allow_pickle=False) as archive:
                return {name: np.asarray(archive[name]) for name in names if name in archive}
        except Exception as error:  # numpy and zipfile raise many types on damaged bytes
            if "allow_pickle" in str(error):
                raise InputError(
                    f"{path} holds Python objects, which l2p never loads; expected plain arrays"
                ) from error
            raise _damaged(path) from error


def _damaged(path: str | PathLike[str]) -> InputError:
    return InputError(f"{path} is truncated or damaged; expected a complete npz file")


class Fields:
    """The arrays of one file, checked one by one as they are taken."""

    def __init__(self, path: str | PathLike[str], names: Iterable[str]) -> None:
        self.path = path
        self._arrays = read_npz(path, names)

    def take(self, name: str, kinds: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """The array ``name``, whose dtype kind is one of ``kinds``; None in ``shape`` is any length."""
        if name not in self._arrays:
            raise InputError(f"{self.path} has no {name}; expected an array of shape {_shown(shape)}")
        array = self._arrays[name]
        if array.dtype.kind not in kinds:
            raise InputError(f"{self.path} has {name} of type {array.dtype}; expected {_KIND_NAMES[kinds]}")
        if len(array.shape) != len(shape) or any(
            want not in (None, got) for got, want in zip(array.shape, shape, strict=True)
        ):
            raise InputError(f"{self.path} has {name} of shape {array.shape}; expected {_shown(shape)}")
        return array

    def take_optional(self, name: str, kinds: str, shape: tuple[int | None, ...]) -> np.ndarray | None:
        """The array ``name`` if the file has it."""
        return self.take(name, kinds, shape) if name in self._arrays else None

    def take_rgb(self, rows: int) -> np.ndarray | None:
        """The colours, uint8, if the file has them."""
        rgb = self.take_optional("rgb", "iu", (rows, 3))
        if rgb is not None and rgb.dtype != np.uint8:
            raise InputError(f"{self.path} has rgb of type {rgb.dtype}; expected uint8, 0 to 255")
        return rgb

    def take_version(self, newest: int) -> int:
        """The version of the format, at most ``newest``."""
        version = int(self.take("version", "iu", ()))
        if not 1 <= version <= newest:
            raise InputError(f"{self.path} has version {version}; this l2p reads up to {newest}, so upgrade l2p")
        return version


_KIND_NAMES = {"fiu": "numbers", "iu": "integers", "b": "booleans", "U": "a string"}


def _shown(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("any" if length is None else str(length) for length in shape) + ")"
