"""What is wrong with a COLMAP model that pycolmap does not read: the first line, record or image that does not fit."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from l2p.errors import InputError
from l2p.io.colmap_folders import TABLES, is_binary
from l2p.io.colmap_tables import (
    ELEMENT,
    ImageRecord,
    image_lines,
    image_records,
    point_lines,
    point_records,
    read_points,
    shown,
    signed,
)
from l2p.maps.short_repr import short_repr

#: A record of cameras.bin before the parameters: id, model, width, height.
_CAMERA = struct.Struct("<IiQQ")
#: Parameters of each camera model of COLMAP, by its number.
_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)


@dataclass(frozen=True, eq=False)
class _Tracks:
    """Elements of all tracks.

    Attributes
    ----------
    rows : (elements, 3) int64
        Point, image, keypoint.
    line : (elements,) int64
        Line of a text; 0 in a binary file.
    points : frozenset of int
        Ids of all points, also of those without a track.
    """

    rows: Int[np.ndarray, "elements 3"]
    line: Int[np.ndarray, " elements"]
    points: frozenset[int]

    __repr__ = short_repr


def first_fault(folder: str | PathLike[str]) -> str | None:
    """Describe the first fault of the tables that l2p reads in a model folder, in a few words; None if they fit.

    Cameras are looked at first, then images, then points by themselves, then whether tracks and images refer to each
    other.
    """
    ending = "bin" if is_binary(folder) else "txt"
    cameras, images, points = (Path(folder) / f"{table}.{ending}" for table in TABLES)
    missing = [file.name for file in (cameras, images, points) if not file.is_file()]
    if missing:
        return f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
    try:
        known, records, tracks = (
            _read(file, reader) for file, reader in ((cameras, _cameras_of), (images, _images_of), (points, _tracks_of))
        )
    except InputError as error:
        return str(error)
    for record in records:
        if record.camera not in known:
            where = _at(images, record.line)
            return f"{where}image {record.image} ({record.name}) has camera {record.camera}, which {cameras.name} lacks"
    return _contradiction(images, records, points, tracks)


def _read(file: Path, reader: Callable[[Path, bytes], Any]) -> Any:
    """What a reader makes of a file; InputError that names the file, if it is damaged."""
    try:
        return reader(file, file.read_bytes())
    except (struct.error, ValueError, OverflowError) as error:
        said = str(error) if isinstance(error, InputError) else "is truncated or damaged"
        raise InputError(said if said.startswith(file.name) else f"{file.name} {said}") from error


def _cameras_of(file: Path, content: bytes) -> set[int]:
    """Ids of the cameras; InputError for one that pycolmap does not know."""
    import pycolmap

    models = {int(value): name for name, value in pycolmap.CameraModelId.__members__.items() if int(value) >= 0}
    names = set(models.values())
    ids: set[int] = set()
    if file.suffix == ".txt":
        for number, line in enumerate(content.split(b"\n"), start=1):
            words = line.split()
            if words and not words[0].startswith(b"#"):
                if len(words) < 5 or words[1].decode("latin-1") not in names:
                    raise InputError(f"line {number} is {shown(line)}; expected CAMERA_ID, MODEL, WIDTH, HEIGHT, ...")
                ids.add(int(words[0]))
        return ids
    at = 8
    for _ in range(int.from_bytes(content[:8], "little")):
        camera, model, *_ = _CAMERA.unpack_from(content, at)
        if model not in models or model >= len(_PARAMETERS):
            raise InputError(f"has camera {camera} of model {model}, which this pycolmap does not know")
        at += _CAMERA.size + 8 * _PARAMETERS[model]
        ids.add(camera)
    if at != len(content):
        raise ValueError("the file ends elsewhere")
    return ids


def _images_of(file: Path, content: bytes) -> list[ImageRecord]:
    """All images; InputError for one without a pose or a line of keypoints."""
    records = list(image_lines(content) if file.suffix == ".txt" else image_records(content))
    for record in records:
        if not np.isfinite(record.pose).all():
            raise InputError(f"{_line(record.line)}has image {record.image} ({record.name}), whose pose is not finite")
        if record.points is None:
            raise InputError(
                f"line {record.line} has image {record.image} ({record.name}), whose line of keypoints is missing"
            )
    return records


def _tracks_of(file: Path, content: bytes) -> _Tracks:
    """All tracks; InputError for a line without one, or with half an element."""
    read_points(file)
    ids, parts, lines = [], [], []
    if file.suffix == ".txt":
        for number, words in point_lines(content):
            track = words[8].split() if len(words) > 8 else []
            if len(words) < 8 or len(track) % 2:
                raise InputError(
                    f"line {number} has {min(len(words), 8) + len(track)} words; expected POINT3D_ID, X, Y, Z, R, G, "
                    "B, ERROR and pairs of IMAGE_ID, POINT2D_IDX"
                )
            ids.append(signed(int(words[0])))
            parts.append(np.array(track, dtype=np.bytes_).astype(np.int64).reshape(-1, 2))
            lines.append(number)
    else:
        for record, begin in point_records(content):
            count = int.from_bytes(record[-8:], "little")
            ids.append(int.from_bytes(record[:8], "little", signed=True))
            track = np.frombuffer(content, ELEMENT, count, begin)
            parts.append(np.stack([track["image"], track["keypoint"]], axis=1).astype(np.int64))
            lines.append(0)
    lengths = [len(part) for part in parts]
    owner = np.repeat(np.array(ids, dtype=np.int64), lengths)
    rows = np.column_stack([owner, np.concatenate([np.zeros((0, 2), dtype=np.int64), *parts])])
    return _Tracks(rows, np.repeat(np.array(lines, dtype=np.int64), lengths), frozenset(ids))


def _contradiction(images: Path, records: list[ImageRecord], points: Path, tracks: _Tracks) -> str | None:
    """The first track that the images contradict, or keypoint whose point is not there."""
    by_id = {record.image: record for record in records}
    for (point, image, keypoint), line in zip(tracks.rows.tolist(), tracks.line.tolist(), strict=True):
        seen = by_id.get(image)
        if seen is None:
            return f"{_at(points, line)}point {point} is seen by image {image}, which {images.name} lacks"
        keypoints = _points_of(seen)
        if keypoint >= len(keypoints):
            return (
                f"{_at(points, line)}point {point} is keypoint {keypoint} of image {image} ({seen.name}), which has "
                f"{len(keypoints)} in {images.name}"
            )
        if keypoints[keypoint] != point:
            return (
                f"{_at(points, line)}point {point} is keypoint {keypoint} of image {image} ({seen.name}), which "
                f"{'has no point' if keypoints[keypoint] == -1 else f'is of point {keypoints[keypoint]}'} in "
                f"{images.name}"
            )
    for record in records:
        for keypoint, point in enumerate(_points_of(record).tolist()):
            if point != -1 and point not in tracks.points:
                return (
                    f"{_at(images, record.line)}image {record.image} ({record.name}) has keypoint {keypoint} of point "
                    f"{point}, which {points.name} lacks"
                )
    return None


def _points_of(record: ImageRecord) -> Int[np.ndarray, " keypoints"]:
    return np.zeros(0, dtype=np.int64) if record.points is None else record.points


def _at(file: Path, line: int) -> str:
    return f"in {file.name}{f' line {line}' if line else ''}, "


def _line(line: int) -> str:
    return f"line {line} " if line else ""
