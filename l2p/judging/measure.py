"""Figures of merit, each declared once: tables, pages, CSV and JSON read them from here.

To add one, write a :class:`Measure` and list it in ``MEASURES``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

import numpy as np

from l2p.judging.accuracy import CENTIMETRES, SPACINGS, Outcome
from l2p.judging.calibration import calibration_error, most_confident, ranking
from l2p.judging.neighbours import neighbor_scores
from l2p.utility import POINTS
from l2p.utility.localization import finite

#: Least value in a geometric mean, so that an error of 0 (points that coincide) does not make it 0.
LEAST = 1e-6
#: Lines up to which points are counted, "2 of 3": a share of so few says nothing.
COUNTED_LINES = 20

Value = float | None


def as_count(share: float, lines: int) -> str:
    """A share of ``COUNTED_LINES`` lines or fewer as their number; empty for more.

    >>> as_count(2 / 3, 3), as_count(0.5, 1000)
    ('2 of 3', '')
    """
    return f"{round(share * lines)} of {lines}" if lines <= COUNTED_LINES else ""


def geometric_mean(values: Sequence[Any]) -> float:
    """Geometric mean of positive numbers."""
    return float(np.exp(np.log(np.maximum(values, LEAST)).mean()))


def arithmetic_mean(values: Sequence[Any]) -> float:
    """Arithmetic mean of any numbers."""
    return float(np.mean(values))


class Form(Enum):
    """Kind of number of a figure; every table prints a kind in its own way."""

    COUNT = auto()
    LENGTH = auto()  # scene units
    SPACINGS = auto()
    SHARE = auto()
    NUMBER = auto()


class Need(Enum):
    """Requirement of a figure; without it, the figure is not measured."""

    CALIBRATED = auto()  # a confidence that is a probability
    RANKS = auto()  # a confidence that differs from point to point
    METRIC = auto()  # a scene in metres
    LOCALIZED = auto()  # cameras that were localized in the map
    FAKES = auto()  # elements of the map that hide no point
    NEIGHBORS = auto()  # the neighbours that an attack used, and lines that hide one point each
    PAIRS = auto()  # lines that hide two points each


@dataclass(frozen=True)
class Figure:
    """One figure of merit.

    Attributes
    ----------
    name : str
        Column of a CSV, key of a JSON file.
    heading : str
        Row of a table of figures.
    form : Form
    pool : function
        Pools the figures of several scenes into one.
    need : Need or None
    group : (str, str) or None
        Object and key in JSON files that nest the figures of a group.
    page : bool
        Whether it is a column on an audit's page.
    over, under : str
        Heading over several columns of the page, and heading of this column below it (default: the key of its group);
        without ``over``, the column has ``heading``.
    note : str
        Sentence for the page.
    compared : str
        Heading where methods are compared; empty if they are not compared by it.
    """

    name: str
    heading: str
    form: Form = Form.NUMBER
    pool: Callable[[Sequence[Any]], float] = arithmetic_mean
    need: Need | None = None
    group: tuple[str, str] | None = None
    page: bool = True
    over: str = ""
    under: str = ""
    note: str = ""
    compared: str = ""

    @property
    def column(self) -> str:
        """Heading below ``over``."""
        return self.under or (self.group[1] if self.group else self.heading)

    def counted(self, value: float, lines: int) -> str:
        """A share of few lines as their number; empty for many, and for figures that are no share of all lines."""
        of_all = self.group is not None and self.group[0] in ("within_spacings", "within_cm")
        return as_count(value, lines) if of_all else ""

    @property
    def by_spacing(self) -> bool:
        """Whether it is measured by the spacing, which in a map of few points is about the size of the map."""
        return self.form not in (Form.COUNT, Form.LENGTH) and self.need is not Need.METRIC


@dataclass(frozen=True)
class Measure:
    """Figures that are measured together; ``of`` returns them by name and may omit any whose need is not met."""

    figures: tuple[Figure, ...]
    of: Callable[[Outcome], Mapping[str, Value]]


def figures() -> list[Figure]:
    """List every figure, in the order of the tables."""
    return [figure for measure in MEASURES for figure in measure.figures]


def measured(outcome: Outcome) -> dict[str, Value]:
    """Measure every figure of a recovery, by name; None if its need is not met."""
    met = _met(outcome)
    found: dict[str, Value] = {}
    for measure in MEASURES:
        possible = [figure.name for figure in measure.figures if figure.need in met]
        values = measure.of(outcome) if possible else {}
        found |= {figure.name: values[figure.name] if figure.name in possible else None for figure in measure.figures}
    return found


def _met(outcome: Outcome) -> set[Need | None]:
    needs = {
        None: True,
        Need.CALIBRATED: outcome.recovery.calibrated,
        Need.RANKS: outcome.ranks,
        Need.METRIC: outcome.metric,
        Need.LOCALIZED: outcome.localization is not None,
        Need.FAKES: outcome.fakes is not None,
        Need.NEIGHBORS: outcome.right is not None,
        Need.PAIRS: outcome.both is not None,
    }
    return {need for need, met in needs.items() if met}


def _accuracy(outcome: Outcome) -> dict[str, Value]:
    error, spacing = outcome.error, outcome.spacing
    return {
        "lines": len(error),
        "spacing": spacing,
        "median": float(np.median(error)),
        "mean": float(error.mean()),
        "median_spacings": float(np.median(error) / spacing),
        **{f"within_{t:g}": float((error <= t * spacing).mean()) for t in SPACINGS},
        **{f"within_{t:g}_cm": float((error <= t / 100).mean()) for t in CENTIMETRES},
    }


def _within(limit: float) -> Figure:
    one = limit == 1
    note = "Recovered within: share of the published points that come out at most so far from their true place."
    return Figure(
        f"within_{limit:g}",
        f"within {limit:g} {'spacing' if one else 'spacings'}",
        Form.SHARE,
        group=("within_spacings", f"{limit:g}"),
        page=limit <= 2,
        over="Recovered within … spacings",
        note=note if one else "",
        compared="within 1 spacing" if one else "",
    )


def _within_cm(limit: float) -> Figure:
    name, group, over = f"within_{limit:g}_cm", ("within_cm", f"{limit:g}"), "Recovered within … cm"
    return Figure(name, f"within {limit:g} cm", Form.SHARE, need=Need.METRIC, group=group, over=over)


ACCURACY = Measure(
    (
        Figure("lines", "lines", Form.COUNT),
        Figure("spacing", "spacing (scene units)", Form.LENGTH, page=False),
        Figure("median", "median error (scene units)", Form.LENGTH, geometric_mean, page=False),
        Figure("mean", "mean error (scene units)", Form.LENGTH, geometric_mean, page=False),
        Figure(
            "median_spacings",
            "median error (spacings)",
            Form.SPACINGS,
            geometric_mean,
            compared="median (spacings)",
        ),
        *map(_within, SPACINGS),
        *map(_within_cm, CENTIMETRES),
    ),
    _accuracy,
)


def _confidence(outcome: Outcome) -> dict[str, Value]:
    confidence, inside = outcome.confidence, outcome.inside
    return {
        "confident_half": most_confident(confidence, inside, 2),
        "confident_quarter": most_confident(confidence, inside, 4),
        "expected_within": float(confidence.mean(dtype=np.float64)),
        "calibration_error": calibration_error(confidence, inside),
        "confidence_auc": ranking(confidence, inside),
    }


CONFIDENCE = Measure(
    (
        Figure(
            "confident_half",
            "most confident half within 1 spacing",
            Form.SHARE,
            need=Need.RANKS,
            over="Within 1 spacing",
            under="confident half",
            note="Confident half: the same of the half of the points that the attack is most confident of.",
        ),
        Figure("confident_quarter", "most confident quarter within 1 spacing", Form.SHARE, need=Need.RANKS, page=False),
        Figure(
            "expected_within",
            "within 1 spacing as predicted",
            Form.SHARE,
            need=Need.CALIBRATED,
            over="Within 1 spacing",
            under="as predicted",
            note="As predicted: what an attacker, who does not know the truth, would expect.",
        ),
        Figure(
            "calibration_error",
            "calibration error",
            need=Need.CALIBRATED,
            note="Calibration error: mean gap between the confidence and the share that is right, in groups of equal "
            "confidence; 0 is best.",
        ),
        Figure("confidence_auc", "right points ranked above wrong ones", need=Need.RANKS, page=False),
    ),
    _confidence,
)


def _fakes(outcome: Outcome) -> dict[str, Value]:
    fakes = outcome.fakes
    assert fakes is not None
    return {"fakes_auc": ranking(outcome.recovery.confidence, ~fakes)}


FAKES = Measure(
    (
        Figure(
            "fakes_auc",
            "real elements ranked above fakes",
            need=Need.FAKES,
            page=False,
            note="Real elements ranked above fakes: probability that an element that hides a point has a greater "
            "confidence than one that hides none.",
        ),
    ),
    _fakes,
)


def _neighbours(outcome: Outcome) -> dict[str, Value]:
    recovery = outcome.recovery
    assert recovery.neighbors is not None
    found = neighbor_scores(recovery.neighbors, outcome.truth.xyz, recovery.affinity, outcome.right)
    return dict(zip((figure.name for figure in NEIGHBOURS.figures), found, strict=True))


def _of_neighbours(name: str, heading: str, form: Form, compared: str = "") -> Figure:
    return Figure(name, heading, form, need=Need.NEIGHBORS, page=False, compared=compared)


NEIGHBOURS = Measure(
    (
        _of_neighbours("neighbor_precision", "neighbour precision", Form.SHARE, "neighbour precision"),
        _of_neighbours("under_half_outliers", "lines under 50 % outliers", Form.SHARE, "lines under 50 % outliers"),
        _of_neighbours("neighbors_used", "neighbours used", Form.NUMBER),
    ),
    _neighbours,
)


def _pairs(outcome: Outcome) -> dict[str, Value]:
    both = outcome.both
    assert both is not None
    return {"both_within_1": float(both.mean())}


PAIRS = Measure(
    (Figure("both_within_1", "both points of a line within 1 spacing", Form.SHARE, need=Need.PAIRS, page=False),),
    _pairs,
)


def _localization(outcome: Outcome) -> dict[str, Value]:
    """Errors of the cameras in the hidden map and in its points; None where half of them were lost."""
    localization = outcome.localization
    assert localization is not None
    limit, found = localization.limits[1], {}
    for trial in localization.trials:
        what = "points" if trial.scheme == POINTS else "lines"
        found[f"{what}_position"] = finite(100 * trial.position / localization.extent)
        found[f"{what}_rotation"] = finite(trial.rotation)
        found[f"{what}_localized"] = trial.within(limit, localization.extent)
    return found


def _localized(what: str) -> tuple[Figure, ...]:
    """Figures of cameras that are localized in lines or points."""
    made = [
        ("position", "median position error (% of the cameras' extent)", Form.NUMBER, geometric_mean),
        ("rotation", "median rotation error (deg)", Form.NUMBER, geometric_mean),
        ("localized", "localized", Form.SHARE, arithmetic_mean),
    ]
    return tuple(
        Figure(f"{what}_{name}", f"cameras in {what}: {heading}", form, pool, Need.LOCALIZED, page=False)
        for name, heading, form, pool in made
    )


LOCALIZATION = Measure((*_localized("lines"), *_localized("points")), _localization)

#: Every measure, in the order of the tables.
MEASURES: tuple[Measure, ...] = (ACCURACY, CONFIDENCE, FAKES, NEIGHBOURS, PAIRS, LOCALIZATION)
