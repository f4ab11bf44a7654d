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
    for scheme, attacker, own in _by_attacker(rows):
        full = [row for row in own if row["fraction"] == largest]
        cells = [_errors([row for row in own if row["fraction"] == fraction]) for fraction in fractions]
        body.append([scheme, attacker, *cells, *(_known(full, column) for column in further)])
    shares = [f"{100 * fraction:g} % of the points" for fraction in fractions]
    title = "within 1 spacing / median error in spacings, by scheme and attacker"
    if further:
        title += f"; further columns at {100 * largest:g} %"
    pooled_table = Table(TABLE, title, ["scheme", "attacker", *shares, *(column.heading for column in further)], body)
    return [pooled_table, _scene_table([row for row in rows if row["fraction"] == largest])]


def _scene_table(rows: Sequence[Row]) -> Table:
    """The same at one fraction, scene by scene."""
    scenes, body = distinct(rows, "scene"), []
    for scheme, attacker, own in _by_attacker(rows):
        cells = [_errors([row for row in own if row["scene"] == scene]) for scene in scenes]
        body.append([scheme, attacker, *cells])
    title = f"scene by scene at {100 * rows[0]['fraction']:g} %: within 1 spacing / median error in spacings"
    return Table(BY_SCENE, title, ["scheme", "attacker", *scenes], body)


def attacker_of(row: Row) -> str:
    """Name of the method without the scheme."""
    return row["method"].removeprefix(f"{row['scheme']}: ")


def _by_attacker(rows: Sequence[Row]) -> list[tuple[str, str, list[Row]]]:
    """Rows of each scheme and attacker."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row["scheme"], attacker_of(row)), []).append(row)
    order = distinct(rows, "scheme")
    return sorted(((*key, own) for key, own in found.items()), key=lambda entry: order.index(entry[0]))


def _errors(rows: Sequence[Row]) -> str:
    return f"{pooled(rows, SHARE)} / {pooled(rows, MEDIAN)}" if rows else "-"


def _known(rows: Sequence[Row], column: Column) -> str:
    known = [row for row in rows if row.get(column.name) is not None]
    return pooled(known, column) if known else "-"
