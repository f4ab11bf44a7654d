"""The table of what comes back and of how well cameras are localized."""

from __future__ import annotations

from collections.abc import Sequence

from eval.result_tables import Column, Table, decimals, distinct, percent, pooled
from eval.scoring import Row
from l2p.judging.measure import arithmetic_mean, geometric_mean

#: Name of the table.
TABLE = "localization"


def localization_tables(rows: Sequence[Row]) -> list[Table]:
    """Tabulate what comes back and how well cameras are localized, for each method and fraction; nothing without."""
    known = [row for row in rows if row.get("lines_localized") is not None]
    if not known:
        return []
    columns = [
        Column("within 1 spacing", "within_1", arithmetic_mean, percent),
        Column("position, lines (%)", "lines_position", geometric_mean, decimals),
        Column("position, points (%)", "points_position", geometric_mean, decimals),
        Column("rotation, lines (deg)", "lines_rotation", geometric_mean, decimals),
        Column("rotation, points (deg)", "points_rotation", geometric_mean, decimals),
        Column("localized, lines", "lines_localized", arithmetic_mean, percent),
        Column("localized, points", "points_localized", arithmetic_mean, percent),
    ]
    body = []
    for fraction in sorted(distinct(known, "fraction"), reverse=True):
        here = [row for row in known if row["fraction"] == fraction]
        for method in distinct(here, "method"):
            own = [row for row in here if row["method"] == method]
            scenes = str(len(distinct(own, "scene")))
            body.append([method, f"{100 * fraction:g} %", scenes, *(pooled(own, column) for column in columns)])
    title = "what comes back, and how well cameras are localized (errors: where half of them were)"
    return [Table(TABLE, title, ["method", "points", "scenes", *(column.heading for column in columns)], body)]
