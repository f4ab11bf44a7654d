"""COLMAP models, by pycolmap: reads points, and writes the same model with its points moved."""

from __future__ import annotations

import os
import struct
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.io.atomic import atomic_folder, check_folder
from l2p.maps.scene import Scene
from l2p.maps.upright import up_of

_TABLES = ("cameras", "images", "points3D", "rigs", "frames")

#: The files of a model: what ``--force`` may replace in an output folder.
MODEL_FILES = frozenset(f"{table}.{ending}" for table in _TABLES for ending in ("bin", "txt"))

#: COLMAP's value for an unknown reprojection error.
NO_ERROR = -1.0

# Mean reprojection error, in pixels, from which on it is COLMAP's placeholder for a point behind one of its cameras.
_BEHIND = 1e9


def read_model(path: str | PathLike[str]) -> Any:
    """Read a model folder (bin or txt) as a ``pycolmap.Reconstruction``.

    Raises
    ------
    InputError
        If a file is missing, truncated or damaged, or tracks and images contradict each other.
    """
    import pycolmap

    if not Path(path).is_dir():
        raise InputError(f"{path} is not a folder; expected a COLMAP model folder")
    if is_binary(path):
        _check_sizes(path)
    # COLMAP's log of a damaged model is silenced; the InputError gives the reason.
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, int(pycolmap.logging.FATAL)
    try:
        model = pycolmap.Reconstruction(str(path))
        consistent = model.is_valid()
    except Exception as error:  # pycolmap raises ValueError, IndexError, RuntimeError, each for many causes
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"{path} is not a complete COLMAP model; export it again ({reason})") from error
    finally:
        pycolmap.logging.minloglevel = level
    if not consistent:
        raise InputError(f"{path} is damaged: its tracks and images contradict each other; export the model again")
    if is_binary(path) and _camera_bytes(model) != (Path(path) / "cameras.bin").stat().st_size:
        raise InputError(f"{path}/cameras.bin is truncated or damaged; export the model again")
    return model


def is_binary(path: str | PathLike[str]) -> bool:
    """Whether COLMAP reads the binary files of a model folder (it prefers them to text)."""
    return (Path(path) / "points3D.bin").is_file()


def scene_of_model(model: Any) -> Scene:
    """Points, colours, errors, track lengths, ids (in increasing order), camera centres and up of a model."""
    ids = sorted(model.point3D_ids())
    points = [model.points3D[key] for key in ids]
    posed = [image for _, image in sorted(model.images.items()) if image.has_pose]
    rotations = [image.cam_from_world().rotation.matrix() for image in posed]
    with np.errstate(over="ignore"):  # an error that is too large becomes infinite
        error = np.array([point.error for point in points]).astype(np.float32)
    return Scene(
        xyz=np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        rgb=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        error=error,
        track_length=np.array([point.track.length() for point in points], dtype=np.int32),
        ids=np.array(ids, dtype=np.int64),
        camera_centers=np.array([image.projection_center() for image in posed], dtype=np.float64).reshape(-1, 3),
        up=up_of(np.array(rotations, dtype=np.float64).reshape(-1, 3, 3)),
    )


def save_recovered_model(
    model_path: str | PathLike[str],
    ids: Int[np.ndarray, " ids"],
    xyz: Float[np.ndarray, "points 3"],
    out_path: str | PathLike[str],
    *,
    overwrite: bool = False,
) -> None:
    """Write the model of ``model_path`` with its points moved to the recovered positions.

    Parameters
    ----------
    ids : (points,) int64
        ``point3D_id`` of each recovered point. All other points of the model are deleted, with their entries in
        the images, so that every track still refers to an image that refers back.
    xyz : (points, 3) float64
        Recovered points, scene units.
    out_path : path
        A folder; written whole or not at all, in the format (bin or txt) of the input, never onto the input.

    Raises
    ------
    InputError
        If the output must not be written, the model is damaged, or an id is repeated or not in the model.

    Notes
    -----
    Reprojection errors are computed anew for the moved points; for a point that is now behind a camera that sees it,
    the error is -1, COLMAP's value for an unknown one. Cameras and poses are those of the input.
    """
    check_model_output(model_path, out_path, overwrite=overwrite)
    if len(ids) != len(xyz):
        raise InputError(f"got {len(ids)} ids and {len(xyz)} points; expected one id for each point")
    model = check_ids(model_path, ids)
    _move_points(model, ids, xyz)
    with atomic_folder(out_path, overwrite=overwrite, replaceable=MODEL_FILES) as folder:
        if is_binary(model_path):
            model.write_binary(str(folder))
        else:
            model.write_text(str(folder))
        # COLMAP does not report a full disk.
        _check_written(folder, model)


def check_model_output(
    model_path: str | PathLike[str], out_path: str | PathLike[str], *, overwrite: bool = False
) -> None:
    """Raise InputError for an output folder that is, holds or lies in the input model, or must not be written."""
    source, target = os.path.realpath(model_path), os.path.realpath(out_path)
    if os.path.commonpath([source, target]) in (source, target):
        raise InputError(f"{out_path} and the model {model_path} share a folder; choose another output folder")
    check_folder(out_path, overwrite=overwrite, replaceable=MODEL_FILES)


def check_ids(model_path: str | PathLike[str], ids: Int[np.ndarray, " points"]) -> Any:
    """Read the model; InputError if it lacks one of the point ids, or an id is repeated."""
    model = read_model(model_path)
    wanted = {int(key) for key in ids}
    if len(wanted) != len(ids):
        raise InputError(f"got {len(ids) - len(wanted)} repeated point ids; expected each point once")
    unknown = wanted - set(model.point3D_ids())
    if unknown:
        raise InputError(
            f"{model_path} lacks {len(unknown)} of the {len(ids)} point ids, {min(unknown)} among them; give the model "
            "that was lifted"
        )
    return model


def _move_points(model: Any, ids: Int[np.ndarray, " points"], xyz: Float[np.ndarray, "points 3"]) -> None:
    wanted = {int(key) for key in ids}
    for key in set(model.point3D_ids()) - wanted:
        model.delete_point3D(key)
    points = model.points3D
    for key, position in zip(ids, xyz, strict=True):
        points[int(key)].xyz = position
    model.update_point_3d_errors()
    for key in wanted:
        if not points[key].error < _BEHIND:
            points[key].error = NO_ERROR


def _check_written(folder: Path, model: Any) -> None:
    """Read the written model back; OSError if it is not complete."""
    try:
        complete = read_model(folder).num_points3D() == model.num_points3D()
    except InputError:
        complete = False
    if not complete:
        raise OSError("not all of the model was written; is the disk full?")


def _check_sizes(path: str | PathLike[str]) -> None:
    """Refuse truncated binary tables: COLMAP reads past the end of a file, for hours if a count is damaged."""
    walks = {"points3D": _walk_points, "images": _walk_images, "rigs": _walk_rigs, "frames": _walk_frames}
    for table, walk in walks.items():
        file = Path(path) / f"{table}.bin"
        if not file.is_file():
            continue
        content = file.read_bytes()
        try:
            complete = walk(content) == len(content)
        except (struct.error, ValueError, OverflowError):
            complete = False
        if not complete:
            raise InputError(f"{file} is truncated or damaged; export the model again")
    cameras = Path(path) / "cameras.bin"
    if cameras.is_file():
        content = cameras.read_bytes()
        # The length of a record depends on the camera model, which has at least three parameters.
        if 8 + 48 * int.from_bytes(content[:8], "little") > len(content):
            raise InputError(f"{cameras} is truncated or damaged; export the model again")


def _camera_bytes(model: Any) -> int:
    """Size of cameras.bin: id, camera model, width, height, and the parameters of the camera model."""
    return 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())


def _walk_points(content: bytes) -> int:
    """End of the last record of points3D.bin: id, xyz, rgb, error, track of (image, index)."""
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        (track,) = struct.unpack_from("<Q", content, at + 43)
        at += 51 + 8 * track
    return at


def _walk_images(content: bytes) -> int:
    """End of the last record of images.bin: id, pose, camera, name ended by a zero byte, keypoints."""
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        at = content.index(b"\0", at + 64) + 1
        (keypoints,) = struct.unpack_from("<Q", content, at)
        at += 8 + 24 * keypoints
    return at


def _walk_rigs(content: bytes) -> int:
    """End of the last record of rigs.bin: id, sensors; the first is the reference, the others may have a pose."""
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        _, sensors = struct.unpack_from("<II", content, at)
        at += 16 if sensors else 8
        for _ in range(sensors - 1):
            (has_pose,) = struct.unpack_from("<?", content, at + 8)
            at += 65 if has_pose else 9
    return at


def _walk_frames(content: bytes) -> int:
    """End of the last record of frames.bin: id, rig, pose, images of the frame."""
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        (images,) = struct.unpack_from("<I", content, at + 64)
        at += 68 + 16 * images
    return at
