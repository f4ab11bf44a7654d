"""The table of schemes: what comes back of a map for each way to hide it, attacker and share of the points."""

from __future__ import annotations

from collections.abc import Sequence

from eval.result_tables import Column, Table, decimals, distinct, fractions_of, percent, pooled
from eval.scoring import Row
from l2p.judging.measure import arithmetic_mean, geometric_mean

#: Name of the table of all scenes, and of the table scene by scene.
TABLE, BY_SCENE = "schemes", "schemes-scenes"

#: Figures of a cell of the table, and those that only some schemes or runs have.
SHARE = Column("within 1 spacing", "within_1", arithmetic_mean, percent)
MEDIAN = Column("median", "median_spacings", geometric_mean, decimals)
_FURTHER = (
    Column("both points of a line", "both_within_1", arithmetic_mean, percent),
    Column("real told from fake (AUC)", "fakes_auc", arithmetic_mean, decimals),
    Column("position, released (%)", "lines_position", geometric_mean, decimals),
    Column("localized, released", "lines_localized", arithmetic_mean, percent),
)


def scheme_tables(rows: Sequence[Row]) -> list[Table]:
    """Tabulate every scheme and method, the fractions side by side; nothing for runs with uniform lines only."""
    if len(distinct(rows, "scheme")) < 2:
        return []
    fractions = fractions_of(rows)
    further = [column for column in _FURTHER if any(row.get(column.name) is not None for row in rows)]
    largest = fractions[0]
    body = []
    for scheme in distinct(rows, "scheme"):
        for method in distinct([row for row in rows if row["scheme"] == scheme], "method"):
            own = [row for row in rows if row["method"] == method]
            cells = []
            for fraction in fractions:
                here = [row for row in own if row["fraction"] == fraction]
                cells.append(f"{pooled(here, SHARE)} / {pooled(here, MEDIAN)}" if here else "-")
            full = [row for row in own if row["fraction"] == largest]
            cells += [_known(full, column) for column in further]
            body.append([scheme, method.removeprefix(f"{scheme}: "), *cells])
    shares = [f"{100 * fraction:g} % of the points" for fraction in fractions]
    title = "within 1 spacing / median error in spacings, by scheme and attacker"
    if further:
        title += f"; further columns at {100 * largest:g} %"
    pooled_table = Table(TABLE, title, ["scheme", "attacker", *shares, *(column.heading for column in further)], body)
    return [pooled_table, _scene_table([row for row in rows if row["fraction"] == largest])]


def _scene_table(rows: Sequence[Row]) -> Table:
    """The same at one fraction, scene by scene."""
    scenes, body = distinct(rows, "scene"), []
    for scheme in distinct(rows, "scheme"):
        for method in distinct([row for row in rows if row["scheme"] == scheme], "method"):
            cells = []
            for scene in scenes:
                own = [row for row in rows if (row["method"], row["scene"]) == (method, scene)]
                cells.append(f"{pooled(own, SHARE)} / {pooled(own, MEDIAN)}" if own else "-")
            body.append([scheme, method.removeprefix(f"{scheme}: "), *cells])
    title = f"scene by scene at {100 * rows[0]['fraction']:g} %: within 1 spacing / median error in spacings"
    return Table(BY_SCENE, title, ["scheme", "attacker", *scenes], body)


def _known(rows: Sequence[Row], column: Column) -> str:
    known = [row for row in rows if row.get(column.name) is not None]
    return pooled(known, column) if known else "-"
