"""Scores of a recovery: every figure of merit, measured against the truth."""

from __future__ import annotations

import numbers
from dataclasses import dataclass
from typing import Any

import numpy as np

from l2p.checks import named
from l2p.errors import InputError
from l2p.io.given import GivenRecovery, GivenTruth, given_recovery, given_truth
from l2p.judging.accuracy import compare
from l2p.judging.measure import Value, figures, measured


@dataclass(frozen=True)
class Scores:
    """Figures of a recovery, each an attribute; lengths in scene units unless the name says spacings.

    Attributes
    ----------
    figures : dict
        Every figure by name (:mod:`l2p.judging.measure`), None if it was not measured.
    lines : int
        Number of true points; equal to the number of lines unless some hide two points or none.
    spacing : float
        Median distance to the 50th neighbour in the full true cloud.
    median, mean : float
        Median and mean error.
    median_spacings : float
        Median error over the spacing.
    within_spacings, within_cm : dict
        Share of points within each threshold; ``within_cm`` is empty unless the scene is metric.
    confident_half, confident_quarter : float or None
        Share within 1 spacing among the most confident half and quarter; None if all confidences are equal.
    expected_within : float or None
        Mean confidence, the predicted share within 1 spacing; None if it only ranks.
    calibration_error : float or None
        Expected calibration error of the confidence as the probability of lying within 1 spacing, in 15 bins of
        equal size; None if the confidence only ranks.
    confidence_auc : float or None
        Probability that a point within 1 spacing has a greater confidence than one outside.
    fakes_auc : float or None
        Probability that an element that hides a point has a greater confidence than a fake; None without fakes.
    neighbor_precision, under_half_outliers, neighbors_used : float or None
        See :class:`l2p.judging.neighbours.NeighborScores`; None without neighbours.
    """

    figures: dict[str, Value]

    def __repr__(self) -> str:
        told = {name: self.figures.get(name) for name in ("lines", "median_spacings", "within_1", "calibration_error")}
        return f"Scores({', '.join(f'{k}={v:.4g}' for k, v in told.items() if v is not None)}, ...)"

    def __getattr__(self, name: str) -> Any:
        if name in self.__dict__.get("figures", {}):
            return self.figures[name]
        group = {figure.group[1]: figure.name for figure in figures() if figure.group and figure.group[0] == name}
        if not group:
            raise AttributeError(f"scores have no figure {name!r}")
        return {key: self.figures[own] for key, own in group.items() if self.figures[own] is not None}

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for a JSON file; None for a figure that is missing or not finite."""
        names = dict.fromkeys(figure.group[0] if figure.group else figure.name for figure in figures())
        values = {name: getattr(self, name) for name in names}
        return {name: None if value == np.inf else value for name, value in values.items()}


def evaluate(
    recovery: GivenRecovery,
    truth: GivenTruth,
    spacing: float | None = None,
    metric: bool = False,
) -> Scores:
    """Score a recovery against the true points.

    Parameters
    ----------
    recovery : Recovery, path or (lines, 3) array
        Recovered points, or the path of their npz; an array is in the order of the lines.
    truth : Truth, Hiding, path or (lines, 3) array
        True points, or the path of their npz; an array is in the order of the lines.
    spacing : float, optional
        Spacing of the full true cloud, scene units. Default: the one saved with the truth; without it, that of the
        true points, which is right only if all points were hidden.
    metric : bool
        The scene is in metres: shares within centimetres are measured, too.

    Returns
    -------
    Scores

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is anything else, truth and recovery are not of the same lines, or the spacing is no positive number.

    Notes
    -----
    Every true point counts once. A point without a recovered row has an infinite error and confidence 0.

    Examples
    --------
    >>> import l2p
    >>> hidden = l2p.hide(l2p.simulate("room", 200), seed=0)
    >>> scores = l2p.evaluate(l2p.recover(hidden.map, method="tomography"), hidden.truth)
    >>> scores.lines, 0 <= scores.within_spacings["1"] <= 1
    (200, True)
    """
    if spacing is not None and not (isinstance(spacing, numbers.Real) and 0 < spacing < np.inf):
        raise InputError(f"got spacing {named(spacing)}; expected a length above 0, in scene units")
    return Scores(measured(compare(given_recovery(recovery), given_truth(truth), spacing, metric)))
