"""What there is to look at in a file or in one attack of an audit: points, lines, and what was recovered."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np
from jaxtyping import Float, UInt8

from l2p.errors import InputError
from l2p.io.kinds import LINE_CLOUDS, SCENES, Kind, kind_of
from l2p.io.line_files import load_lines
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_scene, load_truth
from l2p.lines import LineCloud
from l2p.methods import CALIBRATED

#: The view holds this share of the points and this much around them: most maps have a middle and a far background.
_HELD, _MARGIN = 0.8, 1.3


@dataclass(frozen=True, eq=False)
class Exhibit:
    """Layers of one cloud, each None where it is not known; all have the same rows.

    Attributes
    ----------
    points : (rows, 3) float64 or None
        The points of the map, scene units.
    lines : LineCloud or None
    recovered : (rows, 3) float64 or None
    rgb : (rows, 3) uint8 or None
        Colours of the points.
    confidence : (rows,) float32 or None
        Of the recovered points.
    calibrated : bool
        The confidence is a probability, and does not only rank.
    error : (rows,) float64 or None
        Of the recovered points, in spacings.
    camera_centers : (cameras, 3) float64 or None
        Scene units.
    """

    points: Float[np.ndarray, "rows 3"] | None = None
    lines: LineCloud | None = None
    recovered: Float[np.ndarray, "rows 3"] | None = None
    rgb: UInt8[np.ndarray, "rows 3"] | None = None
    confidence: Float[np.ndarray, " rows"] | None = None
    calibrated: bool = False
    error: Float[np.ndarray, " rows"] | None = None
    camera_centers: Float[np.ndarray, "cameras 3"] | None = None

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Exhibit:
        """What there is to look at in a file: a scene, a truth, a line cloud or a recovery.

        Raises
        ------
        FileNotFoundError, InputError
            As the reader of that kind of file; a checkpoint has nothing to look at.
        """
        kind = kind_of(path)
        if kind in LINE_CLOUDS:
            lines = load_lines(path)
            return cls(lines=lines, rgb=lines.rgb)
        if kind in SCENES:
            scene = load_scene(path)
            return cls(points=scene.xyz, rgb=scene.rgb, camera_centers=scene.camera_centers)
        if kind is Kind.TRUTH:
            return cls(points=load_truth(path).xyz)
        if kind is not Kind.RECOVERY:
            raise InputError(f"{path} is {kind.value}; expected a scene, a line cloud or a recovery to look at")
        recovery = load_recovery(path)
        calibrated = recovery.info.get("method") in CALIBRATED
        return cls(recovered=recovery.xyz, rgb=recovery.rgb, confidence=recovery.confidence, calibrated=calibrated)

    def __len__(self) -> int:
        return next(len(layer) for layer in (self.points, self.recovered, self.lines) if layer is not None)


@dataclass(frozen=True, eq=False)
class Stance:
    """Where a view stands: ``(x - center) / radius @ axes.T`` is in the unit ball, but for far points, and z is up.

    The sign of up cannot be known; maps are stored with y down, as cameras see them, or with z up.
    """

    center: Float[np.ndarray, "3"]
    radius: float
    axes: Float[np.ndarray, "3 3"]

    @classmethod
    def before(cls, exhibit: Exhibit) -> Stance:
        """Made for the points of the map if they are known, else for those recovered, else for the lines."""
        points = exhibit.points if exhibit.points is not None else exhibit.recovered
        if points is None:
            from l2p.frame import Frame  # loads torch

            assert exhibit.lines is not None
            frame = Frame.of(exhibit.lines)
            return cls(frame.center, 2 * frame.unit, np.eye(3))
        center = np.median(points, axis=0)
        distance = np.linalg.norm(points - center, axis=1)
        radius = _MARGIN * float(np.quantile(distance, _HELD))
        return cls(center, radius if radius > 0 else 1.0, _axes(points[distance <= radius], exhibit.camera_centers))

    def enter(self, points: Float[np.ndarray, "*many 3"]) -> Float[np.ndarray, "*many 3"]:
        """Scene points in the view's own coordinates."""
        return (points - self.center) / self.radius @ self.axes.T

    def leave(self, places: Float[np.ndarray, "*many 3"]) -> Float[np.ndarray, "*many 3"]:
        """Places in the view's own coordinates as scene points."""
        return places @ self.axes * self.radius + self.center

    def chords(self, lines: LineCloud, reach: float = 1.25) -> Float[np.ndarray, "chords 2 3"]:
        """The parts of the lines in the ball of radius ``reach`` in the view; lines that miss it have none."""
        origin, direction = self.enter(lines.origin), lines.direction @ self.axes.T
        along = -np.sum(origin * direction, axis=1, keepdims=True)
        nearest = origin + along * direction
        square = reach**2 - np.sum(nearest**2, axis=1, keepdims=True)
        hit = square[:, 0] > 0
        half = np.sqrt(square[hit]) * direction[hit]
        return np.stack([nearest[hit] - half, nearest[hit] + half], axis=1)


def _axes(points: Float[np.ndarray, "points 3"], cameras: Float[np.ndarray, "cameras 3"] | None) -> np.ndarray:
    """Rows right, forward, up. Cameras are carried about level, so up is where their places vary least; without
    cameras, the points. An axis of the scene is taken if it is near."""
    places = points if cameras is None or len(cameras) < 3 else cameras
    up = np.linalg.eigh(np.cov(places.T))[1][:, 0] if len(places) > 2 else np.eye(3)[2]
    largest = int(np.abs(up).argmax())
    if abs(up[largest]) > 0.9:
        up = np.eye(3)[largest]
    up = up if up @ (0.0, -1.0, 1.0) >= 0 else -up
    other = np.eye(3)[int(np.abs(up).argmin())]
    forward = np.cross(up, other)
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(forward, up), forward, up])
