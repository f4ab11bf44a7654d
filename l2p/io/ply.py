"""PLY files, by plyfile: reads ascii and binary ones, writes little-endian binary."""

from __future__ import annotations

import io
import warnings
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from l2p.errors import InputError
from l2p.io.colours import as_rgb

_RGB = ("red", "green", "blue")
#: Largest step of a coordinate in single precision, over the size of the cloud: far below the distances of its points.
_LOST = 1e-6
# The same as other programs name them.
_OTHER_RGB = (("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"), ("Red", "Green", "Blue"))


def ply_elements(path: str | PathLike[str]) -> dict[str, np.ndarray]:
    """Read the structured array of each element of a PLY file; InputError if it is damaged."""
    from plyfile import PlyData

    content = _ascii_header(Path(path).read_bytes())
    _check_counts(path, content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of numpy, about empty lists
            # From memory: plyfile does not close ascii files, and maps binary ones.
            return {element.name: element.data for element in PlyData.read(io.BytesIO(content)).elements}
    except Exception as error:  # plyfile and numpy raise many types on damaged bytes
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path} is truncated or damaged; expected a complete PLY file ({reason})") from error


def _ascii_header(content: bytes) -> bytes:
    """The file with a question mark for each byte of its header that is not ASCII: a comment may have any encoding."""
    header, end, body = content.partition(b"end_header")
    return content if header.isascii() else header.decode("latin-1").encode("ascii", errors="replace") + end + body


def _check_counts(path: str | PathLike[str], content: bytes) -> None:
    """Refuse a header that claims more numbers than the file has bytes: plyfile would allocate them."""
    newline = b"\r\n" if content[3:5] == b"\r\n" else content[3:4]
    header, end, body = content.partition(newline + b"end_header" + newline)
    if not newline or not end:
        return  # plyfile reports the error
    needed = rows = properties = 0
    for line in [*header.decode("latin-1").split(newline.decode("latin-1")), "element end 0"]:
        words = line.split()
        if words[:1] == ["property"]:
            properties += 1
        elif words[:1] == ["element"]:
            # A row takes at least a byte per property, or a line end; the last line end may be missing.
            needed += rows * max(properties, 1)
            rows, properties = _count(words[-1]), 0
    if needed > len(body) + 1:
        raise InputError(
            f"{path} is truncated or damaged: its header claims at least {needed} numbers in {len(body)} bytes; "
            "expected a complete PLY file"
        )


def _count(word: str) -> int:
    try:
        return max(int(word), 0)
    except ValueError:
        return 0


def ply_columns(path: str | PathLike[str], element: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Stack the named properties of an element as columns, (rows, len(names)), in native byte order."""
    missing = [name for name in names if name not in (element.dtype.names or ())]
    if missing:
        raise InputError(f"{path} lacks the property {missing[0]}; expected {', '.join(names)}")
    if any(element[name].dtype.kind not in "fiu" for name in names):
        raise InputError(f"{path} has {', '.join(names)} that are lists; expected one number each")
    columns = np.stack([element[name] for name in names], axis=1)
    return columns.astype(columns.dtype.newbyteorder("="))


def ply_rgb(element: np.ndarray) -> UInt8[np.ndarray, "rows 3"] | None:
    """The colours of an element, of 8 or 16 bits or as shares, by any of their names; None if it has none."""
    known = element.dtype.names or ()
    for names in (_RGB, *_OTHER_RGB):
        if all(name in known and element[name].dtype.kind in "fiu" for name in names):
            columns = np.stack([element[name] for name in names], axis=1)
            return as_rgb(columns.astype(columns.dtype.newbyteorder("=")))
    return None


def ply_bytes(elements: dict[str, np.ndarray]) -> bytes:
    """Encode the elements as a little-endian binary PLY file."""
    from plyfile import PlyData, PlyElement

    buffer = io.BytesIO()
    PlyData([PlyElement.describe(data, name) for name, data in elements.items()], byte_order="<").write(buffer)
    return buffer.getvalue()


def point_records(
    xyz: np.ndarray, rgb: np.ndarray | None, confidence: np.ndarray | None = None, double: bool | None = None
) -> np.ndarray:
    """The vertex element of a point cloud: x, y, z; uint8 colours and float32 confidence if given.

    Coordinates have 32 bits, which every reader knows (PCL finds no others), or 64 if these would lose digits
    (:func:`loses_digits`) or ``double`` is True.
    """
    kind = "<f8" if (loses_digits(xyz) if double is None else double) else "<f4"
    columns = {name: (kind, xyz[:, axis]) for axis, name in enumerate("xyz")}
    if rgb is not None:
        columns |= {name: ("u1", rgb[:, channel]) for channel, name in enumerate(_RGB)}
    if confidence is not None:
        columns["confidence"] = ("<f4", confidence)
    records = np.empty(len(xyz), dtype=[(name, kind) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        records[name] = values
    return records


def loses_digits(xyz: np.ndarray) -> bool:
    """Whether single precision moves points by more than a millionth of the size of the cloud, as in coordinates of a
    country.

    >>> cloud = np.array([[0.0, 0, 0], [100, 80, 9]])
    >>> loses_digits(cloud), loses_digits(cloud + [500_000, 5_400_000, 0])
    (False, True)
    """
    if not len(xyz):
        return False
    # Without the farthest points, which would pass for a large cloud.
    low, high = np.quantile(xyz, (0.05, 0.95), axis=0)
    step = np.spacing(np.abs(xyz).max(axis=0).astype(np.float32))
    return bool(step.max() > _LOST * (high - low).max())
