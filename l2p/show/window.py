"""Open3D window that shows points or lines, for maps that are too large for a page."""

from __future__ import annotations

import os
import re
import socket
import sys
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from l2p.errors import InputError
from l2p.io.open3d import load_open3d
from l2p.io.recovery_files import confidence_colours
from l2p.show.exhibit import Exhibit
from l2p.show.stance import Stance

_SIZE = (1280, 800)
#: Timeout of the connection to a display, seconds.
_PATIENCE = 3.0
_POINT = np.array([60, 90, 140], dtype=np.uint8)


def has_display() -> bool:
    """Whether this machine can open windows."""
    return sys.platform in ("win32", "darwin") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def check_window() -> None:
    """Check, before any work, that a window can be shown.

    Raises
    ------
    InputError
        If there is no display, none answers, or Open3D does not load.
    """
    if not has_display():
        raise InputError("there is no display for --window (DISPLAY is not set); leave it out to get a page instead")
    if not _answers():
        # Open3D would block forever.
        raise InputError(f"the display {_display()} does not answer; leave out --window to get a page instead")
    load_open3d("--window")


def _display() -> str:
    return os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY") or ""


def _answers() -> bool:
    """Whether a server answers at the display named in the environment."""
    if sys.platform in ("win32", "darwin"):
        return True
    if os.environ.get("WAYLAND_DISPLAY"):
        return (Path(os.environ.get("XDG_RUNTIME_DIR", "")) / os.environ["WAYLAND_DISPLAY"]).is_socket()
    named = re.fullmatch(r"(?:unix|(.*?)/?(?:unix)?):(\d+)(?:\.\d+)?", os.environ["DISPLAY"])
    if named is None:
        return False
    host, number = named[1], int(named[2])
    if host:
        return _listens(socket.AF_INET, (host, 6000 + number))
    path = f"/tmp/.X11-unix/X{number}"
    return _listens(socket.AF_UNIX, path) or _listens(socket.AF_UNIX, f"\0{path}")


def _listens(family: socket.AddressFamily, address: Any) -> bool:
    with socket.socket(family) as connection:
        connection.settimeout(_PATIENCE)
        try:
            connection.connect(address)
        except OSError:
            return False
    return True


def show(exhibit: Exhibit, title: str) -> None:
    """Show an exhibit until the window is closed; recovered points are dark blue (low confidence) to yellow (high).

    Raises
    ------
    InputError
        As for :func:`check_window`, or if the display refuses the window.
    """
    check_window()
    open3d = load_open3d("--window")
    window = open3d.visualization.Visualizer()
    if not window.create_window(title, *_SIZE):
        raise InputError("the display refused a window with OpenGL; leave out --window to get a page instead")
    geometry = _geometry(open3d, exhibit)
    window.add_geometry(geometry)
    _stand(window.get_view_control(), geometry, Stance.before(exhibit))
    window.run()
    window.destroy_window()


def _stand(camera: Any, geometry: Any, stance: Stance) -> None:
    """Aim the camera at the middle of the map from above; Open3D's default view would include the farthest point."""
    right, forward, up = stance.axes
    camera.set_lookat(stance.center)
    camera.set_up(up)
    camera.set_front(0.7 * right - forward + 0.6 * up)
    # The zoom is relative to the longest side of the bounding box.
    length = float(np.max(geometry.get_max_bound() - geometry.get_min_bound()))
    camera.set_zoom(stance.radius / length if length > 0 else 1.0)


def _geometry(open3d: Any, exhibit: Exhibit) -> Any:
    """A point cloud or, if there are only lines, their segments."""
    points = exhibit.recovered if exhibit.recovered is not None else exhibit.points
    if points is None:
        assert exhibit.lines is not None
        stance = Stance.before(exhibit)
        ends = stance.leave(stance.chords(exhibit.lines))
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
