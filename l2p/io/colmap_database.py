"""Features of images in COLMAP's ``database.db``, read by its documented tables.

Python's sqlite3 reads it: pycolmap's database beside sqlite3 in one process can crash when the process ends.
"""

from __future__ import annotations

import sqlite3
from functools import cached_property
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from l2p.errors import InputError
from l2p.io.track_means import ImageFeatures
from l2p.maps.appearance import SIFT

# Kinds of descriptors by COLMAP's FeatureExtractorType; all but SIFT are float32, as bytes. Databases before COLMAP 4
# have no type.
_KINDS = {0: SIFT, 1: "aliked-n16rot", 2: "aliked-n32", 3: "loma-b", 4: "loma-b128"}
_NO_TYPE = -1
# Bytes of a descriptor that is SIFT if the database does not say it.
_SIFT_BYTES = 128


class ColmapDatabase:
    """The features of a database; nothing is written, not even beside it.

    Raises
    ------
    InputError
        If it is damaged, no database of COLMAP, or has changes that are not yet in the file.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = path
        log = Path(f"{path}-wal")
        if log.is_file() and log.stat().st_size:
            raise InputError(f"{path} has changes that are still in {log.name}; open and close it with COLMAP first")
        # Immutable: no locks, no files beside it.
        address = f"{Path(path).absolute().as_uri()}?mode=ro&immutable=1"
        self._database = sqlite3.connect(address, uri=True)
        try:
            columns = {str(row[1]) for row in self._rows("PRAGMA table_info(descriptors)")}
            if not columns:
                raise InputError(f"{path} has no table of descriptors; expected a database of COLMAP")
            self._type = "type" if "type" in columns else str(_NO_TYPE)
        except BaseException:
            self._database.close()
            raise

    def has_features(self) -> bool:
        """Whether there is any descriptor: hloc fills a database with keypoints alone."""
        return bool(self._rows("SELECT 1 FROM descriptors WHERE rows > 0 LIMIT 1"))

    @cached_property
    def kind(self) -> str:
        """What computed the descriptors; InputError if there are none, or they are not of one known kind."""
        found = self._rows(f"SELECT DISTINCT {self._type}, cols FROM descriptors WHERE rows > 0")
        if not found:
            raise InputError(f"{self.path} has no descriptors; give the file that has them, as hloc's features (h5)")
        types = {_NO_TYPE if row[0] is None else row[0] for row in found}
        if len(types) > 1:
            raise InputError(f"{self.path} has descriptors of {len(types)} types; expected one")
        (number,) = types
        if number == _NO_TYPE and {row[1] for row in found} == {_SIFT_BYTES}:
            return SIFT
        if number not in _KINDS:
            raise InputError(
                f"{self.path} has descriptors of type {number}, {found[0][1]} bytes each, unknown to this l2p; give "
                "them as npz with point3D_id and descriptor"
            )
        return _KINDS[number]

    def of_image(self, name: str) -> ImageFeatures | None:
        """Read the features of the image of this name; None if the database has none."""
        where = "JOIN images USING (image_id) WHERE images.name = ?"
        found = self._rows(f"SELECT rows, cols, data FROM descriptors {where}", name)
        if not found:
            return None
        descriptor = self._matrix(found[0], np.uint8 if self.kind == SIFT else np.float32, name)
        keypoints = self._rows(f"SELECT rows, cols, data FROM keypoints {where}", name)
        xy = self._matrix(keypoints[0], np.float32, name, 4) if keypoints else None
        if xy is not None and (len(xy) != len(descriptor) or (len(xy) and xy.shape[1] < 2)):
            raise InputError(
                f"{self.path} has {len(xy)} keypoints and {len(descriptor)} descriptors of {name}; expected one each"
            )
        return ImageFeatures(descriptor, None if xy is None else xy[:, :2].reshape(-1, 2))

    def __enter__(self) -> ColmapDatabase:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._database.close()

    def _rows(self, query: str, *values: str) -> list[tuple[Any, ...]]:
        try:
            return self._database.execute(query, values).fetchall()
        except (sqlite3.Error, UnicodeError, OverflowError) as error:
            raise InputError(
                f"{self.path} is damaged or no database of COLMAP ({error}); extract features again"
            ) from error

    def _matrix(self, row: tuple[Any, ...], dtype: type[np.generic], name: str, size: int = 1) -> np.ndarray:
        """Decode (rows, cols, data); columns are of ``size`` bytes."""
        rows, cols, data = row
        data = b"" if data is None else data
        whole = all(isinstance(number, int) and number >= 0 for number in (rows, cols)) and isinstance(data, bytes)
        width = cols * size if whole else 0
        if not whole or rows * width != len(data) or width % np.dtype(dtype).itemsize:
            raise InputError(f"{self.path} is damaged in the features of {name}; extract features again")
        return np.frombuffer(data, dtype=np.dtype(dtype).newbyteorder("<")).reshape(rows, -1 if rows else 0)
