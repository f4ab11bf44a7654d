"""Visible content of a file or of one attack of an audit: points, lines, and recovered points."""

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
from l2p.maps.lines import LineCloud
from l2p.maps.short_repr import short_repr


@dataclass(frozen=True, eq=False)
class Exhibit:
    """Layers of one cloud, each None if it is not known; all have the same rows.

    Attributes
    ----------
    points : (rows, 3) float64 or None
        The points of the map, scene units.
    lines : LineCloud or None
    recovered : (rows, 3) float64 or None
    rgb : (rows, 3) uint8 or None
        Colours of the points.
    confidence : (rows,) float32 or None
        Confidence of the recovered points.
    calibrated : bool
        Whether the confidence is a probability (otherwise, it only ranks).
    error : (rows,) float64 or None
        Errors of the recovered points, in spacings.
    camera_centers : (cameras, 3) float64 or None
        Camera centres, scene units.
    spacing : float or None
        Spacing of the map, scene units.
    up : (3,) float64 or None
        Unit vector of up, if it is known.
    """

    points: Float[np.ndarray, "rows 3"] | None = None
    lines: LineCloud | None = None
    recovered: Float[np.ndarray, "rows 3"] | None = None
    rgb: UInt8[np.ndarray, "rows 3"] | None = None
    confidence: Float[np.ndarray, " rows"] | None = None
    calibrated: bool = False
    error: Float[np.ndarray, " rows"] | None = None
    camera_centers: Float[np.ndarray, "cameras 3"] | None = None
    spacing: float | None = None
    up: Float[np.ndarray, "3"] | None = None

    __repr__ = short_repr

    @classmethod
    def load(cls, path: str | PathLike[str], columns: str | None = None) -> Exhibit:
        """Load the layers of a file: a scene, a truth, a line cloud or a recovery.

        Parameters
        ----------
        path : path
        columns : str, optional
            What the columns of a text or npy file hold.

        Raises
        ------
        FileNotFoundError, InputError
            As for the reader of that kind of file; a checkpoint cannot be shown.
        """
        kind = kind_of(path, columns)
        if kind in LINE_CLOUDS:
            lines = load_lines(path, columns)
            return cls(lines=lines, rgb=lines.rgb)
        if kind in SCENES:
            scene = load_scene(path, columns)
            return cls(points=scene.xyz, rgb=scene.rgb, camera_centers=scene.camera_centers, up=scene.up)
        if kind is Kind.TRUTH:
            return cls(points=load_truth(path).xyz)
        if kind is not Kind.RECOVERY:
            raise InputError(f"{path} is {kind.value}; expected a scene, a line cloud or a recovery to look at")
        recovery = load_recovery(path)
        return cls(
            recovered=recovery.xyz,
            rgb=recovery.rgb,
            confidence=recovery.confidence,
            calibrated=recovery.calibrated,
        )

    def __len__(self) -> int:
        return next(len(layer) for layer in (self.points, self.recovered, self.lines) if layer is not None)
