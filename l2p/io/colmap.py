"""COLMAP models, by pycolmap: reads points, and writes the same model with its points moved."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt64

from l2p.errors import InputError, warn
from l2p.io.atomic import atomic_folder, check_folder
from l2p.io.colmap_faults import first_fault
from l2p.io.colmap_folders import is_binary, model_folder, points_file, refuse_pointers
from l2p.io.colmap_tables import camera_centers, image_lines, image_records, point_records, read_points
from l2p.maps.scene import Scene
from l2p.maps.upright import up_of

_TABLES = ("cameras", "images", "points3D", "rigs", "frames")

#: The files of a model: what ``--force`` may replace in an output folder.
MODEL_FILES = frozenset(f"{table}.{ending}" for table in _TABLES for ending in ("bin", "txt"))

#: COLMAP's value for an unknown reprojection error.
NO_ERROR = -1.0

_LARGEST_ID = 2**63 - 1
# Mean reprojection error, in pixels, from which on it is COLMAP's placeholder for a point behind one of its cameras.
_BEHIND = 1e9


def read_model(path: str | PathLike[str]) -> Any:
    """Read a model folder (bin or txt), or the only model in the folder of a project, as a ``pycolmap.Reconstruction``.

    Raises
    ------
    InputError
        If a file is missing, truncated or damaged, or tracks and images contradict each other; the message names the
        line or the image.
    """
    folder = model_folder(path)
    try:
        return _read_whole(folder)
    except InputError as error:
        raise InputError(f"{folder} is not a complete COLMAP model: {error}; export it again") from error


def read_scene(path: str | PathLike[str]) -> tuple[Scene, Any | None]:
    """Read the points of a model, whatever its tracks, images and cameras are like.

    Parameters
    ----------
    path : path
        A model folder, the folder of a project with one model in it, or points3D.bin or points3D.txt alone.

    Returns
    -------
    (Scene, pycolmap.Reconstruction or None)
        The points, and the model; None, with a warning, if only its points can be read, or only these were given.

    Raises
    ------
    InputError
        If there is no model, or its points are damaged.
    """
    if os.path.isfile(path):
        return _scene_of_points(Path(path)), None
    folder = model_folder(path)
    file = points_file(folder)
    if all((folder / f"points3D.{ending}").is_file() for ending in ("bin", "txt")):
        warn(f"{folder} has points3D.bin and points3D.txt; {file.name} is read")
    try:
        model = _read_whole(folder)
    except InputError as error:
        scene = _scene_of_points(file)  # first: damaged points are an error
        if len(scene) == 0:
            raise InputError(f"{folder} is not a complete COLMAP model: {error}; export it again") from error
        warn(f"{folder}: only the points are read, without tracks, since {error}")
        return scene, None
    return scene_of_model(model), model


def _read_whole(folder: Path) -> Any:
    """Read a model with all its tables; InputError that says in a few words what is wrong."""
    import pycolmap

    refuse_pointers(folder)
    binary = is_binary(folder)
    if binary:
        _check_sizes(folder)
    # COLMAP's log of a damaged model is silenced; the InputError gives the reason.
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, int(pycolmap.logging.FATAL)
    try:
        model = pycolmap.Reconstruction(str(folder))
        consistent = model.is_valid()
    except Exception as error:  # pycolmap raises ValueError, IndexError, RuntimeError, each for many causes
        reason = " ".join(str(error).split())[:160]
        raise InputError(first_fault(folder) or f"pycolmap does not read it ({reason})") from error
    finally:
        pycolmap.logging.minloglevel = level
    if not consistent:
        raise InputError(first_fault(folder) or "its tracks and images contradict each other")
    if binary and _camera_bytes(model) != (folder / "cameras.bin").stat().st_size:
        raise InputError("cameras.bin is truncated or damaged")
    return model


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
        track_length=_known(np.array([point.track.length() for point in points], dtype=np.int32)),
        ids=_signed(np.array(ids, dtype=np.uint64)),
        camera_centers=np.array([image.projection_center() for image in posed], dtype=np.float64).reshape(-1, 3),
        up=up_of(np.array(rotations, dtype=np.float64).reshape(-1, 3, 3)),
    )


def _scene_of_points(file: Path) -> Scene:
    """The points of one file, and the centres of the images beside it, where these can be read."""
    table = read_points(file)
    return Scene(
        xyz=table.xyz,
        rgb=table.rgb,
        error=table.error,
        track_length=None if table.track_length is None else _known(table.track_length),
        ids=_signed(table.ids),
        camera_centers=_centers_beside(file),
    )


def _centers_beside(file: Path) -> Float[np.ndarray, "cameras 3"] | None:
    """Centres of the images in the folder of a file of points; None without images, or if they are damaged."""
    for ending in dict.fromkeys((file.suffix, ".bin", ".txt")):
        images = file.with_name(f"images{ending}")
        if images.is_file():
            content = images.read_bytes()
            try:
                records = list(image_records(content) if ending == ".bin" else image_lines(content))
            except (struct.error, ValueError, OverflowError):
                continue
            return camera_centers(records)
    return None


def _known(lengths: Int[np.ndarray, " points"]) -> Int[np.ndarray, " points"] | None:
    """Track lengths; None if no point has a track, as where points are from depth maps."""
    return lengths if lengths.any() else None


def _signed(ids: UInt64[np.ndarray, " points"]) -> Int[np.ndarray, " points"] | None:
    """Ids as int64; None, with a warning, if one is too large or repeated, so that no id tells a point."""
    if len(ids) and ids.max() > _LARGEST_ID:
        warn(f"the point id {ids.max()} is larger than 2^63 - 1; the points are read without ids")
        return None
    repeated = len(ids) - len(np.unique(ids))
    if repeated:
        warn(f"{repeated} point ids are repeated; the points are read without ids")
        return None
    return ids.astype(np.int64)


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
    model_path = model_folder(model_path)
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
    source, target = os.path.realpath(model_folder(model_path, say=False)), os.path.realpath(out_path)
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
    walks = {"points3D": point_records, "images": image_records, "rigs": _rigs, "frames": _frames}
    for table, walk in walks.items():
        file = Path(path) / f"{table}.bin"
        if not file.is_file():
            continue
        try:
            for _ in walk(file.read_bytes()):
                pass
        except (struct.error, ValueError, OverflowError) as error:
            raise InputError(f"{file.name} is truncated or damaged") from error
    cameras = Path(path) / "cameras.bin"
    if cameras.is_file():
        content = cameras.read_bytes()
        # The length of a record depends on the camera model, which has at least two parameters.
        if 8 + 40 * int.from_bytes(content[:8], "little") > len(content):
            raise InputError(f"{cameras.name} is truncated or damaged")


def _camera_bytes(model: Any) -> int:
    """Size of cameras.bin: id, camera model, width, height, and the parameters of the camera model."""
    return 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())


def _rigs(content: bytes) -> Iterator[int]:
    """Walk along rigs.bin: id, sensors; the first is the reference, the others may have a pose."""
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        _, sensors = struct.unpack_from("<II", content, at)
        at += 16 if sensors else 8
        for _ in range(sensors - 1):
            (has_pose,) = struct.unpack_from("<?", content, at + 8)
            at += 65 if has_pose else 9
        yield at
    _check_end(content, at)


def _frames(content: bytes) -> Iterator[int]:
    """Walk along frames.bin: id, rig, pose, images of the frame."""
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        (images,) = struct.unpack_from("<I", content, at + 64)
        at += 68 + 16 * images
        yield at
    _check_end(content, at)


def _check_end(content: bytes, at: int) -> None:
    if at != len(content):
        raise ValueError("the file ends elsewhere")
