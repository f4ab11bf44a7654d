"""npz and npy files, arrays in one file: the same bytes for the same arrays, and nothing is ever unpickled."""

from __future__ import annotations

import io
import math
import os
import warnings
import zipfile
from collections.abc import Iterable
from os import PathLike
from typing import Any

import numpy as np

from l2p.errors import InputError

#: Largest ratio of inflated to compressed bytes, from the documentation of zlib.
_MOST_INFLATED = 1032


def npz_bytes(arrays: dict[str, Any]) -> bytes:
    """Encode ``arrays`` as an npz file; entries that are None are left out.

    Notes
    -----
    numpy dates every member 1980-01-01, so the bytes depend on the arrays alone. There is no compression, since
    coordinates in double precision hardly shrink.
    """
    buffer = io.BytesIO()
    np.savez(buffer, **{name: value for name, value in arrays.items() if value is not None})
    return buffer.getvalue()


def npz_keys(path: str | PathLike[str]) -> set[str]:
    """Names of the arrays in an npz file; InputError if it is damaged."""
    with open(path, "rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                return {name.removesuffix(".npy") for name in archive.namelist()}
        except Exception as error:  # zipfile raises many types on damaged bytes
            raise _damaged(path) from error


def read_npz(path: str | PathLike[str], names: Iterable[str]) -> dict[str, np.ndarray]:
    """Read the named arrays; names that the file lacks are left out.

    Raises
    ------
    InputError
        If the file is damaged or one of the arrays holds Python objects, which are never unpickled.
    """
    with open(path, "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about headers written by Python 2
        try:
            with zipfile.ZipFile(file) as archive:
                members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
                return {name: _read_array(path, archive, members[name]) for name in names if name in members}
        except InputError:
            raise
        except Exception as error:  # numpy and zipfile raise many types on damaged bytes
            raise _damaged(path) from error


def read_npy(path: str | PathLike[str]) -> np.ndarray:
    """Read the array of an npy file; InputError if it is damaged or holds Python objects, which are never unpickled."""
    with open(path, "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about headers written by Python 2
        try:
            if _claimed(path, file) != os.path.getsize(path):
                raise _damaged(path, "npy")
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)
        except InputError:
            raise
        except Exception as error:  # numpy raises many types on damaged bytes
            raise _damaged(path, "npy") from error


def _read_array(path: str | PathLike[str], archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Read one array; a header that claims more than the file can hold is refused before memory is allocated."""
    largest = {zipfile.ZIP_STORED: info.compress_size, zipfile.ZIP_DEFLATED: _MOST_INFLATED * info.compress_size}
    with archive.open(info) as member:
        complete = _claimed(path, member) == info.file_size
    if not complete or info.file_size > largest[info.compress_type]:
        raise _damaged(path)
    with archive.open(info) as member:
        return np.lib.format.read_array(member, allow_pickle=False)


def _claimed(path: str | PathLike[str], file: Any) -> int:
    """Read the header of an array, and return the bytes that array and header need."""
    read_header: Any = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[np.lib.format.read_magic(file)]
    shape, _, dtype = read_header(file)
    if dtype.hasobject:
        raise InputError(f"{path} holds Python objects, which l2p never loads; expected plain arrays")
    return file.tell() + math.prod(shape) * dtype.itemsize


def _damaged(path: str | PathLike[str], kind: str = "npz") -> InputError:
    return InputError(f"{path} is truncated or damaged; expected a complete {kind} file")


class Fields:
    """The arrays of one file, checked one by one as they are taken."""

    def __init__(self, path: str | PathLike[str], names: Iterable[str]) -> None:
        self.path = path
        self._arrays = read_npz(path, names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays that the file has."""
        return tuple(self._arrays)

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of an array that the file has."""
        return self._arrays[name].shape

    def take(
        self, name: str, kinds: str, shape: tuple[int | None, ...], dtype: type[np.generic] | None = None
    ) -> np.ndarray:
        """Return the array ``name`` as ``dtype``; None in ``shape`` is any length.

        Raises
        ------
        InputError
            If the array is missing, its dtype kind is not one of ``kinds``, or its shape or range does not fit.
        """
        if name not in self._arrays:
            raise InputError(f"{self.path} has no {name}; expected an array of shape {_shown(shape)}")
        array = self._arrays[name]
        if array.dtype.kind not in kinds:
            raise InputError(f"{self.path} has {name} of type {array.dtype}; expected {_KIND_NAMES[kinds]}")
        if len(array.shape) != len(shape) or any(
            want not in (None, got) for got, want in zip(array.shape, shape, strict=True)
        ):
            raise InputError(f"{self.path} has {name} of shape {array.shape}; expected {_shown(shape)}")
        if dtype is None:
            return array
        with np.errstate(over="ignore", invalid="ignore"):  # a number that is too large becomes infinite
            cast = array.astype(dtype)
        if cast.dtype.kind == "i" and not np.array_equal(cast, array):
            raise InputError(f"{self.path} has {name} outside the range of {cast.dtype}; expected smaller numbers")
        return cast

    def take_optional(
        self, name: str, kinds: str, shape: tuple[int | None, ...], dtype: type[np.generic] | None = None
    ) -> np.ndarray | None:
        """Return the array ``name``, or None if the file lacks it."""
        return self.take(name, kinds, shape, dtype) if name in self._arrays else None

    def take_text(self, name: str) -> str:
        """Return the string ``name``."""
        array = self.take(name, "U", ())
        try:
            # NumPy strings may hold code points that Python strings cannot.
            codes = array.astype(array.dtype.newbyteorder("<")).tobytes()
            return codes.decode("utf-32-le").rstrip("\0")
        except ValueError as error:
            raise InputError(f"{self.path} has a {name} that is no text; write the file again") from error

    def take_optional_text(self, name: str) -> str | None:
        """Return the string ``name``, or None if the file lacks it."""
        return self.take_text(name) if name in self._arrays else None

    def take_rgb(self, rows: int, name: str = "rgb") -> np.ndarray | None:
        """Return the colours, (rows, 3) uint8, or None if the file has none."""
        rgb = self.take_optional(name, "iu", (rows, 3))
        if rgb is not None and rgb.dtype != np.uint8:
            raise InputError(f"{self.path} has {name} of type {rgb.dtype}; expected uint8, 0 to 255")
        return rgb

    def take_descriptor(self, rows: int, name: str = "descriptor") -> tuple[np.ndarray | None, str | None]:
        """Return the descriptors, (rows, length) of uint8 or of floating point, and their kind; None twice without."""
        descriptor = self.take_optional(name, "fiu", (rows, None))
        if descriptor is None:
            return None, None
        if descriptor.dtype.kind != "f" and descriptor.dtype != np.uint8:
            raise InputError(f"{self.path} has {name}s of type {descriptor.dtype}; expected uint8 or float32")
        return descriptor, self.take_optional_text("descriptor_kind")

    def take_element(self, rows: int) -> np.ndarray:
        """The element of each row, if the file has them; else every row is of its own."""
        element = self.take_optional("element", "iu", (rows,), np.int64)
        if element is None:
            return np.arange(rows)
        if element.min(initial=0) < 0:
            raise InputError(f"{self.path} has element {element.min()}; expected rows of the lines, counted from 0")
        return element

    def take_version(self, newest: int) -> int:
        """Return the version of the format; InputError above ``newest``."""
        version = int(self.take("version", "iu", ()))
        if not 1 <= version <= newest:
            raise InputError(f"{self.path} has version {version}; this l2p reads up to {newest}, so upgrade l2p")
        return version


_KIND_NAMES = {"fiu": "numbers", "iu": "integers", "b": "booleans", "U": "a string"}


def _shown(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("any" if length is None else str(length) for length in shape) + ")"
