"""A window of Open3D that shows points or lines, for maps that are too large for a page."""

from __future__ import annotations

import os
import sys
from typing import Any

import numpy as np
from jaxtyping import UInt8

from l2p.clean import load_open3d
from l2p.errors import InputError
from l2p.exhibit import Exhibit, Stance
from l2p.io.recovery_files import confidence_colours

_SIZE = (1280, 800)
_POINT = np.array([60, 90, 140], dtype=np.uint8)


def has_display() -> bool:
    """Whether windows can be opened here."""
    return sys.platform in ("win32", "darwin") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def check_window() -> None:
    """Refuse, before any work, where no window can be shown.

    Raises
    ------
    InputError
        If there is no display, or Open3D does not load.
    """
    if not has_display():
        raise InputError("there is no display for --window (DISPLAY is not set); leave it out to get a page instead")
    load_open3d("--window")


def show(exhibit: Exhibit, title: str) -> None:
    """Show an exhibit until the window is closed; recovered points by confidence, dark blue is unsure, yellow sure.

    Raises
    ------
    InputError
        As :func:`check_window`, or if the display refuses the window.
    """
    check_window()
    open3d = load_open3d("--window")
    window = open3d.visualization.Visualizer()
    if not window.create_window(title, *_SIZE):
        raise InputError("the display refused a window with OpenGL; leave out --window to get a page instead")
    window.add_geometry(_geometry(open3d, exhibit))
    window.run()
    window.destroy_window()


def _geometry(open3d: Any, exhibit: Exhibit) -> Any:
    """The points or, where there are only lines, these."""
    points = exhibit.recovered if exhibit.recovered is not None else exhibit.points
    if points is None:
        assert exhibit.lines is not None
        ends = Stance.before(exhibit).chords(exhibit.lines)
        pairs = np.arange(2 * len(ends)).reshape(-1, 2)
        lines = open3d.geometry.LineSet(
            open3d.utility.Vector3dVector(ends.reshape(-1, 3)), open3d.utility.Vector2iVector(pairs)
        )
        return lines.paint_uniform_color(_POINT / 255)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.colors = open3d.utility.Vector3dVector(_colours(exhibit, len(points)) / 255)
    return cloud


def _colours(exhibit: Exhibit, count: int) -> UInt8[np.ndarray, "points 3"]:
    if exhibit.confidence is not None:
        return confidence_colours(exhibit.confidence.astype(np.float64))
    return np.broadcast_to(_POINT, (count, 3)) if exhibit.rgb is None else exhibit.rgb
