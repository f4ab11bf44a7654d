"""Formats of other programs, by the first bytes of a file, or by its ending where the content does not tell."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable
from os import PathLike
from pathlib import Path

import numpy as np

from l2p.errors import InputError

#: Maps and point clouds of other programs that l2p reads, as messages name them.
COLMAP_POINTS = "the points of a COLMAP model"
BUNDLER = "a Bundler map"
NVM = "a VisualSFM map (NVM)"
OPENSFM = "an OpenSfM map"
OPENMVG = "an OpenMVG map"
MESHROOM = "a Meshroom map"
NERFSTUDIO = "a nerfstudio data set"
XYZ_TEXT = "a point cloud (xyz, pts)"
PCD = "a point cloud (PCD)"

#: Endings of texts of points: nothing in such a file tells points with normals from lines.
POINT_ENDINGS = (".xyz", ".xyzn", ".xyzrgb", ".pts", ".asc")

_TO_PLY = "convert it to PLY, for example with CloudCompare"
_UNPACK = "unpack it, and give what is in it"
_OF_MODEL = "give the folder of the model"
_AS_NPZ = "write its points with numpy.savez(FILE, xyz=...)"

# What l2p does not read, and the way out.
_LAS = ("a LAS or LAZ point cloud", "convert it to PLY, for example with pdal translate or CloudCompare")
_E57 = ("an E57 point cloud", _TO_PLY)
_HDF5 = ("an HDF5 file, as hloc's features", f"{_OF_MODEL}, and the features to --descriptors")
_MATLAB = ("a MATLAB file", f"read it with scipy.io.loadmat, and {_AS_NPZ}")
_PICKLE = ("a file of Python or PyTorch objects", f"{_AS_NPZ}, since l2p runs no code")
_SPLATS = ("a file of Gaussian splats", "give the COLMAP model that it was trained from, or its PLY")
_METASHAPE = ("a Metashape project", "export its tie points as PLY, or the project as COLMAP")
_BAG = ("a ROS bag", "give the map that was made from it, such as a COLMAP model or a PLY")
_GLTF, _FBX = ("a glTF model", _TO_PLY), ("an FBX model", _TO_PLY)
_STL, _OFF = ("an STL mesh", _TO_PLY), ("an OFF mesh", _TO_PLY)

#: By the bytes at the beginning of a file.
_REFUSED: dict[bytes, tuple[str, str]] = {
    b"LASF": _LAS,
    b"ASTM-E57": _E57,
    b"\x89HDF\r\n\x1a\n": _HDF5,
    b"SQLite format 3\0": ("a database, as COLMAP's of features", f"{_OF_MODEL}, and it to --descriptors"),
    b"glTF": _GLTF,
    b"Kaydara FBX": _FBX,
    b"solid ": _STL,
    b"OFF\n": _OFF,
    b"#VRML": ("a VRML model", _TO_PLY),
    b"#usda": ("a USD scene", _TO_PLY),
    b"PXR-USDC": ("a USD scene", _TO_PLY),
    b"Ogawa": ("an Alembic scene, as Meshroom's", "convert it to .sfm with Meshroom's ConvertSfMFormat"),
    b"MATLAB 5.0": _MATLAB,
    b"PAR1": ("a Parquet table", _AS_NPZ),
    b"#ROSBAG": _BAG,
    b"\x80\x02": _PICKLE,
    b"\x80\x03": _PICKLE,
    b"\x80\x04": _PICKLE,
    b"\x80\x05": _PICKLE,
    b"\x1f\x8b": ("a gzip archive", _UNPACK),
    b"BZh": ("a bzip2 archive", _UNPACK),
    b"\xfd7zXZ\0": ("an xz archive", _UNPACK),
    b"\x28\xb5\x2f\xfd": ("a zstd archive", _UNPACK),
    b"7z\xbc\xaf\x27\x1c": ("a 7z archive", _UNPACK),
    b"Rar!": ("a RAR archive", _UNPACK),
    b"\xff\xd8\xff": ("a JPEG picture", "give the map that was made from the pictures"),
    b"\x89PNG": ("a PNG picture", "give the map that was made from the pictures"),
    b"%PDF": ("a PDF document", "give a map or a line cloud"),
}
#: By the ending of a file whose content does not tell.
_REFUSED_ENDINGS: dict[str, tuple[str, str]] = {
    ".las": _LAS,
    ".laz": _LAS,
    ".e57": _E57,
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".glb": _GLTF,
    ".gltf": _GLTF,
    ".fbx": _FBX,
    ".stl": _STL,
    ".off": _OFF,
    ".ptx": ("a PTX scan", _TO_PLY),
    ".dxf": ("a DXF drawing", _TO_PLY),
    ".tar": ("a tar archive", _UNPACK),
    ".splat": _SPLATS,
    ".spz": _SPLATS,
    ".psx": _METASHAPE,
    ".psz": _METASHAPE,
    ".rcproj": ("a RealityCapture project", "export it as COLMAP, Bundler or PLY"),
    ".pt": _PICKLE,
    ".pth": _PICKLE,
    ".pkl": _PICKLE,
    ".mat": _MATLAB,
    ".bag": _BAG,
}
_POINTER = b"version https://git-lfs.github.com/spec/"
#: Name of the points of a COLMAP model, also of a copy such as ``points3D_filtered.txt``.
_POINTS_NAME = re.compile(r"points3D.*\.(bin|txt)$")
#: Names of the other tables.
_TABLE_NAME = re.compile(r"(cameras|images|rigs|frames)\.(bin|txt)$")
# Records at the beginning of a file that must look like points, for it to be taken for points3D.bin.
_RECORDS = 4
# Keys of JSON by the program that writes them.
_JSON = (
    (OPENMVG, (b'"sfm_data_version"',)),
    (MESHROOM, (b'"featuresFolders"', b'"poseId"', b'"landmarkId"')),
    (NERFSTUDIO, (b'"frames"', b'"ply_file_path"', b'"camera_angle_x"', b'"transform_matrix"')),
    (OPENSFM, (b'"shots"', b'"points"', b'"cameras"', b'"rig_instances"')),
)


def foreign(path: str | PathLike[str], head: bytes) -> str | None:
    """Name the format of another program; None if the file is of none of them.

    Parameters
    ----------
    head : bytes
        The beginning of the file.

    Raises
    ------
    InputError
        If it is of a format that l2p does not read; the message says what to do.
    """
    refuse_pointer(path, head)
    name, ending = Path(path).name, Path(path).suffix.lower()
    for begins, said in _REFUSED.items():
        if head.startswith(begins):
            raise _refusal(path, *said)
    for what, is_one in _READ:
        if is_one(head):
            return what
    if _POINTS_NAME.match(name) or _is_points_table(head, os.path.getsize(path)):
        return COLMAP_POINTS
    if _TABLE_NAME.match(name):
        raise _refusal(path, "a table of a COLMAP model without its points", _OF_MODEL)
    if ending in _REFUSED_ENDINGS:
        raise _refusal(path, *_REFUSED_ENDINGS[ending])
    if ending in POINT_ENDINGS and b"\0" not in head:
        return XYZ_TEXT
    if head.lstrip()[:1] == b"<":
        raise _refusal(path, "a web page or XML document", "give a map or a line cloud")
    return _json(path, head)


def refuse_pointer(path: str | PathLike[str], head: bytes) -> None:
    """Raise InputError for what Git LFS leaves in place of a file that was not downloaded."""
    if head.startswith(_POINTER):
        raise InputError(f"{path} is a Git LFS pointer, not the file itself; run git lfs pull")


def _refusal(path: str | PathLike[str], what: str, way_out: str) -> InputError:
    return InputError(f"{path} is {what}, which l2p does not read; {way_out}")


def _json(path: str | PathLike[str], head: bytes) -> str | None:
    """The program that wrote a JSON file; None if it is none."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text[:1] == b"{" or re.match(rb"\[\s*[{\]]", text):
        for what, keys in _JSON:
            if any(key in head for key in keys):
                return what
        raise InputError(f"{path} is JSON of no map that l2p knows; expected OpenSfM, OpenMVG, Meshroom or nerfstudio")
    return None


def _is_bundler(head: bytes) -> bool:
    return head.startswith(b"# Bundle file")


def _is_nvm(head: bytes) -> bool:
    return head.startswith(b"NVM_V")


def _is_pcd(head: bytes) -> bool:
    """Whether it begins as PCD: comments, then VERSION or FIELDS."""
    return re.match(rb"(?:#[^\n]*\n|\s)*(?:VERSION\s+\.?\d|FIELDS\s+\w)", head) is not None


def _is_points_table(head: bytes, size: int) -> bool:
    """Whether a file begins as points3D.bin or points3D.txt does."""
    return _begins_with_records(head, size) if b"\0" in head[:8] else _begins_with_points(head)


def _begins_with_records(head: bytes, size: int) -> bool:
    """Whether the first records are points: in range, of an error that may be, and with the bytes that they need."""
    (count,) = struct.unpack("<Q", head[:8].ljust(8, b"\xff"))
    if count == 0 or 8 + 51 * count > size:
        return False
    at = 8
    for _ in range(min(_RECORDS, count)):
        if at + 51 > len(head):
            break
        x, y, z, error, track = (
            *struct.unpack_from("<3d", head, at + 8),
            *struct.unpack_from("<dQ", head, at + 35),
        )
        # Denormal numbers are bytes of something else.
        plausible = all(number == 0 or 1e-300 < abs(number) < 1e30 for number in (x, y, z))
        if not (plausible and (error == -1 or 0 <= error < 1e300) and 8 * track < size):
            return False
        at += 51 + 8 * track
    return at > 8


def _begins_with_points(head: bytes) -> bool:
    """Whether the first lines are id, x, y, z, three colours, and an error with a track of pairs, or nothing."""
    if head.startswith(b"# 3D point list"):
        return True
    lines = head.split(b"\n")
    rows = [line.split() for line in lines[: max(1, len(lines) - 1)] if line.strip() and not line.startswith(b"#")]
    if not rows or any(len(row) < 7 or (len(row) > 7 and len(row) % 2) for row in rows):
        return False
    try:
        ids = [int(row[0]) for row in rows]
        places = np.array([[float(word) for word in row[1:4]] for row in rows])
        colours = [int(word) for row in rows for word in row[4:7]]
    except ValueError:
        return False
    return len(set(ids)) == len(ids) and not (places == np.round(places)).all() and set(colours) <= set(range(256))


_READ: tuple[tuple[str, Callable[[bytes], bool]], ...] = ((BUNDLER, _is_bundler), (NVM, _is_nvm), (PCD, _is_pcd))
