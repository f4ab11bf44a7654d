"""A Structure-from-Motion scene: points and what is known of them; and the truth behind a line cloud."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np
from jaxtyping import Float, Int, UInt8


@dataclass(frozen=True, eq=False)
class Scene:
    """The sparse points of an SfM model.

    Attributes
    ----------
    xyz : (points, 3) float64
        Points in scene units (metres only if the model is metric).
    rgb : (points, 3) uint8 or None
        Colours of the points.
    error : (points,) float32 or None
        Mean reprojection error in pixels.
    track_length : (points,) int32 or None
        Number of images that see the point.
    ids : (points,) int64 or None
        The identifiers of the source (COLMAP ``point3D_id``).
    camera_centers : (cameras, 3) float64 or None
        Scene units; the cameras that see the points.
    """

    xyz: Float[np.ndarray, "points 3"]
    rgb: UInt8[np.ndarray, "points 3"] | None = None
    error: Float[np.ndarray, " points"] | None = None
    track_length: Int[np.ndarray, " points"] | None = None
    ids: Int[np.ndarray, " points"] | None = None
    camera_centers: Float[np.ndarray, "cameras 3"] | None = None

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Scene:
        """Read a COLMAP model folder (bin or txt), a PLY or an npz with ``xyz``."""
        from l2p.io.scene_files import load_scene

        return load_scene(path)

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class Truth:
    """The points behind the lines of a line cloud, kept apart from it to judge an attack.

    Attributes
    ----------
    xyz : (lines, 3) float64
        The point behind each line, in the order of the lines, scene units.
    index : (lines,) int64
        Row of the point in the scene that was lifted.
    spacing : float
        Median distance to the 50th neighbour in the whole scene, also when only a fraction was lifted; scene units.
    ids : (lines,) int64 or None
        Identifiers of the source (COLMAP ``point3D_id``).
    seed : int or None
        Seed of the lifting, where one was given.
    """

    xyz: Float[np.ndarray, "lines 3"]
    index: Int[np.ndarray, " lines"]
    spacing: float
    ids: Int[np.ndarray, " lines"] | None = None
    seed: int | None = None

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Truth:
        """Read the truth npz that ``l2p lift --truth`` wrote."""
        from l2p.io.scene_files import load_truth

        return load_truth(path)

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> None:
        """Write the truth npz of ``docs/formats.md``, whole or not at all."""
        from l2p.io.scene_files import save_truth

        save_truth(self, path, overwrite=overwrite)

    def __len__(self) -> int:
        return len(self.xyz)
