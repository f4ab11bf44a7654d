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
from l2p.show.page.sides import sides_of
from l2p.show.stance import Stance

#: Most lines that a view draws; more fill the picture evenly and show no structure.
MOST_LINES = 4_000
#: Steps of the confidence slider.
LEVELS = 100


def view_data(exhibits: Sequence[tuple[str, Exhibit]], most_points: int = MOST_POINTS) -> dict[str, Any]:
    """The data of the view's script, as plain values for JSON.

    Parameters
    ----------
    exhibits : sequence of (str, Exhibit)
        Labels and clouds; the first one is shown first, and its stance is that of all.
    most_points : int
        Larger clouds are thinned to this many points, at random.
    """
    stance = Stance.before(exhibits[0][1])
    clouds = [_cloud(label, exhibit, stance, most_points) for label, exhibit in exhibits]
    return {
        "levels": LEVELS,
        "errorLimit": ERROR_LIMIT,
        "stance": {"center": stance.center.tolist(), "radius": stance.radius, "axes": stance.axes.tolist()},
        "spacing": exhibits[0][1].spacing,
        "sides": sides_of(exhibits[0][1], stance),
        "clouds": _stored_once(clouds),
    }


def _stored_once(clouds: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Replace a layer that an earlier cloud has, too, by the number of that cloud: attackers share points and lines."""
    first: dict[tuple[str, str], int] = {}
    for number, cloud in enumerate(clouds):
        for layer in ("points", "lines", "rgb"):
            earlier = first.setdefault((layer, cloud[layer]), number) if cloud[layer] else number
            if earlier < number:
                cloud[layer] = earlier
    return clouds


def _cloud(label: str, exhibit: Exhibit, stance: Stance, most_points: int) -> dict[str, Any]:
    rows = _thinned(len(exhibit), most_points)
    level = None if exhibit.confidence is None else _level(exhibit.confidence)
    inside = None if exhibit.error is None else exhibit.error <= 1
    error = None if exhibit.error is None else np.clip(exhibit.error / ERROR_LIMIT * 255, 0, 255).astype(np.uint8)
    return {
        "label": label,
        "count": len(exhibit),
        "shown": len(rows),
        "points": _positions(exhibit.points, rows, stance),
        "recovered": _positions(exhibit.recovered, rows, stance),
        "rgb": None if exhibit.rgb is None else _base64(exhibit.rgb[rows]),
        "level": None if level is None else _base64(level[rows].astype(np.uint8)),
        "error": None if error is None else _base64(error[rows]),
        "calibrated": exhibit.calibrated,
        **_lines(exhibit.lines, rows, stance),
        **_counts(level, inside, exhibit),
    }


def _positions(
    points: Float[np.ndarray, "rows 3"] | None, rows: Int[np.ndarray, " some"], stance: Stance
) -> str | None:
    return None if points is None else _base64(stance.enter(points[rows]).astype("<f4"))


def _lines(lines: LineCloud | None, rows: Int[np.ndarray, " some"], stance: Stance) -> dict[str, Any]:
    """Ends of the drawn lines, their number, and the number of lines tried: some may miss the view."""
    if lines is None:
        return {"lines": None, "linesTried": 0, "linesShown": 0}
    tried = rows[_thinned(len(rows), MOST_LINES)]
    chords = stance.chords(LineCloud(lines.direction[tried], lines.moment[tried]))
    return {"lines": _base64(chords.astype("<f4")), "linesTried": len(tried), "linesShown": len(chords)}


def _counts(
    level: Int[np.ndarray, " rows"] | None, inside: Bool[np.ndarray, " rows"] | None, exhibit: Exhibit
) -> dict[str, Any]:
    """Points that stay at each step of the slider, and those of them within 1 spacing: measured, or expected from a
    calibrated confidence. All points count, not only those shown."""
    if level is None:
        return {"kept": None, "right": None, "measured": False}
    right = inside if inside is not None else exhibit.confidence if exhibit.calibrated else None
    return {
        "kept": _at_least(level, np.ones(len(level))),
        "right": None if right is None else _at_least(level, right.astype(np.float64)),
        "measured": inside is not None,
    }


def _at_least(level: Int[np.ndarray, " rows"], weight: Float[np.ndarray, " rows"]) -> list[int]:
    """Sum of the weights at each level and above."""
    total = np.bincount(level, weight, minlength=LEVELS + 1)[::-1].cumsum()[::-1]
    return np.rint(total).astype(int).tolist()


def _level(confidence: Float[np.ndarray, " rows"]) -> Int[np.ndarray, " rows"]:
    """Last step of the slider at which each point stays."""
    return np.clip(np.floor(confidence.astype(np.float64) * LEVELS + 1e-6), 0, LEVELS).astype(np.int64)


def _thinned(count: int, most: int) -> Int[np.ndarray, " some"]:
    """At most ``most`` rows, at random, the same in every call."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
