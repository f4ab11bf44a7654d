"""What appearance gives away: each method that sees colours or descriptors against the same method on lines alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from eval.result_tables import Column, Table, decimals, distinct, fractions_of, pooled, pooled_table, spread_of
from eval.scoring import Row
from eval.targets import References, by_cloud, cloud, confidence_columns, maximum, with_ratios
from l2p.judging.measure import arithmetic_mean, geometric_mean

#: Name of the table of all scenes, and of the table scene by scene.
POOLED, BY_SCENE = "appearance", "appearance-scenes"


def appearance_tables(rows: Sequence[Row], references: References) -> list[Table]:
    """Tabulate every method that sees attributes, over all scenes and scene by scene; nothing if none does."""
    compared = [row for row in compare_sights(rows, references) if row["method"] in references.seeing]
    return [_pooled_table(compared), _scene_table(compared)] if compared else []


def compare_sights(rows: Sequence[Row], references: References) -> list[Row]:
    """Add to the rows what a method gains by what it sees; None without its reference on the same line cloud.

    ``wrong_gain``: share of the points that are *not* within 1 spacing, over that of the same method on lines alone.
    ``median_gain``: the median error over that error. ``over_bound``: share within 1 spacing minus that of the
    leave-one-out bound that sees the same.
    """
    of = by_cloud(rows)
    found = []
    for row in with_ratios(rows, references):
        alone = of.get((references.alone.get(row["method"]), *cloud(row)))
        bound = of.get((references.bound(row["method"]), *cloud(row)))
        gains: dict[str, float | None] = {"wrong_gain": None, "median_gain": None, "over_bound": None}
        if alone is not None:
            gains["wrong_gain"] = _ratio(1 - row["within_1"], 1 - alone["within_1"])
            gains["median_gain"] = _ratio(row["median_spacings"], alone["median_spacings"])
        if bound is not None and bound["method"] != row["method"]:
            gains["over_bound"] = row["within_1"] - bound["within_1"]
        found.append({**row, **gains})
    return found


def _pooled_table(rows: Sequence[Row]) -> Table:
    columns = [
        Column("wrong / lines alone", "wrong_gain", geometric_mean, decimals),
        Column("wrong, worst scene", "wrong_gain", maximum, decimals),
        Column("median / lines alone", "median_gain", geometric_mean, decimals),
        Column("median, worst scene", "median_gain", maximum, decimals),
        Column("share within 1 - LOO's", "over_bound", arithmetic_mean, signed),
        Column("share - LOO's, worst scene", "over_bound", _minimum, signed),
        *confidence_columns(rows),
    ]
    title = f"what appearance gives away: each method against itself on lines alone{spread_of(rows)}"
    return pooled_table(POOLED, title, rows, columns)


def _scene_table(rows: Sequence[Row]) -> Table:
    columns = [
        Column("wrong", "wrong_gain", geometric_mean, _short),
        Column("median", "median_gain", geometric_mean, _short),
    ]
    methods = distinct(rows, "method")
    body = []
    for fraction in fractions_of(rows):
        here = [row for row in rows if row["fraction"] == fraction]
        for scene in distinct(here, "scene"):
            cells = []
            for method in methods:
                own = [row for row in here if (row["scene"], row["method"]) == (scene, method)]
                cells.append(" / ".join(pooled(own, column) for column in columns) if own else "-")
            body.append([scene, f"{100 * fraction:g} %", *cells])
    title = "each scene: wrong / median, over those on lines alone"
    return Table(BY_SCENE, title, ["scene", "points", *methods], body)


def signed(value: float) -> str:
    """Format a difference of shares, in percentage points."""
    return f"{100 * value:+.1f}"


def _short(value: float) -> str:
    return f"{value:.2f}"


def _ratio(value: float, below: float) -> float | None:
    return value / below if below else None


def _minimum(values: Sequence[Any]) -> float:
    return float(np.min(values))
