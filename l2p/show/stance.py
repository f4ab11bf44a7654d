"""Viewpoint of a map: centre, radius and axes, upright if its cameras tell, and seen from where they stood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from l2p.maps.lines import LineCloud
from l2p.maps.short_repr import short_repr
from l2p.show.exhibit import Exhibit

#: Share of the points that the view must show, and factor on its radius: most maps have a far background.
_HELD, _MARGIN = 0.8, 1.3
#: Least distance of the cameras' middle from the points', in radii across up, from which they look at one side.
_ASIDE = 0.15


@dataclass(frozen=True, eq=False)
class Stance:
    """View coordinates ``(x - center) / radius @ axes.T``: in the unit ball except for far points, with z up.

    Without an up of the map it is guessed, and its sign, too: maps are stored with y down, as cameras see them, or with
    z up.
    """

    center: Float[np.ndarray, "3"]
    radius: float
    axes: Float[np.ndarray, "3 3"]

    __repr__ = short_repr

    @classmethod
    def before(cls, exhibit: Exhibit) -> Stance:
        """Choose a view of the points of the map; without them, of the recovered points; else, of the lines."""
        points = exhibit.points if exhibit.points is not None else exhibit.recovered
        if points is None:
            from l2p.geometry.frame import Frame

            assert exhibit.lines is not None
            frame = Frame.of(exhibit.lines)
            return cls(frame.center, 2 * frame.unit, np.eye(3))
        center = np.median(points, axis=0)
        distance = np.linalg.norm(points - center, axis=1)
        radius = _MARGIN * float(np.quantile(distance, _HELD))
        radius = radius if radius > 0 else 1.0
        up = _up(points[distance <= radius], exhibit.camera_centers) if exhibit.up is None else exhibit.up
        return cls(center, radius, _axes(up, _ahead(exhibit.camera_centers, center, radius)))

    def enter(self, points: Float[np.ndarray, "*many 3"]) -> Float[np.ndarray, "*many 3"]:
        """Transform scene points to view coordinates."""
        return (points - self.center) / self.radius @ self.axes.T

    def leave(self, places: Float[np.ndarray, "*many 3"]) -> Float[np.ndarray, "*many 3"]:
        """Transform view coordinates to scene points."""
        return places @ self.axes * self.radius + self.center

    def chords(self, lines: LineCloud, reach: float = 1.25) -> Float[np.ndarray, "chords 2 3"]:
        """Return the chords of lines in the ball of radius ``reach``, view coordinates; without lines that miss it."""
        origin, direction = self.enter(lines.origin), lines.direction @ self.axes.T
        along = -np.sum(origin * direction, axis=1, keepdims=True)
        nearest = origin + along * direction
        square = reach**2 - np.sum(nearest**2, axis=1, keepdims=True)
        hit = square[:, 0] > 0
        half = np.sqrt(square[hit]) * direction[hit]
        return np.stack([nearest[hit] - half, nearest[hit] + half], axis=1)


def _axes(up: Float[np.ndarray, "3"], ahead: Float[np.ndarray, "3"] | None) -> Float[np.ndarray, "3 3"]:
    """Rows right, forward, up; forward is the part of ``ahead`` that is across up, or any direction that is."""
    across = None if ahead is None else ahead - (ahead @ up) * up
    if across is None or np.linalg.norm(across) < _ASIDE:
        across = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    forward = across / np.linalg.norm(across)
    return np.stack([np.cross(forward, up), forward, up])


def _ahead(
    cameras: Float[np.ndarray, "cameras 3"] | None, center: Float[np.ndarray, "3"], radius: float
) -> Float[np.ndarray, "3"] | None:
    """Direction from the middle of the cameras to the points, in radii; None without cameras."""
    return None if cameras is None or len(cameras) == 0 else (center - np.median(cameras, axis=0)) / radius


def _up(points: Float[np.ndarray, "points 3"], cameras: Float[np.ndarray, "cameras 3"] | None) -> np.ndarray:
    """Guess up from positions alone.

    Cameras usually stay at one height, so up is the direction in which their positions vary least; without cameras,
    the points are used. An axis of the scene close to this direction replaces it.
    """
    positions = points if cameras is None or len(cameras) < 3 else cameras
    up = np.linalg.eigh(np.cov(positions.T))[1][:, 0] if len(positions) > 2 else np.eye(3)[2]
    largest = int(np.abs(up).argmax())
    if abs(up[largest]) > 0.9:
        up = np.eye(3)[largest]
    return up if up @ (0.0, -1.0, 1.0) >= 0 else -up
