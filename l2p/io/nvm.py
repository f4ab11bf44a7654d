"""Maps of VisualSFM (NVM version 3)."""

from __future__ import annotations

from os import PathLike

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError, warn
from l2p.io.colours import byte_rgb
from l2p.io.numbered_lines import Line, NumberedLines
from l2p.maps.scene import Scene


def read_nvm(path: str | PathLike[str]) -> Scene:
    """Read the points, colours, track lengths and camera centres of an NVM file.

    A file may hold several models of different scale; the one with most points is read, with a warning.

    Raises
    ------
    InputError
        If it is truncated, or a line is not what the format has there; the message names the line.

    Notes
    -----
    C. Wu's VisualSFM: a line of each camera (name, focal length, rotation, centre, distortion, 0), then one of each
    point (x y z, r g b, number of views, then image, feature, x, y of each). ``NVM_V3_R9T`` has a rotation matrix and a
    translation instead of a quaternion and a centre.
    """
    lines = NumberedLines(path)
    # The numbers of a camera are taken from the end of its line, since names may have blanks.
    ((_, header),) = lines.take(1, "a header")
    models: list[Scene] = []
    while not lines.at_end():
        cameras = lines.counts(1, "the number of cameras of a model, or 0")[0]
        if cameras == 0:
            break
        centers = _centers(lines, lines.take(cameras, f"{cameras} camera(s)"), by_matrix=header[0].endswith(b"R9T"))
        points = lines.counts(1, "the number of points of the model")[0]
        models.append(_model(lines, lines.take(points, f"{points} point(s)"), centers))
    if not models:
        raise InputError(f"{path} has no model; expected cameras and points (VisualSFM: save the reconstruction)")
    largest = max(models, key=len)
    if len(models) > 1:
        sizes = ", ".join(f"{len(each):,}" for each in models)
        warn(f"{path} has {len(models)} models of {sizes} points; the largest is read")
    return largest


def _centers(lines: NumberedLines, cameras: list[Line], by_matrix: bool) -> Float[np.ndarray, "cameras 3"]:
    if not by_matrix:
        return lines.numbers(cameras, slice(-10, None), 10, "NAME and ten numbers of a camera", finite=False)[:, 5:8]
    table = lines.numbers(cameras, slice(-15, None), 15, "NAME and fifteen numbers of a camera", finite=False)
    return -np.einsum("nji,nj->ni", table[:, 1:10].reshape(-1, 3, 3), table[:, 10:13])


def _model(lines: NumberedLines, points: list[Line], centers: Float[np.ndarray, "cameras 3"]) -> Scene:
    table = lines.numbers(points, slice(0, 7), 7, "x, y, z, r, g, b and the views of a point")
    return Scene(
        xyz=table[:, :3],
        rgb=byte_rgb(table[:, 3:6]),
        track_length=np.clip(table[:, 6], 0, 2**31 - 1).astype(np.int32),
        camera_centers=centers,
    )
