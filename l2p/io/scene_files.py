"""Files of scenes (COLMAP model, PLY, npz), and of the truth, which stays with the owner of a lifted scene."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from os import PathLike

import numpy as np

from l2p.checks import OUT_OF_RANGE, in_range
from l2p.errors import InputError, warn
from l2p.io.atomic import atomic_file
from l2p.io.bundler import read_bundler
from l2p.io.colmap import read_scene
from l2p.io.colours import as_rgb
from l2p.io.endings import checked_ending
from l2p.io.json_maps import read_meshroom, read_nerfstudio, read_openmvg, read_opensfm
from l2p.io.kinds import HIDDEN_MAPS, TABLES, Kind, kind_of
from l2p.io.npz import Fields, npz_bytes
from l2p.io.nvm import read_nvm
from l2p.io.obj_points import read_obj_points
from l2p.io.pcd import read_pcd
from l2p.io.ply import ply_bytes, point_records
from l2p.io.ply_points import read_ply
from l2p.io.point_text import ENDINGS as TEXT
from l2p.io.point_text import text_bytes
from l2p.io.table_files import points_of_table
from l2p.io.xyz_files import read_xyz
from l2p.maps.scene import Scene
from l2p.maps.truth import Truth

#: Published attributes that a file can hold beside the points, by its ending.
HELD: dict[str, tuple[str, ...]] = {
    ".npz": ("rgb", "descriptor"),
    ".ply": ("rgb",),
    **{ending: () if ending == ".xyz" else ("rgb",) for ending in TEXT},
}

#: Newest version of the truth file. Version 1, without ``element``, is written if row i is behind line i.
TRUTH_VERSION = 2


def load_scene(path: str | PathLike[str], columns: str | None = None) -> Scene:
    """Read a scene: a COLMAP model, a point cloud, a map of another program, or rows of numbers (``docs/formats.md``).

    Of a COLMAP model the points are enough: where tracks, images or cameras cannot be read, an
    :class:`l2p.errors.InputWarning` says so.

    Parameters
    ----------
    path : path
    columns : str, optional
        What the columns of a text or npy file hold, such as ``x,y,z,r,g,b``; by default its header or its numbers tell
        it.

    Raises
    ------
    FileNotFoundError
        If there is nothing at ``path``.
    InputError
        If it is damaged, of another kind, has no points, or has points that are not finite.
    """
    kind = kind_of(path, columns)
    if kind in TABLES:
        return checked_scene(path, Scene(*points_of_table(path, columns)))
    if kind in HIDDEN_MAPS or kind is Kind.CHECKPOINT:
        raise InputError(f"{path} is {kind.value}; expected a scene: a COLMAP model folder, a PLY or an npz with xyz")
    with np.errstate(over="ignore", invalid="ignore"):  # what is too large is refused as not finite
        # Recoveries and truths have xyz, and are read as scenes, too.
        return checked_scene(path, _READERS.get(kind, _read_npz)(path))


def checked_scene(path: str | PathLike[str], scene: Scene) -> Scene:
    """Return the scene of a file, without cameras that are out of range (with a warning).

    Raises
    ------
    InputError
        If it has no points, or some that are out of range.
    """
    if len(scene) == 0:
        raise InputError(f"{path} has no points; expected at least one")
    _refuse_out_of_range(path, "points", scene.xyz)
    if scene.camera_centers is None:
        return scene
    usable = np.asarray(in_range(scene.camera_centers).all(axis=1))
    if not usable.all():
        warn(f"{path}: {int((~usable).sum())} of {len(usable)} cameras have a place that is {OUT_OF_RANGE}; left out")
    return replace(scene, camera_centers=scene.camera_centers[usable])


def save_scene(scene: Scene, path: str | PathLike[str], *, overwrite: bool = False) -> None:
    """Write the points and their colours, and to an npz their descriptors; others hold none, and they are left out.

    Coordinates of a PLY have 32 bits, or 64 if these would lose digits; an ``.xyz`` has no colours either.

    Raises
    ------
    InputError
        If ``path`` does not end with .npz, .ply, .xyz, .txt or .csv, or must not be written.
    """
    if (ending := scene_ending(path)) in TEXT:
        content = text_bytes(ending, scene.xyz, scene.rgb)
    elif ending == ".ply":
        content = ply_bytes({"vertex": point_records(scene.xyz, scene.rgb)})
    else:
        kind = None if scene.descriptor_kind is None else np.array(scene.descriptor_kind)
        content = npz_bytes(
            {"xyz": scene.xyz, "rgb": scene.rgb, "descriptor": scene.descriptor, "descriptor_kind": kind}
        )
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(content)


def scene_ending(path: str | PathLike[str], attributes: Collection[str] = ()) -> str:
    """Return the ending of a scene to write.

    Raises
    ------
    InputError
        If l2p does not write such files, or they cannot hold one of the published ``attributes``.
    """
    return checked_ending(path, "points", HELD, attributes)


def load_truth(path: str | PathLike[str]) -> Truth:
    """Read the truth npz that ``l2p lift --truth`` wrote."""
    kind = kind_of(path)
    if kind is not Kind.TRUTH:
        raise InputError(f"{path} is {kind.value}; expected a truth npz (l2p lift --truth)")
    fields = Fields(path, ("xyz", "index", "spacing", "ids", "seed", "element", "version"))
    fields.take_version(TRUTH_VERSION)
    xyz = fields.take("xyz", "fiu", (None, 3), np.float64)
    rows = len(xyz)
    _refuse_out_of_range(path, "points", xyz)
    seed = fields.take_optional("seed", "iu", ())
    spacing = float(fields.take("spacing", "fiu", ()))
    if not 0 < spacing < np.inf:
        raise InputError(f"{path} has spacing {spacing}; expected a length above 0")
    return Truth(
        xyz=xyz,
        index=fields.take("index", "iu", (rows,), np.int64),
        spacing=spacing,
        ids=fields.take_optional("ids", "iu", (rows,), np.int64),
        seed=None if seed is None else int(seed),
        element=fields.take_element(rows),
    )


def save_truth(truth: Truth, path: str | PathLike[str], *, overwrite: bool = False) -> None:
    """Write the truth npz of ``docs/formats.md``."""
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(truth_bytes(truth))


def truth_bytes(truth: Truth) -> bytes:
    """Encode a truth as npz."""
    if truth.spacing is None:
        raise InputError(
            "got a truth without a spacing; measure that of the whole map first: "
            "replace(truth, spacing=l2p.judging.accuracy.spacing(points))"
        )
    return npz_bytes(
        {
            "xyz": truth.xyz,
            "index": truth.index,
            "spacing": np.array(truth.spacing, dtype=np.float64),
            "ids": truth.ids,
            "seed": None if truth.seed is None else np.array(truth.seed, dtype=np.uint64),
            "element": None if truth.one_each else truth.element,
            "version": np.array(1 if truth.one_each else TRUTH_VERSION),
        }
    )


def _read_obj(path: str | PathLike[str]) -> Scene:
    xyz, rgb = read_obj_points(path)
    return Scene(xyz, None if rgb is None else as_rgb(rgb))


def _read_npz(path: str | PathLike[str]) -> Scene:
    names = ("xyz", "rgb", "error", "track_length", "track_len", "ids", "camera_centers", "descriptor")
    fields = Fields(path, (*names, "descriptor_kind"))
    xyz = fields.take("xyz", "fiu", (None, 3), np.float64)
    rows = len(xyz)
    track_length = fields.take_optional("track_length", "iu", (rows,), np.int32)
    if track_length is None:
        track_length = fields.take_optional("track_len", "iu", (rows,), np.int32)
    descriptor, kind = fields.take_descriptor(rows)
    return Scene(
        xyz=xyz,
        rgb=fields.take_rgb(rows),
        descriptor=descriptor,
        descriptor_kind=kind,
        error=fields.take_optional("error", "fiu", (rows,), np.float32),
        track_length=track_length,
        ids=fields.take_optional("ids", "iu", (rows,), np.int64),
        camera_centers=fields.take_optional("camera_centers", "fiu", (None, 3), np.float64),
    )


def _refuse_out_of_range(path: str | PathLike[str], what: str, xyz: np.ndarray) -> None:
    bad = ~in_range(xyz).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path} has {int(bad.sum())} of {len(xyz)} {what} that are {OUT_OF_RANGE}, first at row "
            f"{int(np.argmax(bad))}; remove them"
        )


def _read_colmap(path: str | PathLike[str]) -> Scene:
    return read_scene(path)[0]


_READERS: dict[Kind, Callable[[str | PathLike[str]], Scene]] = {
    Kind.SCENE_MODEL: _read_colmap,
    Kind.SCENE_POINTS: _read_colmap,
    Kind.SCENE_PLY: read_ply,
    Kind.SCENE_OBJ: _read_obj,
    Kind.SCENE_XYZ: read_xyz,
    Kind.SCENE_PCD: read_pcd,
    Kind.SCENE_BUNDLER: read_bundler,
    Kind.SCENE_NVM: read_nvm,
    Kind.SCENE_OPENSFM: read_opensfm,
    Kind.SCENE_OPENMVG: read_openmvg,
    Kind.SCENE_MESHROOM: read_meshroom,
    Kind.SCENE_NERFSTUDIO: read_nerfstudio,
}
