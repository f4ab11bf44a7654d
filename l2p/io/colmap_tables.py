"""Tables of a COLMAP model, one file at a time: points alone, and the records of images, bin or txt.

pycolmap reads whole models only. These readers take what is there: points without tracks, images without keypoints.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt64

from l2p.errors import InputError
from l2p.io.colours import byte_rgb
from l2p.io.signatures import refuse_pointer
from l2p.maps.short_repr import short_repr

#: A record of points3D.bin, before its track.
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
#: An element of a track: image, and index of its keypoint.
ELEMENT = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
#: A record of images.bin, before the name.
_IMAGE = struct.Struct("<I7dI")
#: A keypoint of images.bin; its point is -1 if it has none.
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
# Ids are uint64; -1 in a text is the largest.
_ID_MASK = (1 << 64) - 1
# Words of a point in text before its track, with and without the error.
_WHOLE, _SHORT = 8, 7


@dataclass(frozen=True, eq=False)
class PointTable:
    """Points of a model, in the order of their ids.

    Attributes
    ----------
    ids : (points,) uint64
    xyz : (points, 3) float64
    rgb : (points, 3) uint8 or None
        None if the file has something else than 8 bits there.
    error : (points,) float32 or None
        Mean reprojection error, pixels; None if a text leaves it out.
    track_length : (points,) int32 or None
        None if a text leaves out the errors and so the tracks.
    """

    ids: UInt64[np.ndarray, " points"]
    xyz: Float[np.ndarray, "points 3"]
    rgb: UInt8[np.ndarray, "points 3"] | None
    error: Float[np.ndarray, " points"] | None
    track_length: Int[np.ndarray, " points"] | None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        order = np.argsort(self.ids, kind="stable")
        for name, value in list(vars(self).items()):
            object.__setattr__(self, name, None if value is None else value[order])


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """An image of a model.

    Attributes
    ----------
    line : int
        Line of a text, from 1; 0 in a binary file.
    image : int
        Id of the image.
    pose : (7,) float64
        Quaternion (w, x, y, z) and translation, world to camera.
    camera : int
    name : str
    points : (keypoints,) int64 or None
        Point of each keypoint, -1 if none; None if the line of keypoints is missing from a text.
    """

    line: int
    image: int
    pose: Float[np.ndarray, "7"]
    camera: int
    name: str
    points: Int[np.ndarray, " keypoints"] | None

    __repr__ = short_repr


def read_points(path: str | PathLike[str]) -> PointTable:
    """Read points3D.bin or points3D.txt; under another name, the content decides which it is.

    Raises
    ------
    InputError
        If it is truncated or damaged, or a line has no point.

    Notes
    -----
    A million points take about two seconds on one core. Tracks that a text has cut short are counted as far as they go.
    """
    content = Path(path).read_bytes()
    refuse_pointer(path, content)
    if Path(path).suffix == ".bin" or b"\0" in content[:8]:
        return _points_of_records(path, content)
    return _points_of_lines(path, content)


def point_records(content: bytes) -> Iterator[tuple[bytes, int]]:
    """Walk along points3D.bin: the fixed part of each record, and where its track begins.

    Raises
    ------
    ValueError
        If the file ends within a record, or goes on after the last one.
    """
    size, at = POINT.itemsize, 8
    for _ in range(int.from_bytes(content[:8], "little")):
        record = content[at : at + size]
        at += size
        yield record, at
        at += ELEMENT.itemsize * int.from_bytes(record[-8:], "little")
        if len(record) < size or at > len(content):
            raise ValueError("the file ends within a record")
    if at != len(content):
        raise ValueError("the file goes on after the last record")


def point_lines(content: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Number of each line of points3D.txt, and its first eight words; the ninth is the rest, the track."""
    for number, line in enumerate(content.removeprefix(b"\xef\xbb\xbf").split(b"\n"), start=1):
        words = line.split(None, _WHOLE)
        if words and not words[0].startswith(b"#"):
            yield number, words


def image_records(content: bytes) -> Iterator[ImageRecord]:
    """Walk along images.bin.

    Raises
    ------
    ValueError, struct.error
        If the file ends within a record, or goes on after the last one.
    """
    at = 8
    for _ in range(int.from_bytes(content[:8], "little")):
        image, *pose, camera = _IMAGE.unpack_from(content, at)
        begin = at + _IMAGE.size
        end = content.index(b"\0", begin)
        (count,) = struct.unpack_from("<Q", content, end + 1)
        at = end + 9 + _KEYPOINT.itemsize * count
        if at > len(content):
            raise ValueError("the file ends within a record")
        points = np.frombuffer(content, _KEYPOINT, count, end + 9)["point"]
        name = content[begin:end].decode("utf-8", errors="replace")
        yield ImageRecord(0, image, np.array(pose), camera, name, points.astype(np.int64))
    if at != len(content):
        raise ValueError("the file goes on after the last record")


def image_lines(content: bytes) -> Iterator[ImageRecord]:
    """Walk along images.txt, also where lines of keypoints are empty or missing.

    Raises
    ------
    InputError
        With its number, for a line that is no image.
    """
    lines = enumerate(content.removeprefix(b"\xef\xbb\xbf").split(b"\n"), start=1)
    number, line = next(lines, (0, None))
    while line is not None:
        words = line.split(None, 9)
        if not words or words[0].startswith(b"#"):
            number, line = next(lines, (0, None))
            continue
        try:
            image, pose, camera = int(words[0]), np.array([float(word) for word in words[1:8]]), int(words[8])
            name = words[9].decode("utf-8", errors="replace").strip()
        except (ValueError, IndexError) as error:
            raise InputError(
                f"line {number} is {shown(line)}; expected IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
            ) from error
        own = number
        number, line = next(lines, (0, None))
        points = None if line is None else _keypoint_points(line)
        if points is not None:
            number, line = next(lines, (0, None))
        yield ImageRecord(own, image, pose, camera, name, points)


def camera_centers(records: list[ImageRecord]) -> Float[np.ndarray, "cameras 3"]:
    """Centres of the images, NaN where a pose is none, in the order of their ids."""
    from scipy.spatial.transform import Rotation

    pose = np.array([each.pose for each in sorted(records, key=lambda each: each.image)]).reshape(-1, 7)
    centers = np.full((len(pose), 3), np.nan)
    usable = np.isfinite(pose).all(axis=1) & (pose[:, :4] != 0).any(axis=1)
    if usable.any():
        turned = Rotation.from_quat(pose[usable][:, [1, 2, 3, 0]])
        centers[usable] = turned.inv().apply(-pose[usable, 4:])
    return centers


def signed(number: int) -> int:
    """An unsigned id of 64 bits as a signed one, as arrays of observations hold them."""
    return (number & _ID_MASK) - ((number & _ID_MASK) >> 63 << 64)


def shown(line: bytes) -> str:
    """A line of a text for a message, cut short."""
    text = " ".join(line[:200].decode("utf-8", errors="replace").split())
    return repr(text if len(text) <= 60 else text[:57] + "...")


def _points_of_records(path: str | PathLike[str], content: bytes) -> PointTable:
    try:
        table = np.frombuffer(b"".join(record for record, _ in point_records(content)), POINT)
    except ValueError as error:
        raise InputError(f"{path} is truncated or damaged; export the model again") from error
    with np.errstate(over="ignore"):  # an error that is too large becomes infinite
        error = table["error"].astype(np.float32)
    return PointTable(
        ids=table["id"].astype(np.uint64),
        xyz=table["xyz"].astype(np.float64),
        rgb=table["rgb"].copy(),
        error=error,
        track_length=table["track"].astype(np.int32),
    )


def _points_of_lines(path: str | PathLike[str], content: bytes) -> PointTable:
    ids, numbers, tracks = [], [], []
    least = _WHOLE
    for number, words in point_lines(content):
        try:
            ids.append(int(words[0]) & _ID_MASK)
            numbers.append([float(word) for word in words[1:_WHOLE]])
            if len(words) < _SHORT:
                raise ValueError("a point is cut short")
        except ValueError as error:
            raise InputError(
                f"{path} line {number} is {shown(b' '.join(words))}; expected POINT3D_ID, X, Y, Z, R, G, B, ERROR and "
                "the track"
            ) from error
        least = min(least, len(words))
        tracks.append(len(words[_WHOLE].split()) // 2 if len(words) > _WHOLE else 0)
    whole = least == _WHOLE
    table = np.array([row[: least - 1] for row in numbers], dtype=np.float64).reshape(-1, least - 1)
    with np.errstate(over="ignore"):
        error = table[:, 6].astype(np.float32) if whole else None
    return PointTable(
        ids=np.array(ids, dtype=np.uint64),
        xyz=table[:, :3],
        rgb=byte_rgb(table[:, 3:6]),
        error=error,
        track_length=np.array(tracks, dtype=np.int32) if whole else None,
    )


def _keypoint_points(line: bytes) -> Int[np.ndarray, " keypoints"] | None:
    """Points of a line of keypoints (x y point3D_id ...), none of an empty line; None if it is no such line."""
    words = line.split()
    if len(words) % 3:
        return None
    try:
        for word in words[0:2]:
            float(word)
        return np.array([signed(int(word)) for word in words[2::3]], dtype=np.int64).reshape(-1)
    except (ValueError, OverflowError):
        return None
