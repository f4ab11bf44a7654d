"""Parts of a line cloud whose points lie far apart, found from the lines alone.

A line through a point of a place passes near all of the place, and hardly ever near another one far away. So the number
of lines that cross a ball around a place grows with its radius until all lines of the place cross it, and then stays
the same, until the ball reaches what is far away. Lines within such a ball are a part; the others are looked at in the
same way. Points of the sky, one wrong point at a huge distance and two rooms far apart are all found so, and each part
can be attacked in a frame of its own, as if the others were not there.

Real maps have points at fifty and more times their size, but not behind an empty space: they are one part, and nothing
changes for them (``docs/experiments.md``, "Far points").
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.geometry.frame import middle
from l2p.maps.lines import LineCloud

#: A place stands alone if a ball around it can grow by this factor and take up at most this share of its lines more.
_EMPTY, _STRAY = 10.0, 0.005
#: Further shares, tried in this order, for clouds so wide that few cells of a grid would be left for the place: the
#: 0.97 quantile of the distances is beyond ``_WIDE`` times the median (at most 45 times in ``shared/scenes``).
_LOOSE, _WIDE = (0.03, 0.15), 100.0
#: Least lines of a place, and least share of all lines.
_LEAST, _SHARE = 50, 0.05
#: A few lines, at most this share, are cut off if one of them is beyond this multiple of the distance of the others:
#: single precision could not hold both.
_FEW, _BEYOND = 0.03, 1e4
#: Smallest ball, over the median distance of all lines: below it, distances are rounding. Lines that meet in one point
#: are recognised before (:mod:`l2p.schemes.recognition`), and not divided.
_SMALLEST = 1e-7
#: Where the middle of all lines is in no place, pairs of lines are tried: the middle of their closest points is in the
#: place of both if they have one. Number of pairs, and of lines that are counted.
_PAIRS, _COUNTED = 200, 500
#: Lines of which the first middle is computed.
_SAMPLE = 2000
#: Most parts.
_MOST = 8


def parts_of(cloud: LineCloud) -> list[Int[np.ndarray, " _"]]:
    """Divide lines by the places of their points; one part for ordinary maps.

    Returns
    -------
    list of int64 arrays
        Rows of the lines of each part in ascending order; the part with the most lines comes first.

    Notes
    -----
    O(lines log lines). The answer does not depend on position, rotation and scale but through the pairs that are tried,
    and these only matter if no place has half of the lines.

    Examples
    --------
    >>> import numpy as np, l2p
    >>> rng = np.random.default_rng(0)
    >>> points = rng.normal(size=(300, 3)) + np.repeat([0, 1e6], [200, 100])[:, None]
    >>> [len(part) for part in parts_of(l2p.lift(points, seed=0))]
    [200, 100]
    """
    found, left = [], [np.arange(len(cloud))]
    while left:
        rows = left.pop()
        inside = None
        if len(found) + len(left) + 1 < _MOST:
            inside = _place(cloud.direction[rows], cloud.moment[rows])
        if inside is None:
            found.append(rows)
        else:
            left += [rows[~inside], rows[inside]]
    return sorted(found, key=len, reverse=True)


def _place(
    direction: Float[np.ndarray, "lines 3"], moment: Float[np.ndarray, "lines 3"]
) -> Bool[np.ndarray, " lines"] | None:
    """Mask of the lines of one place that stands alone; None if there is none."""
    some = slice(None, None, -(-len(direction) // _SAMPLE))
    center = middle(direction[some], moment[some])
    apart = distances(direction, moment, center)
    least = _SMALLEST * float(np.median(apart))
    radius = _radius(apart, least)
    if radius is None:
        other = _elsewhere(direction, moment - np.cross(center, direction), least)
        if other is None:
            return None
        center, radius = center + other[0], other[1]
        apart = distances(direction, moment, center)
    # The middle of the lines of the place is a better one than that of all lines.
    inside = apart <= radius
    apart = distances(direction, moment, middle(direction[inside], moment[inside]))
    better = _radius(apart, least)
    return inside if better is None else apart <= better


def _radius(apart: Float[np.ndarray, " lines"], least: float) -> float | None:
    """Radius of the ball around a place that stands alone, from the distances of all lines; None if it does not."""
    ordered = np.maximum(np.sort(apart), least)
    if ordered[0] == ordered[-1]:
        return None
    wide = ordered[int((1 - _FEW) * len(apart))] > _WIDE * ordered[len(apart) // 2]
    for stray in (_STRAY, *(_LOOSE if wide else ())):
        radius = _before_empty(ordered, stray)
        if radius is not None:
            return radius
    most = min(int((1 - _FEW) * len(apart)), len(apart) - 2)
    if most < _LEAST or ordered[-1] < _BEYOND * ordered[most]:
        return None
    cut = most + int((ordered[most + 1 :] / ordered[most:-1]).argmax())
    return float(np.sqrt(ordered[cut]) * np.sqrt(ordered[cut + 1]))


def _before_empty(ordered: Float[np.ndarray, " lines"], stray: float) -> float | None:
    """Radius within the widest empty space, in which at most ``stray`` of the lines before it are; None if it is not
    wide, or not more lines are behind it than in it."""
    count = len(ordered)
    inside = np.arange(max(_LEAST, int(np.ceil(_SHARE * count))), count)
    after = inside + (stray * inside).astype(np.int64)
    some = count - after > after - inside
    inside, after = inside[some], after[some]
    if len(inside) == 0:
        return None
    near, far = ordered[inside - 1], ordered[after]
    # Lines that meet in one point are at the least distance: a point is no place.
    growth = np.where(near > ordered[0], far / near, 0.0)
    best = int(growth.argmax())
    return float(np.sqrt(near[best]) * np.sqrt(far[best])) if growth[best] >= _EMPTY else None


def _elsewhere(
    direction: Float[np.ndarray, "lines 3"], moment: Float[np.ndarray, "lines 3"], least: float
) -> tuple[Float[np.ndarray, "3"], float] | None:
    """A point and a radius of a place that stands alone, away from the middle of all lines."""
    rng = np.random.default_rng(0)
    counted = rng.permutation(len(direction))[:_COUNTED]
    direction, moment = direction[counted], moment[counted]
    first, second = rng.integers(len(counted), size=(2, _PAIRS))
    centers = _closest(direction, moment, first, second)
    apart = np.linalg.norm(moment - np.cross(centers[:, None], direction), axis=2)
    ordered = np.maximum(np.sort(apart, axis=1), least)
    # Few places stand alone, so the growth of all balls is looked at together first.
    inside = np.arange(min(_LEAST, len(counted)), len(counted))
    inside = inside[inside + (_STRAY * inside).astype(np.int64) < len(counted)]
    after = inside + (_STRAY * inside).astype(np.int64)
    promising = (ordered[:, after] >= _EMPTY * ordered[:, inside - 1]).any(axis=1)
    found = None
    for row in np.flatnonzero(promising):
        radius = _before_empty(ordered[row], _STRAY)
        size = 0 if radius is None else int((apart[row] <= radius).sum())
        if radius is not None and (found is None or size > found[2]):
            found = centers[row], radius, size
    return None if found is None else found[:2]


def _closest(
    direction: Float[np.ndarray, "lines 3"],
    moment: Float[np.ndarray, "lines 3"],
    first: Int[np.ndarray, " pairs"],
    second: Int[np.ndarray, " pairs"],
) -> Float[np.ndarray, "some 3"]:
    """Middles of the closest points of pairs of lines that are not parallel."""
    one, other = direction[first], direction[second]
    foot = np.cross(direction, moment)
    cosine = np.sum(one * other, axis=1)
    keep = np.abs(cosine) < 0.99
    one, other, cosine = one[keep], other[keep], cosine[keep]
    start, end = foot[first[keep]], foot[second[keep]]
    along, back = (np.sum((end - start) * each, axis=1) for each in (one, other))
    sine2 = 1 - cosine**2
    place = start + ((along - cosine * back) / sine2)[:, None] * one
    return (place + end + ((cosine * along - back) / sine2)[:, None] * other) / 2


def distances(
    direction: Float[np.ndarray, "lines 3"], moment: Float[np.ndarray, "lines 3"], point: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " lines"]:
    """Distance of each line from a point."""
    return np.linalg.norm(moment - np.cross(point, direction), axis=1)
