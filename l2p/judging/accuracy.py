"""Errors of a recovery against the truth, in scene units and in spacings.

*Spacing* is the median distance to the 50th neighbour in the **full** true cloud, also when only a fraction of it was
lifted: figures at different densities then have the same unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.checks import finite_rows
from l2p.errors import InputError
from l2p.geometry.points import nearest_neighbors
from l2p.judging.neighbours import right_neighbors
from l2p.maps.recovery import Recovery
from l2p.maps.short_repr import short_repr
from l2p.maps.truth import Truth
from l2p.utility.localization import Localization

#: Error thresholds of the reported shares, in spacings.
SPACINGS = (0.25, 0.5, 1.0, 2.0, 5.0)
#: Error thresholds of the reported shares in a metric scene, in centimetres.
CENTIMETRES = (1.0, 2.5, 5.0, 10.0, 25.0, 50.0)
#: Rank of the neighbour that defines the spacing: the number of true neighbours in Chelani et al. (CVPR 2021).
SPACING_NEIGHBOR = 50


def spacing(points: Float[np.ndarray, "points 3"]) -> float:
    """Median distance to the 50th neighbour (to the farthest point, in clouds of 50 points or fewer), scene units.

    Raises
    ------
    InputError
        If there is no scale: more than half of the points coincide with 50 others, or there is only one point.
    """
    points = finite_rows("points", points)
    distance = nearest_neighbors(points, SPACING_NEIGHBOR).distance
    value = float(np.median(distance[:, -1])) if distance.size else 0.0
    if value <= 0:
        raise InputError(f"got {len(points)} points without extent; expected points that differ, to measure errors by")
    return value


def matched(recovery: Recovery, truth: Truth) -> Int[np.ndarray, " points"]:
    """Recovered row of each true point, from its own element, no row twice; -1 for none.

    Notes
    -----
    If an element has several points or rows, they are matched with the least total distance.
    """
    if recovery.one_each and truth.one_each:
        return np.where(truth.element < len(recovery), truth.element, -1)
    order = np.argsort(recovery.element, kind="stable")
    own = recovery.element[order]
    begin, end = (np.searchsorted(own, truth.element, side) for side in ("left", "right"))
    row = np.full(len(truth), -1)
    found = end > begin
    row[found] = order[begin[found]]
    _, element, count = np.unique(truth.element, return_inverse=True, return_counts=True)
    several = found & ((count[element] > 1) | (end - begin > 1))
    points = np.flatnonzero(several)[np.argsort(element[several], kind="stable")]
    for group in np.split(points, np.flatnonzero(np.diff(element[points])) + 1) if len(points) else []:
        row[group] = _assigned(truth.xyz[group], recovery.xyz, order[begin[group[0]] : end[group[0]]])
    return row


def _assigned(
    true: Float[np.ndarray, "points 3"], recovered: Float[np.ndarray, "rows 3"], rows: Int[np.ndarray, " own"]
) -> Int[np.ndarray, " points"]:
    """Recovered row of each point of one element, -1 for none."""
    from scipy.optimize import linear_sum_assignment

    distance = np.linalg.norm(true[:, None] - recovered[rows], axis=2)
    point, place = linear_sum_assignment(distance)
    row = np.full(len(true), -1)
    row[point] = rows[place]
    return row


def errors(
    recovered: Recovery | Float[np.ndarray, "rows 3"], truth: Truth | Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, " points"]:
    """Distance of each true point from its matched recovered point, scene units.

    Infinite for a point whose element has no recovered row left. Recovered rows of fakes are ignored. In bare arrays,
    row i belongs to element i.
    """
    recovery, true = _recovery(recovered), _truth(truth)
    return _distance(recovery, true, matched(recovery, true))


@dataclass(frozen=True, eq=False)
class Outcome:
    """A recovery compared with the truth, point by point.

    Attributes
    ----------
    recovery : Recovery
    truth : Truth
    spacing : float
        Spacing of the full true cloud, scene units.
    row : (points,) int64
        Recovered row of each true point, -1 for none (:func:`matched`).
    error : (points,) float64
        Error in scene units, infinite where there is no row.
    confidence : (points,) float32
        Confidence of the recovered row, 0 where there is none.
    metric : bool
        The scene is in metres.
    localization : Localization or None
        Cameras localized in the map that was attacked, and in its points as they are.
    """

    recovery: Recovery
    truth: Truth
    spacing: float
    row: Int[np.ndarray, " points"]
    error: Float[np.ndarray, " points"]
    confidence: Float[np.ndarray, " points"]
    metric: bool = False
    localization: Localization | None = None

    __repr__ = short_repr

    @property
    def inside(self) -> Bool[np.ndarray, " points"]:
        """Mask of the points within 1 spacing."""
        return self.error <= self.spacing

    @property
    def ranks(self) -> bool:
        """Whether the confidence differs from point to point."""
        return bool(self.confidence.min() < self.confidence.max())

    @property
    def fakes(self) -> Bool[np.ndarray, " rows"] | None:
        """Mask of the recovered rows whose element hides no point; None if there are none of them, or only them."""
        fake = ~np.isin(self.recovery.element, self.truth.element)
        return fake if fake.any() and not fake.all() else None

    @property
    def spacings(self) -> Float[np.ndarray, " points"]:
        """Errors in spacings."""
        return self.error / self.spacing

    @cached_property
    def both(self) -> Bool[np.ndarray, " pairs"] | None:
        """Mask of the lines with two points whose points are both within 1 spacing; None without such lines."""
        element, count = np.unique(self.truth.element, return_counts=True)
        if not (count == 2).any():
            return None
        wrong = np.isin(element, self.truth.element[~self.inside])
        return ~wrong[count == 2]

    @cached_property
    def right(self) -> Bool[np.ndarray, "lines k"] | None:
        """Mask of the true neighbours; None without neighbours, or if some line does not hide exactly one point."""
        if self.recovery.neighbors is None or not (self.recovery.one_each and self.truth.one_each):
            return None
        return right_neighbors(self.recovery.neighbors, self.truth.xyz)


def compare(
    recovery: Recovery,
    truth: Truth | Float[np.ndarray, "lines 3"],
    spacing: float | None = None,
    metric: bool = False,
) -> Outcome:
    """Compare a recovery with the truth; see :func:`l2p.evaluate`."""
    true = _truth(truth)
    if recovery.one_each and true.one_each and len(true) != len(recovery):
        raise InputError(
            f"got {len(recovery)} recovered and {len(true)} true points; expected the truth of these very lines"
        )
    row = matched(recovery, true)
    confidence = recovery.confidence[row]
    confidence[row < 0] = 0
    scale = _scale(true) if spacing is None else spacing
    return Outcome(recovery, true, scale, row, _distance(recovery, true, row), confidence, metric)


def _scale(truth: Truth) -> float:
    if truth.spacing is not None:
        return truth.spacing
    # A point that several elements hide counts once.
    return spacing(truth.xyz[np.unique(truth.index, return_index=True)[1]])


def _distance(recovery: Recovery, truth: Truth, row: Int[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
    return np.where(row < 0, np.inf, np.linalg.norm(recovery.xyz[row] - truth.xyz, axis=1))


def _recovery(points: Recovery | Float[np.ndarray, "rows 3"]) -> Recovery:
    if isinstance(points, Recovery):
        return points
    return Recovery(points, np.zeros(len(points), dtype=np.float32), np.zeros(len(points)))


def _truth(points: Truth | Float[np.ndarray, "points 3"]) -> Truth:
    if isinstance(points, Truth):
        return points
    points = finite_rows("truth", points)
    return Truth(points, np.arange(len(points)))
