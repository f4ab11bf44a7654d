"""A view: a camera of any of COLMAP's models at a place, which says in what pixel it sees a point."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError
from l2p.geometry.camera_rays import camera_rays
from l2p.maps.short_repr import short_repr

#: Longest side of a picture, pixels: the network was trained on photographs of this size.
LONG_SIDE = 320
#: Least and most angle of view of a camera that a user places, degrees.
NARROWEST, WIDEST = 5.0, 150.0
#: Largest angle, radians, between a point and the ray of its pixel. A polynomial of distortion folds back far outside
#: of the image, where it puts points into pixels that see another direction.
_FOLDED = 1e-3


@dataclass(frozen=True, eq=False)
class View:
    """A camera at a place.

    Attributes
    ----------
    rotation : (3, 3) float64
    translation : (3,) float64
        World to camera: y = rotation @ x + translation; x to the right, y down, z forward.
    camera : pycolmap.Camera
        Width and height in pixels, and the camera model.
    name : str
        Name of the image, or of the place.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    camera: Any
    name: str = ""

    __repr__ = short_repr

    @property
    def width(self) -> int:
        """Width of the picture, pixels."""
        return self.camera.width

    @property
    def height(self) -> int:
        """Height of the picture, pixels."""
        return self.camera.height

    def seen(
        self, xyz: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, " points"]]:
        """Return the pixel coordinates of points (COLMAP's: centres at .5), NaN for those out of sight, and their
        distances from the camera, scene units."""
        local = xyz @ self.rotation.T + self.translation
        distance = np.linalg.norm(local, axis=1)
        spherical = self.camera.mean_focal_length() <= 0
        pixel = np.full((len(xyz), 2), np.nan)
        ahead = np.flatnonzero(distance > 0 if spherical else local[:, 2] > 1e-9 * distance)
        if not len(ahead):
            return pixel, distance
        with np.errstate(all="ignore"):
            found = np.asarray(self.camera.img_from_cam(local[ahead]), dtype=np.float64)
            inside = (found >= 0).all(axis=1) & (found < [self.width, self.height]).all(axis=1)
            ahead, found = ahead[inside], found[inside]
            back = camera_rays(self.camera, found)
            off = np.linalg.norm(back - local[ahead] / distance[ahead, None], axis=1)
        true = off < _FOLDED
        pixel[ahead[true]] = found[true]
        return pixel, distance


def view_of(model: Any, name: str, long_side: int = LONG_SIDE) -> View:
    """Make the view of an image of a COLMAP model, scaled so that its longer side has ``long_side`` pixels.

    Raises
    ------
    InputError
        If the model has no such image, or does not know its pose.
    """
    posed = {image.name: image for image in model.images.values() if image.has_pose}
    if name not in posed:
        some = ", ".join([*sorted(posed)[:3], *(["..."] if len(posed) > 3 else [])])
        raise InputError(f"got view {name!r}; expected one of the {len(posed)} images of known pose: {some}")
    image = posed[name]
    pose = image.cam_from_world()
    camera = scaled(model.cameras[image.camera_id], long_side)
    return View(np.asarray(pose.rotation.matrix()), np.asarray(pose.translation), camera, name)


def scaled(camera: Any, long_side: int) -> Any:
    """Copy a camera, with so many pixels on its longer side."""
    import copy

    smaller = copy.deepcopy(camera)
    scale = long_side / max(camera.width, camera.height)
    smaller.rescale(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    return smaller


def placed_view(
    center: Float[np.ndarray, "3"],
    toward: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
    *,
    angle: float = 60.0,
    width: int = LONG_SIDE,
    height: int = 3 * LONG_SIDE // 4,
    name: str = "",
) -> View:
    """Place a pinhole camera.

    Parameters
    ----------
    center, toward : (3,) float
        Where the camera stands, and a point in the middle of its picture, scene units.
    up : (3,) float
        The direction that is up in the picture.
    angle : float
        Angle of view across the width, degrees.

    Raises
    ------
    InputError
        If the camera looks at its own place or along ``up``, or the angle is out of range.
    """
    import pycolmap

    if not NARROWEST <= angle <= WIDEST:
        raise InputError(f"got angle {angle:g}; expected {NARROWEST:g} to {WIDEST:g} degrees")
    forward = np.asarray(toward, dtype=np.float64) - center
    right = np.cross(forward, up)
    if not np.isfinite(right).all() or np.linalg.norm(right) <= 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
        raise InputError(
            "got a camera that looks along its up direction, or at its own place; expected a point to look at that is "
            "neither straight above nor at the camera"
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = width / 2 / math.tan(math.radians(angle) / 2)
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[focal, focal, width / 2, height / 2])
    return View(rotation, -rotation @ center, camera, name)


def panorama_view(
    center: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"], width: int = 2 * LONG_SIDE, *, name: str = ""
) -> View:
    """Look all around from a place: an equirectangular picture, half as high as wide.

    Raises
    ------
    InputError
        If ``up`` has no direction, or pycolmap is older than 4, which has no such cameras.
    """
    import pycolmap

    if not hasattr(pycolmap.CameraModelId, "EQUIRECTANGULAR"):
        raise InputError(
            f"got pycolmap {pycolmap.__version__}, which has no panoramas; install pycolmap 4 or newer, or choose a "
            "camera by --at and --toward"
        )
    length = np.linalg.norm(up)
    if not np.isfinite(length) or length == 0:
        raise InputError("got an up direction of length 0; expected a direction")
    down = -np.asarray(up, dtype=np.float64) / length
    other = np.eye(3)[int(np.abs(down).argmin())]
    right = np.cross(down, other)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, down, np.cross(right, down)])
    height = width // 2
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=width, height=height, params=[width, height])
    return View(rotation, -rotation @ center, camera, name)
