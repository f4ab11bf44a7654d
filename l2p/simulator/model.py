"""The simulated reconstruction: a scene with its observations; can be written as a COLMAP model."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.errors import InputError
from l2p.maps.scene import Scene
from l2p.maps.short_repr import short_repr
from l2p.simulator.cameras import Cameras


@dataclass(frozen=True, eq=False)
class SimulatedModel:
    """A simulated SfM model.

    Attributes
    ----------
    scene : Scene
        Reconstructed points; in metres, z up.
    cameras : Cameras
    true_xyz : (points, 3) float64
        True positions of the keypoints, in metres.
    wrong : (points,) bool
        Whether the point comes from wrong matches, so that no surface is there.
    view_point, view_camera : (views,) int64
        Point row and camera row of each observation, sorted by point.
    view_pixel : (views, 2) float64
        Measured pixel of each observation.
    """

    scene: Scene
    cameras: Cameras
    true_xyz: Float[np.ndarray, "points 3"]
    wrong: Bool[np.ndarray, " points"]
    view_point: Int[np.ndarray, " views"]
    view_camera: Int[np.ndarray, " views"]
    view_pixel: Float[np.ndarray, "views 2"]

    __repr__ = short_repr

    def save_colmap(self, path: str | PathLike[str]) -> None:
        """Write a COLMAP model (bin) into ``path``, a folder that is new or empty.

        Raises
        ------
        InputError
            If the folder is not empty or ``path`` is a file.

        Notes
        -----
        pycolmap takes points one by one: about 10 s for 10^6 points.
        """
        folder = Path(path)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder} exists and is not an empty folder; name a new folder for the COLMAP model")
        model = self._reconstruction()
        folder.mkdir(parents=True, exist_ok=True)
        model.write(str(folder))

    def _reconstruction(self):
        """The model as a ``pycolmap.Reconstruction``; ids of points and images are 1 + their rows."""
        import pycolmap

        model, cameras = pycolmap.Reconstruction(), self.cameras
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="SIMPLE_PINHOLE",
                camera_id=1,
                width=cameras.width,
                height=cameras.height,
                params=[cameras.focal, cameras.width / 2, cameras.height / 2],
            )
        )
        by_camera = np.argsort(self.view_camera, kind="stable")
        views_of = np.split(by_camera, np.searchsorted(self.view_camera[by_camera], np.arange(1, len(cameras))))
        index = np.empty(len(by_camera), dtype=np.int64)
        for row, views in enumerate(views_of):
            index[views] = np.arange(len(views))
            pose = pycolmap.Rigid3d(
                pycolmap.Rotation3d(cameras.rotation[row]), -cameras.rotation[row] @ cameras.center[row]
            )
            image = pycolmap.Image(f"frame{row:05d}.jpg", self.view_pixel[views], camera_id=1, image_id=row + 1)
            model.add_image_with_trivial_frame(image, pose)
        self._add_points(model, index)
        return model

    def _add_points(self, model, index: Int[np.ndarray, " views"]) -> None:
        """Add every point with its track; ``index`` is each observation's row among the keypoints of its image."""
        import pycolmap

        rgb, error = self.scene.rgb, self.scene.error
        assert rgb is not None and error is not None
        image, index_list = (self.view_camera + 1).tolist(), index.tolist()
        ends = np.searchsorted(self.view_point, np.arange(len(self.scene) + 1)).tolist()
        for row, xyz in enumerate(self.scene.xyz):
            views = range(ends[row], ends[row + 1])
            track = pycolmap.Track([pycolmap.TrackElement(image[v], index_list[v]) for v in views])
            model.points3D[model.add_point3D(xyz, track, rgb[row])].error = float(error[row])
