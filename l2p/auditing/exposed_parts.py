"""Which part of a map is exposed: boxes with equally many published points, and how many of each come back."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from l2p.auditing.audit import Audit
from l2p.judging.accuracy import errors
from l2p.maps.region import Corner
from l2p.show.page.numbers import count, percent

#: Times that the map is halved, and fewest points of a part.
_HALVINGS, _LEAST = 3, 50
#: Share of the points on each side that does not count for the size of a part.
_TAIL = 0.02


@dataclass(frozen=True)
class Part:
    """A box of the map along the axes of the scene.

    Attributes
    ----------
    low, high : (x, y, z)
        Corners, scene units.
    points : int
        Published points in it.
    within : float
        Share of these that come back within 1 spacing.
    """

    low: Corner
    high: Corner
    points: int
    within: float


def parts_of(audit: Audit) -> list[Part]:
    """Halve the map along its longest side until the parts are few and small, the most exposed first.

    The largest fraction counts, attacked by all that is published; empty without true points, or for a small map.
    """
    trial = audit.trials[0]
    if trial.truth is None:
        return []
    halvings = min(_HALVINGS, int(np.log2(max(1, len(trial.truth) / _LEAST))))
    if halvings < 1:
        return []
    xyz = trial.truth.xyz
    right = errors(trial.recovery, trial.truth) <= audit.spacing
    groups = [np.arange(len(xyz))]
    for _ in range(halvings):
        groups = [half for rows in groups for half in _halves(xyz, rows)]
    parts = [_part(xyz[rows], float(right[rows].mean())) for rows in groups]
    return sorted(parts, key=lambda part: -part.within)


class PartRow(NamedTuple):
    """A part as the page tells it; the corners are for its script."""

    value: str
    share: str
    points: str
    low: str
    high: str


def part_rows(parts: list[Part]) -> list[PartRow]:
    """Format parts for the page."""
    return [
        PartRow(
            f"{part.within:.3f}",
            percent(part.within),
            count(part.points),
            " ".join(map(repr, part.low)),
            " ".join(map(repr, part.high)),
        )
        for part in parts
    ]


def parts_dict(parts: list[Part]) -> list[dict[str, Any]]:
    """Return plain values, for a JSON file."""
    return [asdict(part) for part in parts]


def _halves(
    xyz: Float[np.ndarray, "points 3"], rows: Int[np.ndarray, " some"]
) -> tuple[Int[np.ndarray, " half"], Int[np.ndarray, " rest"]]:
    low, high = np.quantile(xyz[rows], (_TAIL, 1 - _TAIL), axis=0)
    order = rows[np.argsort(xyz[rows, int((high - low).argmax())], kind="stable")]
    return order[: len(order) // 2], order[len(order) // 2 :]


def _part(xyz: Float[np.ndarray, "points 3"], within: float) -> Part:
    low, high = (tuple(corner.tolist()) for corner in (xyz.min(axis=0), xyz.max(axis=0)))
    return Part(low, high, len(xyz), within)
