"""Panoramas: a map whose lines meet in few centres is a picture already, before any depth is recovered."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from l2p.errors import InputError
from l2p.images.picture_points import PicturePoints
from l2p.maps.lines import LineCloud
from l2p.schemes.recognition import Recognition, recognise

#: Schemes whose directions point from the centre to the point; all others forget the sign.
_SIGNED = "sphere"


def rays_seen(
    lines: LineCloud,
    number: int = 1,
    side: Float[np.ndarray, " lines"] | None = None,
    real: Bool[np.ndarray, " lines"] | None = None,
) -> tuple[PicturePoints, Float[np.ndarray, "3"]]:
    """Return what the lines through a centre show of the scene from there, at distance 1, and the centre.

    Parameters
    ----------
    lines : LineCloud
    number : int
        Which centre, from 1 on; the one with most lines comes first.
    side : (lines,) float, optional
        Sign of each line's position relative to the centre, as of recovered points. Without it, a line whose direction
        has no sign is seen on both sides, at half the confidence.
    real : (lines,) bool, optional
        Lines to show; default: all.

    Raises
    ------
    InputError
        If the lines do not meet in centres, or there is no such centre.
    """
    found = recognise(lines)
    centers = found.centers
    if not len(centers):
        raise InputError(
            f"got lines that do not meet in a centre ({found.sentence.rstrip('.')}); expected a ray cloud or a sphere "
            "cloud, or recover the points first (l2p recover)"
        )
    order = _by_size(found)
    if not 1 <= number <= len(order):
        raise InputError(f"got centre {number}; expected 1 to {len(order)}")
    center, mine = centers[order[number - 1]], _of_center(found, order[number - 1])
    mine = mine if real is None else mine & real
    direction = lines.direction[mine]
    appearance = lines.appearance.rows(mine)
    if lines.scheme.startswith(_SIGNED) or side is not None:
        sign = 1.0 if side is None else np.where(side[mine] >= 0, 1.0, -1.0)[:, None]
        return PicturePoints(center + sign * direction, np.ones(len(direction), np.float32), appearance), center
    both = np.concatenate([np.arange(len(direction))] * 2)
    xyz = center + np.concatenate([direction, -direction])
    return PicturePoints(xyz, np.full(len(both), 0.5, np.float32), appearance.rows(both)), center


def _of_center(found: Recognition, row: int) -> Bool[np.ndarray, " lines"]:
    assert found.family is not None
    return found.family == row


def _by_size(found: Recognition) -> list[int]:
    """Rows of the centres, those with most lines first."""
    sizes = [int(_of_center(found, row).sum()) for row in range(len(found.centers))]
    return sorted(range(len(sizes)), key=lambda row: (-sizes[row], row))
