"""The data of the interactive view: thinned layers as base64, and counts of all points by confidence."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.maps.lines import LineCloud
from l2p.show.colors import ERROR_LIMIT
from l2p.show.exhibit import Exhibit
from l2p.show.page import MOST_POINTS
from l2p.show.stance import Stance

#: Lines that a view draws at most; more fill the picture evenly and show nothing else.
MOST_LINES = 4_000
#: Steps of the confidence slider.
LEVELS = 100


def view_data(exhibits: Sequence[tuple[str, Exhibit]], most_points: int = MOST_POINTS) -> dict[str, Any]:
    """What the view's script reads: plain values for JSON.

    Parameters
    ----------
    exhibits : sequence of (str, Exhibit)
        Clouds with what their button says; the first one is shown at first, and all are seen from its stance.
    most_points : int
        Larger clouds are thinned, at random, to as many points.
    """
    stance = Stance.before(exhibits[0][1])
    clouds = [_cloud(label, exhibit, stance, most_points) for label, exhibit in exhibits]
    return {"levels": LEVELS, "errorLimit": ERROR_LIMIT, "clouds": clouds}


def _cloud(label: str, exhibit: Exhibit, stance: Stance, most_points: int) -> dict[str, Any]:
    rows = _thinned(len(exhibit), most_points)
    level = None if exhibit.confidence is None else _level(exhibit.confidence)
    inside = None if exhibit.error is None else exhibit.error <= 1
    error = None if exhibit.error is None else np.clip(exhibit.error / ERROR_LIMIT * 255, 0, 255).astype(np.uint8)
    return {
        "label": label,
        "count": len(exhibit),
        "shown": len(rows),
        "points": _places(exhibit.points, rows, stance),
        "recovered": _places(exhibit.recovered, rows, stance),
        "rgb": None if exhibit.rgb is None else _base64(exhibit.rgb[rows]),
        "level": None if level is None else _base64(level[rows].astype(np.uint8)),
        "error": None if error is None else _base64(error[rows]),
        "calibrated": exhibit.calibrated,
        **_lines(exhibit.lines, rows, stance),
        **_counts(level, inside, exhibit),
    }


def _places(points: Float[np.ndarray, "rows 3"] | None, rows: Int[np.ndarray, " some"], stance: Stance) -> str | None:
    return None if points is None else _base64(stance.enter(points[rows]).astype("<f4"))


def _lines(lines: LineCloud | None, rows: Int[np.ndarray, " some"], stance: Stance) -> dict[str, Any]:
    """The ends of the drawn lines, how many these are, and of how many that were chosen: some may pass by."""
    if lines is None:
        return {"lines": None, "linesTried": 0, "linesShown": 0}
    some = rows[_thinned(len(rows), MOST_LINES)]
    chords = stance.chords(LineCloud(lines.direction[some], lines.moment[some]))
    return {"lines": _base64(chords.astype("<f4")), "linesTried": len(some), "linesShown": len(chords)}


def _counts(
    level: Int[np.ndarray, " rows"] | None, inside: Bool[np.ndarray, " rows"] | None, exhibit: Exhibit
) -> dict[str, Any]:
    """For each step of the slider, of all points and not only of those shown: how many stay, and how many of these
    are within 1 spacing, or are expected to be if that is only predicted."""
    if level is None:
        return {"kept": None, "right": None, "measured": False}
    right = inside if inside is not None else exhibit.confidence if exhibit.calibrated else None
    return {
        "kept": _at_least(level, np.ones(len(level))),
        "right": None if right is None else _at_least(level, right.astype(np.float64)),
        "measured": inside is not None,
    }


def _at_least(level: Int[np.ndarray, " rows"], weight: Float[np.ndarray, " rows"]) -> list[int]:
    """For each level the sum of the weights there and above."""
    total = np.bincount(level, weight, minlength=LEVELS + 1)[::-1].cumsum()[::-1]
    return np.rint(total).astype(int).tolist()


def _level(confidence: Float[np.ndarray, " rows"]) -> Int[np.ndarray, " rows"]:
    """The last step of the slider at which each point stays."""
    return np.clip(np.floor(confidence.astype(np.float64) * LEVELS + 1e-6), 0, LEVELS).astype(np.int64)


def _thinned(count: int, most: int) -> Int[np.ndarray, " some"]:
    """At most so many rows, at random, the same ones each time."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
