"""The points of a picture: true ones, recovered ones, or the rays of a map whose lines meet in few centres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene


class PicturePoints(NamedTuple):
    """Points to make a picture of.

    Attributes
    ----------
    xyz : (points, 3) float64
        Scene units.
    confidence : (points,) float32
        Of each, in [0, 1]; 1 for true points.
    appearance : Appearance
        Their colours and descriptors, each optional.
    """

    xyz: Float[np.ndarray, "points 3"]
    confidence: Float[np.ndarray, " points"]
    appearance: Appearance


def points_of(source: Scene | Recovery, lines: LineCloud | None = None) -> PicturePoints:
    """Gather the points of a scene, or those of a recovery that passed its filters.

    Parameters
    ----------
    source : Scene or Recovery
    lines : LineCloud, optional
        The lines of the recovery, which have the descriptors; without them, its colours are all that is known.

    Raises
    ------
    InputError
        If lines are given with a scene, or the recovery is of other lines.
    """
    if isinstance(source, Scene):
        if lines is not None:
            raise InputError("got lines beside a scene, whose points are known; expected lines beside a recovery only")
        return PicturePoints(source.xyz, np.ones(len(source), dtype=np.float32), source.appearance)
    kept = np.arange(len(source)) if source.kept is None else np.flatnonzero(source.kept)
    appearance = Appearance(source.rgb)
    if lines is not None:
        if len(lines) <= source.element.max(initial=-1):
            raise InputError(
                f"got a recovery of line {int(source.element.max())} and {len(lines)} lines; expected the lines that "
                "it was recovered from"
            )
        appearance = lines.appearance.rows(source.element)
    return PicturePoints(source.xyz[kept], source.confidence[kept], appearance.rows(kept))
