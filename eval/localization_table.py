"""The table of what comes back and of how well cameras are localized."""

from __future__ import annotations

from collections.abc import Sequence

from eval.result_tables import Column, Table, decimals, percent, pooled_table
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
    title = "what comes back, and how well cameras are localized (errors: where half of them were)"
    return [pooled_table(TABLE, title, known, columns)]
