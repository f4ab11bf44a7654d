"""What may be asked of an audit: refusals before any work."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from l2p.auditing.published_again import MOST_RELEASES
from l2p.checks import named
from l2p.errors import InputError
from l2p.maps.lines import LineCloud
from l2p.maps.scene import Scene
from l2p.schemes.scheme import scheme_of


def check_asked(
    scene: Scene | LineCloud,
    fractions: object,
    queries: object,
    drop: np.ndarray | None,
    region: np.ndarray | None,
    schemes: Sequence[str],
    releases: object,
) -> None:
    """Refuse what a line cloud cannot have, unknown schemes, and numbers that are out of range.

    Raises
    ------
    InputError
        As :func:`l2p.audit`.
    """
    if isinstance(scene, LineCloud):
        _check_lines(fractions, queries, drop, region, schemes, releases)
    for scheme in schemes:
        scheme_of(scheme)
    if not isinstance(releases, int) or not 1 <= releases <= MOST_RELEASES:
        raise InputError(f"got {named(releases)} releases; expected 1 to {MOST_RELEASES}")
    if region is not None and (region.shape != (len(scene),) or region.dtype != np.bool_ or not region.any()):
        raise InputError(f"got a region of {np.sum(region)} of {region.size} points; expected some of {len(scene)}")


def _check_lines(
    fractions: object, queries: object, drop: object, region: object, schemes: Sequence[str], releases: object
) -> None:
    if fractions is not None or queries is not None:
        what = "queries" if fractions is None else "fractions"
        raise InputError(f"got {what} for a line cloud; expected none, since it is attacked as it is")
    if region is not None:
        raise InputError("got a region for a line cloud, whose points are unknown; expected one with a scene")
    if drop is not None:
        raise InputError("got points to drop for a line cloud, which has none; drop them when the map is lifted")
    if releases != 1:
        raise InputError(
            "got releases for a line cloud; expected them with a scene; l2p recover takes several line clouds"
        )
    if schemes:
        raise InputError("got schemes for a line cloud; expected them with a scene, which each of them can hide")
