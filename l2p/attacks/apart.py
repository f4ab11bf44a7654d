"""Parts of a map that lie far apart: attacked one by one, then put together with one meaning of the confidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from l2p.attacks.attack import Attack, Estimate
from l2p.geometry.frame import middle
from l2p.geometry.parts import distances, parts_of
from l2p.geometry.points import nearest_neighbors
from l2p.maps.lines import LineCloud
from l2p.schemes.recognition import UNIFORM, Recognition

#: The spacing of points is the median distance to so many neighbours (:func:`l2p.judging.accuracy.spacing`).
_SPACING_NEIGHBOR = 50


class Attacked(NamedTuple):
    """The points of some lines: positions in the scene, their lines and colours, and the estimate of their attack."""

    xyz: Float[np.ndarray, "points 3"]
    beta: Float[np.ndarray, " points"]
    line: Int[np.ndarray, " points"]
    rgb: UInt8[np.ndarray, "points 3"] | None
    estimate: Estimate


def parts_for(
    lines: LineCloud, attack: Attack, known: str, recognised: Recognition
) -> list[Int[np.ndarray, " _"]] | None:
    """Rows of the parts that are attacked one by one; None if the lines are one part, or no parts can be told.

    Lines through a few centres are all near these, however far their points are; lines that are not uniform may pass
    near a place for other reasons than their points.
    """
    if not attack.by_part or known == "rays" or not (recognised.expected or known != UNIFORM):
        return None
    parts = parts_of(lines)
    return parts if len(parts) > 1 else None


def together(attacked: Sequence[Attacked], parts: Sequence[Int[np.ndarray, " _"]], attack: Attack) -> Attacked:
    """Put the points of all parts in the order of the lines.

    The confidence is about 1 spacing of the whole map, as the recovered points tell it: the points of a part that is
    less dense are less often as near to their places. A point alone has no spacing, and confidence 0.
    """
    reach = [_reach(each.xyz) for each in attacked]
    whole = float(np.median(np.concatenate(reach)))
    ratios = [whole / max(float(np.median(each)), np.finfo(float).tiny) for each in reach]
    line = np.concatenate([part[each.line] for each, part in zip(attacked, parts, strict=True)])
    order = np.argsort(line, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    first = np.cumsum([0, *(len(each.line) for each in attacked)])
    neighbors = [
        np.where(near >= 0, place[start + np.maximum(near, 0)], -1)
        for start, near in zip(first, (each.estimate.neighbors.cpu().numpy() for each in attacked), strict=False)
    ]
    confidence = [attack.within(each.estimate, ratio) for each, ratio in zip(attacked, ratios, strict=True)]
    affinity = _stacked([each.estimate.affinity.cpu().numpy() for each in attacked], 0)[order]
    estimate = Estimate(
        torch.cat([each.estimate.beta for each in attacked])[torch.as_tensor(order)],
        torch.cat([each.float().cpu() for each in confidence])[torch.as_tensor(order)],
        torch.as_tensor(_stacked(neighbors, -1)[order]),
        torch.as_tensor(affinity),
    )
    xyz, beta = (np.concatenate(column)[order] for column in zip(*(each[:2] for each in attacked), strict=True))
    colours = [each.rgb for each in attacked if each.rgb is not None]
    return Attacked(xyz, beta, line[order], np.concatenate(colours)[order] if colours else None, estimate)


def described(lines: LineCloud, parts: Sequence[Int[np.ndarray, " _"]]) -> list[dict[str, Any]]:
    """Lines, centre and size (median distance of the lines from it) of each part, scene units; plain values."""
    found = []
    for part in parts:
        direction, moment = lines.direction[part], lines.moment[part]
        center = middle(direction, moment)
        size = float(np.median(distances(direction, moment, center)))
        found.append({"lines": len(part), "center": center.tolist(), "size": size})
    return found


def apart_words(info: dict[str, Any]) -> str:
    """Say that the parts of a map were attacked by themselves; empty if it has one only.

    ``info`` is that of a recovery; its ``parts`` are those of :func:`described`.
    """
    parts = [part["lines"] for part in info.get("parts", [])]
    if not parts:
        return ""
    return (
        f"{far_words(parts)}. Each of the {len(parts)} parts was attacked by itself; the confidence is about 1 spacing "
        "of the whole map."
    )


def far_words(parts: Sequence[int]) -> str:
    """Say how many lines are not in the largest part, from the lines of each.

    >>> far_words([900, 99, 1])
    '100 of 1,000 lines lie far outside the largest part of the map (900 lines)'
    """
    far = sum(parts) - parts[0]
    return (
        f"{far:,} of {sum(parts):,} lines {'lies' if far == 1 else 'lie'} far outside the largest part of the map "
        f"({parts[0]:,} lines)"
    )


def _reach(xyz: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    """Distance of each point to its 50th neighbour, to the farthest of few points, infinite for a point alone."""
    distance = nearest_neighbors(xyz, _SPACING_NEIGHBOR).distance
    return distance[:, -1] if distance.size else np.full(len(xyz), np.inf)


def _stacked(columns: Sequence[np.ndarray], none: float) -> np.ndarray:
    """Rows of arrays of different widths, with ``none`` where a row is short."""
    width = max(each.shape[1] for each in columns)
    padded = [np.pad(each, ((0, 0), (0, width - each.shape[1])), constant_values=none) for each in columns]
    return np.concatenate(padded)
