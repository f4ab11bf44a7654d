"""Maps in JSON, of OpenSfM, OpenMVG (``sfm_data.json``), Meshroom (``.sfm``) and nerfstudio (``transforms.json``)."""

from __future__ import annotations

import json
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError, warn
from l2p.io.colours import byte_rgb
from l2p.io.ply_points import read_ply
from l2p.maps.scene import Scene

# Point cloud beside transforms.json that does not name one.
_SPARSE = "sparse_pc.ply"
# What a map of another layout than expected leads to.
_WRONG = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError)


def read_opensfm(path: str | PathLike[str]) -> Scene:
    """Read an OpenSfM reconstruction: points, colours, ids if all are whole numbers, and camera centres.

    A file may hold several reconstructions; the one with most points is read, with a warning.

    Raises
    ------
    InputError
        If it is damaged, or laid out otherwise.

    Notes
    -----
    A shot maps world to camera by an angle-axis rotation and a translation. The observations are in tracks.csv, which
    is not read.
    """
    return _converted(path, _of_opensfm)


def read_openmvg(path: str | PathLike[str]) -> Scene:
    """Read OpenMVG's sfm_data.json: points, ids, track lengths and camera centres; errors as of OpenSfM."""
    return _converted(path, _of_openmvg)


def read_meshroom(path: str | PathLike[str]) -> Scene:
    """Read Meshroom's .sfm: points, colours, ids, track lengths and camera centres; errors as of OpenSfM."""
    return _converted(path, _of_meshroom)


def read_nerfstudio(path: str | PathLike[str]) -> Scene:
    """Read the point cloud that nerfstudio's transforms.json names, or ``sparse_pc.ply`` beside it, and the cameras.

    Raises
    ------
    InputError
        If there is no point cloud, or a file is damaged.
    """
    data = _parsed(path)
    named = data.get("ply_file_path") if isinstance(data, dict) else None
    cloud = Path(path).parent / (named if isinstance(named, str) and named else _SPARSE)
    if not cloud.is_file():
        raise InputError(
            f"{path} has cameras, and {'names' if named else 'no'} {cloud.name if named else 'ply_file_path'}"
            f"{', which is missing' if named else ''}; give the COLMAP model that it was made from (colmap/sparse/0)"
        )
    scene = read_ply(cloud)
    try:
        # Camera to world.
        centers = np.array([np.array(frame["transform_matrix"], dtype=np.float64)[:3, 3] for frame in data["frames"]])
        centers = centers.reshape(-1, 3)
    except _WRONG as error:
        raise _otherwise(path, error) from error
    return Scene(scene.xyz, scene.rgb, camera_centers=centers)


def _converted(path: str | PathLike[str], convert: Callable[[str | PathLike[str], Any], Scene]) -> Scene:
    data = _parsed(path)
    try:
        return convert(path, data)
    except InputError:
        raise
    except _WRONG as error:
        raise _otherwise(path, error) from error


def _parsed(path: str | PathLike[str]) -> Any:
    try:
        return json.loads(Path(path).read_bytes())
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError(f"{path} is truncated or damaged; expected complete JSON ({reason})") from error


def _otherwise(path: str | PathLike[str], error: Exception) -> InputError:
    reason = f"{type(error).__name__}: {error}"[:100]
    return InputError(f"{path} is laid out otherwise than its program writes it ({reason}); export it again")


def _of_opensfm(path: str | PathLike[str], data: Any) -> Scene:
    from scipy.spatial.transform import Rotation

    several = data if isinstance(data, list) else [data]
    largest = max(several, key=lambda each: len(each["points"]))
    if len(several) > 1:
        sizes = ", ".join(f"{len(each['points']):,}" for each in several)
        warn(f"{path} has {len(several)} reconstructions of {sizes} points; the largest is read")
    points, shots = list(largest["points"].values()), list(largest.get("shots", {}).values())
    centers = np.zeros((0, 3))
    if shots:
        turned = Rotation.from_rotvec(_rows([shot["rotation"] for shot in shots]))
        centers = -turned.inv().apply(_rows([shot["translation"] for shot in shots]))
    coloured = bool(points) and all("color" in point for point in points)
    return Scene(
        xyz=_rows([point["coordinates"] for point in points]),
        # Means of 8-bit colours.
        rgb=byte_rgb(_rows([point["color"] for point in points])) if coloured else None,
        ids=_ids(list(largest["points"])),
        camera_centers=centers,
    )


def _of_openmvg(path: str | PathLike[str], data: Any) -> Scene:
    points = data["structure"]
    return Scene(
        xyz=_rows([point["value"]["X"] for point in points]),
        track_length=_lengths([point["value"].get("observations") for point in points]),
        ids=_ids([point["key"] for point in points]),
        camera_centers=_rows([pose["value"]["center"] for pose in data.get("extrinsics", [])]),
    )


def _of_meshroom(path: str | PathLike[str], data: Any) -> Scene:
    if not data.get("structure"):
        raise InputError(f"{path} has no structure; convert it with Meshroom's ConvertSfMFormat, with the structure")
    points = data["structure"]
    coloured = all("color" in point for point in points)
    return Scene(
        xyz=_rows([point["X"] for point in points]),
        rgb=byte_rgb(_rows([point["color"] for point in points])) if coloured else None,
        track_length=_lengths([point.get("observations") for point in points]),
        ids=_ids([point["landmarkId"] for point in points]),
        camera_centers=_rows([pose["pose"]["transform"]["center"] for pose in data.get("poses", [])]),
    )


def _rows(values: list[Any]) -> Float[np.ndarray, "rows 3"]:
    """Rows of three numbers, which may be texts."""
    table = np.array([[float(number) for number in row] for row in values], dtype=np.float64)
    if values and table.shape[1:] != (3,):
        raise ValueError("expected rows of three numbers")
    return table.reshape(-1, 3)


def _ids(keys: list[Any]) -> np.ndarray | None:
    """Ids as int64; None unless all are whole numbers, each one once."""
    if not all(isinstance(key, int) or (isinstance(key, str) and key.isascii() and key.isdecimal()) for key in keys):
        return None
    numbers = [int(key) for key in keys]
    if len(set(numbers)) < len(numbers) or not all(0 <= number < 2**63 for number in numbers):
        return None
    return np.array(numbers, dtype=np.int64)


def _lengths(observations: list[Any]) -> np.ndarray | None:
    """Track lengths; None if a point has no observations."""
    if any(each is None for each in observations):
        return None
    return np.array([len(each) for each in observations], dtype=np.int32)
