"""The tables of a run: figures of each method by fraction, and of each scene; for the terminal and in Markdown."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table as RichTable

from eval.scoring import Row

#: Columns of a table when stdout is no terminal, whose width would be taken for 80.
FILE_WIDTH = 140
#: Errors of 0 (points that coincide) must not make a geometric mean 0.
LEAST = 1e-6


class Column(NamedTuple):
    """A figure of a table: its heading, the row's entry, how scenes are pooled, how it is printed."""

    heading: str
    name: str
    pool: Callable[[np.ndarray], float]
    form: Callable[[float], str]


class Table(NamedTuple):
    """A titled table of text."""

    title: str
    head: list[str]
    body: list[list[str]]


def geometric_mean(values: np.ndarray) -> float:
    """Of positive numbers."""
    return float(np.exp(np.log(np.maximum(values, LEAST)).mean()))


def arithmetic_mean(values: np.ndarray) -> float:
    """Of any numbers."""
    return float(values.mean())


def _decimals(value: float) -> str:
    return f"{value:.3f}"


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _seconds(value: float) -> str:
    return f"{value:.1f}" if value < 100 else f"{value:.0f}"


MEDIAN = Column("median (spacings)", "median_spacings", geometric_mean, _decimals)
SHARE = Column("within 1 spacing", "within_1", arithmetic_mean, _percent)
COLUMNS = (
    MEDIAN,
    SHARE,
    Column("neighbour precision", "neighbor_precision", arithmetic_mean, _percent),
    Column("lines under 50 % outliers", "under_half_outliers", arithmetic_mean, _percent),
    Column("seconds", "seconds", arithmetic_mean, _seconds),
)

NOTE = (
    "Errors are in spacings, the median distance to the 50th neighbour in the full true cloud. Medians are geometric, "
    "all other figures arithmetic means over the scenes. A neighbour is right if it is among the k nearest points, "
    "k as many as the method used. Seconds are wall time a scene on a machine that may have had other work."
)


def print_tables(rows: Sequence[Row]) -> None:
    """All tables, on stdout."""
    console = Console(file=sys.stdout, width=None if sys.stdout.isatty() else FILE_WIDTH)
    for table in tables(rows):
        shown = RichTable(*table.head, title=table.title)
        for row in table.body:
            shown.add_row(*row)
        console.print(shown)


def document(rows: Sequence[Row], about: dict[str, Any], figures: Iterable[str]) -> str:
    """The Markdown page: the command first, then tables and figures."""
    made = sorted({row["commit"] or "unknown" for row in rows})
    machine, versions = about["machine"], about["versions"]
    parts = [
        f"# Results: {about['config']['name']}",
        f"Made by this command, which continues where it was stopped:\n\n```\n{about['command']}\n```",
        f"Predictions by commit {', '.join(made)}; {machine['processor']}, {machine['cores']} cores, "
        f"threads: {about['config']['threads'] or 'all'}; "
        + ", ".join(f"{name} {version}" for name, version in versions.items())
        + ".",
        NOTE,
        *(f"## {table.title}\n\n{markdown(table)}" for table in tables(rows)),
        *(f"![{figure.rsplit('/', 1)[-1]}]({figure})" for figure in figures),
    ]
    return "\n\n".join(parts) + "\n"


def markdown(table: Table) -> str:
    """The table in Markdown, figures to the right."""
    rule = ["---", *["---:"] * (len(table.head) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (table.head, rule, *table.body))


def tables(rows: Sequence[Row]) -> list[Table]:
    """One table of methods for each fraction, then the scenes at the largest of them."""
    fractions = sorted({row["fraction"] for row in rows}, reverse=True)
    found = [method_table([row for row in rows if row["fraction"] == fraction], fraction) for fraction in fractions]
    largest = [row for row in rows if row["fraction"] == fractions[0]]
    for column in (MEDIAN, SHARE):
        found.append(scene_table(largest, column, fractions[0]))
    return found


def method_table(rows: Sequence[Row], fraction: float) -> Table:
    """Figures of each method over all scenes; how many scenes that are, where some are missing."""
    scenes = len({row["scene"] for row in rows})
    body = []
    for method in distinct(rows, "method"):
        own = [row for row in rows if row["method"] == method]
        there = len({row["scene"] for row in own})
        missing = "" if there == scenes else f" ({there} of {scenes} scenes)"
        body.append([method + missing, *(pooled(own, column) for column in COLUMNS)])
    title = f"{100 * fraction:g} % of the points, {scenes} scene{'s' if scenes > 1 else ''}"
    return Table(title, ["method", *(column.heading for column in COLUMNS)], body)


def scene_table(rows: Sequence[Row], column: Column, fraction: float) -> Table:
    """One figure of each method on each scene."""
    methods = distinct(rows, "method")
    body = []
    for scene in distinct(rows, "scene"):
        own = [row for row in rows if row["scene"] == scene]
        figures = [pooled([row for row in own if row["method"] == method], column) for method in methods]
        body.append([scene, own[0]["kind"], str(own[0]["lines"]), *figures])
    return Table(f"{column.heading}, each scene at {100 * fraction:g} %", ["scene", "kind", "lines", *methods], body)


def pooled(rows: Sequence[Row], column: Column) -> str:
    """A figure pooled over scenes for each seed; of several seeds their mean ± standard deviation."""
    per_seed = [pool_seed(rows, column, seed) for seed in distinct(rows, "seed")]
    values = np.array([value for value in per_seed if value is not None])
    if not len(values):
        return "-"
    spread = f" ± {column.form(float(values.std(ddof=1)))}" if len(values) > 1 else ""
    return column.form(float(values.mean())) + spread


def pool_seed(rows: Sequence[Row], column: Column, seed: int) -> float | None:
    """The figure of one seed over its scenes; None where no scene has it."""
    values = [row[column.name] for row in rows if row["seed"] == seed and row[column.name] is not None]
    return column.pool(np.array(values)) if values else None


def distinct(rows: Iterable[Row], name: str) -> list[Any]:
    """The values of a column, each once, in the order they come."""
    return list(dict.fromkeys(row[name] for row in rows))
