"""Local features of images in hloc's files: HDF5 with a group per image, by h5py."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from l2p.errors import InputError
from l2p.io.track_means import ImageFeatures
from l2p.maps.appearance import UNKNOWN_KIND

#: Kinds that hloc names in its files, ``feats-KIND-...``; no other word of a file name is published.
HLOC_KINDS = ("superpoint", "disk", "aliked", "sift", "sosnet", "r2d2", "d2net")

# Largest ratio of inflated to compressed bytes: zlib's, which is above those of HDF5's other filters.
_MOST_INFLATED = 1032


class HlocFeatures:
    """The features of a file; opened read-only.

    Raises
    ------
    InputError
        If h5py is not installed, or the file is damaged.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        try:
            import h5py
        except ImportError as error:
            raise InputError(f"{path} needs h5py; install it with pip install h5py") from error
        self.path = path
        self.kind = _kind(Path(path).name)
        with self._complete():
            self._file: Any = h5py.File(path, "r")
        self._group, self._dataset = h5py.Group, h5py.Dataset

    def has_features(self) -> bool:
        """Whether the file holds local features: hloc also writes matches and descriptors of whole images."""

        def look(_: str, item: Any) -> bool | None:
            if isinstance(item, self._dataset):
                return False
            return True if "keypoints" in item and "descriptors" in item else None

        with self._complete():
            return bool(self._file.visititems(look))

    def of_image(self, name: str) -> ImageFeatures | None:
        """Read the features of the image of this name; None if the file has none."""
        with self._complete():
            group = self._file.get(name)
            if not isinstance(group, self._group) or "keypoints" not in group or "descriptors" not in group:
                return None
            xy, descriptor = (self._array(group[key], name) for key in ("keypoints", "descriptors"))
        if descriptor.dtype.kind != "f" and descriptor.dtype != np.uint8:
            raise InputError(f"{self.path} has descriptors of type {descriptor.dtype}; expected uint8 or floats")
        if xy.ndim != 2 or xy.shape[1] < 2 or descriptor.ndim != 2 or descriptor.shape[1] != len(xy):
            raise InputError(
                f"{self.path} has keypoints {xy.shape} and descriptors {descriptor.shape} of {name}; expected (n, 2) "
                "and (length, n)"
            )
        return ImageFeatures(np.ascontiguousarray(descriptor.T), xy[:, :2])

    def __enter__(self) -> HlocFeatures:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def _array(self, dataset: Any, name: str) -> np.ndarray:
        # Damaged headers name floats of 16 bytes, which no program writes.
        if not isinstance(dataset, self._dataset) or dataset.dtype.kind not in "fiu" or dataset.dtype.itemsize > 8:
            raise InputError(f"{self.path} has features of {name} that are no numbers; extract features again")
        if dataset.size * dataset.dtype.itemsize > _MOST_INFLATED * dataset.id.get_storage_size():
            raise InputError(f"{self.path} is damaged in the features of {name}; extract features again")
        return dataset[()]

    @contextmanager
    def _complete(self) -> Iterator[None]:
        try:
            yield
        except InputError:
            raise
        except Exception as error:  # h5py raises OSError, KeyError, RuntimeError, ValueError on damaged bytes
            reason = " ".join(str(error).split())[:120]
            raise InputError(
                f"{self.path} is truncated or damaged; expected a complete HDF5 file ({reason})"
            ) from error


def _kind(file_name: str) -> str:
    """Kind of features by hloc's names of files."""
    named = re.match(r"feats-([a-z0-9]+)", file_name.lower())
    return named[1] if named and named[1] in HLOC_KINDS else UNKNOWN_KIND
