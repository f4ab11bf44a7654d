"""Maps of Bundler (``bundle.out``), which also Metashape, RealityCapture, OpenMVG and VisualSFM write."""

from __future__ import annotations

from os import PathLike

import numpy as np

from l2p.io.colours import byte_rgb
from l2p.io.numbered_lines import NumberedLines
from l2p.maps.scene import Scene

# Lines of a camera (focal length and distortion, rotation in three, translation), and of a point (place, colour,
# views).
_OF_CAMERA, _OF_POINT = 5, 3


def read_bundler(path: str | PathLike[str]) -> Scene:
    """Read the points, colours, track lengths and camera centres of a Bundler file.

    Cameras of focal length 0 are images that were not registered, and are left out.

    Raises
    ------
    InputError
        If it is truncated, or a line is not what the format has there; the message names the line.

    Notes
    -----
    The format is that of N. Snavely's Bundler 0.3: a point on three lines, x y z, r g b, and the number of views
    followed by camera, keypoint, x, y of each. Cameras map world to camera: y = R x + t.
    """
    lines = NumberedLines(path)
    cameras, points = lines.counts(2, "the numbers of cameras and points")[:2]
    of_cameras = lines.take(_OF_CAMERA * cameras, f"{cameras} camera(s)")
    of_points = lines.take(_OF_POINT * points, f"{points} point(s)")
    focal = lines.numbers(of_cameras[0::5], slice(0, 1), 1, "a focal length")[:, 0]
    rotation = np.stack(
        [lines.numbers(of_cameras[row::5], slice(0, 3), 3, "a row of a rotation") for row in (1, 2, 3)], axis=1
    )
    translation = lines.numbers(of_cameras[4::5], slice(0, 3), 3, "a translation")
    centers = -np.einsum("nji,nj->ni", rotation, translation)
    views = lines.numbers(of_points[2::3], slice(0, 1), 1, "the number of views of a point")[:, 0]
    return Scene(
        xyz=lines.numbers(of_points[0::3], slice(0, 3), 3, "x, y, z of a point"),
        rgb=byte_rgb(lines.numbers(of_points[1::3], slice(0, 3), 3, "the colour of a point")),
        track_length=np.clip(views, 0, 2**31 - 1).astype(np.int32),
        camera_centers=centers[focal != 0],
    )
