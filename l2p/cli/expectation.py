"""What can be expected of a recovery whose true points are unknown: the last line of ``l2p recover``."""

from __future__ import annotations

from typing import Any

import numpy as np

from l2p.attacks.settings import METHODS
from l2p.errors import InputError
from l2p.judging.accuracy import spacing
from l2p.maps.recovery import Recovery


def expected_within(recovery: Recovery) -> float | None:
    """Predict the share of the kept points within 1 spacing: their mean confidence; None if it only ranks."""
    return float(_kept(recovery).mean()) if recovery.calibrated else None


def map_spacing(recovery: Recovery) -> float | None:
    """Estimate the spacing of the map from the recovered points, scene units; None if they have no extent.

    It is that of all recovered points, times the ratio by which a whole map is denser if they are a fraction of it.
    """
    from l2p.attacks.learned.learned import spacing_ratio

    try:
        return spacing(recovery.xyz) * spacing_ratio(recovery.info.get("settings", {}).get("fraction", 1.0))
    except InputError:
        return None


def expectation(recovery: Recovery, spacing: float | None) -> str:
    """Say which share of the points is right, or in a few words why that is not known."""
    share = expected_within(recovery)
    if share is None:
        return f"How many of them are right is not stated: {_why(recovery.info)}."
    length = "" if spacing is None else f" ({spacing:.2g} units)"
    what = "the points" if recovery.kept is None else "the kept points"
    return f"About {100 * share:.0f} % of {what} are expected within 1 spacing{length}."


def _kept(recovery: Recovery) -> np.ndarray:
    return recovery.confidence if recovery.kept is None else recovery.confidence[recovery.kept]


def _why(info: dict[str, Any]) -> str:
    recognised = info.get("recognised")
    if info.get("method") == "learned" and recognised is not None and not recognised["expected"]:
        return "the confidence was not calibrated on such lines, and only ranks them"
    method = info.get("method")
    return f"the confidence of {method if method in METHODS else 'this attack'} is no probability, and only ranks them"
