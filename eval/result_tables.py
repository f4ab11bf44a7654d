"""Tables of a run: figures of each method by fraction, and of each scene; for the terminal and in Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table as RichTable

from eval.scoring import Row
from l2p.errors import InputError
from l2p.judging.measure import Form, arithmetic_mean, figures
from l2p.show.tables import console

#: Width of printed tables where stdout is no terminal.
WIDTH = 80
#: Headings of the columns that stay beside the first in every part of a table: with it they name the row.
_LEADS = ("points", "scenes", "kind", "lines", "scheme")

#: Line after a table in a file that is updated; the line before it is <!-- eval:RUN:TABLE -->.
PLACE_END = "<!-- /eval -->"


class Column(NamedTuple):
    """Figure in a table: heading, key in a row, function that pools scenes, function that prints."""

    heading: str
    name: str
    pool: Callable[[Sequence[Any]], float]
    form: Callable[[float], str]


class Table(NamedTuple):
    """Titled table of text, and its name."""

    name: str
    title: str
    head: list[str]
    body: list[list[str]]


def decimals(value: float) -> str:
    """Format a number with three decimals."""
    return f"{value:.3f}"


def percent(value: float) -> str:
    """Format a share as percent."""
    return f"{100 * value:.1f} %"


def _short(value: float) -> str:
    return f"{value:.2f}"


def _whole(value: float) -> str:
    return f"{100 * value:.0f} %"


def _seconds(value: float) -> str:
    return f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _columns() -> list[Column]:
    """List the figures that compare methods."""
    forms = {Form.COUNT: "{:.0f}".format, Form.LENGTH: "{:.4g}".format, Form.SHARE: percent}
    compared = [figure for figure in figures() if figure.compared]
    columns = [Column(f.compared, f.name, f.pool, forms.get(f.form, decimals)) for f in compared]
    return [*columns, Column("seconds", "seconds", arithmetic_mean, _seconds)]


MEDIAN, SHARE = (
    next(column for column in _columns() if column.name == name) for name in ("median_spacings", "within_1")
)

NOTE = (
    "Errors are in spacings: median distance to the 50th neighbour in the full true cloud. Over scenes, medians and "
    "ratios are pooled by the geometric, other figures by the arithmetic mean. A neighbour is right if it is among the "
    "k nearest points, k as many as the method used. Calibration error: of the confidence as the probability of lying "
    "within 1 spacing, in 15 bins, scenes weighted equally. Seconds: wall time per scene, beside other work."
)


def print_tables(found: Iterable[Table]) -> None:
    """Print tables to stdout; those that are too wide, in parts below each other."""
    shown = console()
    for table in found:
        for part in fitted(table, min(shown.width, WIDTH) if not shown.is_terminal else shown.width):
            rich = RichTable(title=part.title)
            for i, heading in enumerate(part.head):
                rich.add_column(heading, no_wrap=i == 0)
            for row in part.body:
                rich.add_row(*row)
            shown.print(rich)


def fitted(table: Table, width: int) -> list[Table]:
    """Divide a table into parts that fit, by columns: each has the first, and the columns of texts that follow it.

    A column is at least as wide as its cells and the longest word of its heading. A part has at least one more column.
    """
    sizes = [
        max(*(len(row[i]) for row in table.body), *map(len, table.head[i].split()), 0) + 3
        for i in range(len(table.head))
    ]
    lead = next((i for i in range(1, len(table.head)) if table.head[i] not in _LEADS), len(table.head))
    parts: list[list[int]] = []
    for i in range(lead, len(table.head)):
        if not parts or 1 + sum(sizes[j] for j in (*range(lead), *parts[-1], i)) > width:
            parts.append([])
        parts[-1].append(i)
    if len(parts) < 2:
        return [table]
    chosen = [[*range(lead), *part] for part in parts]
    return [
        Table(
            table.name,
            f"{table.title} ({number} of {len(chosen)})",
            [table.head[i] for i in columns],
            [[row[i] for i in columns] for row in table.body],
        )
        for number, columns in enumerate(chosen, 1)
    ]


class Image(NamedTuple):
    """Picture of the page: path and caption."""

    path: Path
    caption: str


def document(
    rows: Sequence[Row], found: Iterable[Table], about: dict[str, Any], images: Iterable[Image], folder: Path
) -> str:
    """Render the Markdown page in ``folder``: the command first, then tables and figures."""
    made = sorted({row["commit"] or "unknown" for row in rows})
    machine, versions = about["machine"], about["versions"]
    parts = [
        f"# Results: {about['config']['name']}",
        f"Made by this command, which continues a stopped run:\n\n```\n{about['command']}\n```",
        f"Predictions by commit {', '.join(made)}; {machine['processor']}, {machine['cores']} cores, "
        f"threads: {about['config']['threads'] or 'all'}; "
        + ", ".join(f"{name} {version}" for name, version in versions.items())
        + ".",
        " ".join(filter(None, (NOTE, _seeds_note(rows)))),
        *(f"## {table.title}\n\n{markdown(table)}" for table in found),
        "## Figures",
        *(f"![{path.stem}]({path.relative_to(folder).as_posix()})\n\n{caption}." for path, caption in images),
    ]
    return "\n\n".join(parts) + "\n"


def _seeds_note(rows: Sequence[Row]) -> str:
    seeds = distinct(rows, "seed")
    if len(seeds) < 2:
        return f"Line clouds of one seed ({seeds[0]})."
    return f"Figures are the mean ± the standard deviation over {len(seeds)} seeds of the line clouds ({_list(seeds)})."


def _list(values: Sequence[Any]) -> str:
    return ", ".join(map(str, values))


def markdown(table: Table) -> str:
    """Render the table in Markdown, with figures aligned right."""
    rule = ["---", *["---:"] * (len(table.head) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (table.head, rule, *table.body))


def updated(text: str, run: str, found: Iterable[Table]) -> str | None:
    """Insert the run's tables in their places in the text; return None if it has no place for this run.

    Raises
    ------
    InputError
        If a place has no end, or its name is not a table of the run.
    """
    named = {table.name: table for table in found}
    begin = re.compile(rf"^<!-- eval:{re.escape(run)}:(\S+) -->$\n", re.MULTILINE)
    parts, at = [], 0
    for place in begin.finditer(text):
        end = text.find(PLACE_END, place.end())
        following = begin.search(text, place.end())
        if end < 0 or (following and following.start() < end):
            raise InputError(f"got {place[0].strip()} without {PLACE_END} after it; expected both around the table")
        if place[1] not in named:
            raise InputError(f"got {place[0].strip()}; expected a table of {', '.join(named)}")
        parts += [text[at : place.end()], "\n", markdown(named[place[1]]), "\n\n"]
        at = end
    return "".join(parts) + text[at:] if parts else None


def tables(rows: Sequence[Row]) -> list[Table]:
    """Build the overview, one table of methods per fraction, then the scenes at the largest fraction."""
    fractions = sorted({row["fraction"] for row in rows}, reverse=True)
    largest = [row for row in rows if row["fraction"] == fractions[0]]
    return [
        overview(rows, fractions),
        *(method_table([row for row in rows if row["fraction"] == fraction], fraction) for fraction in fractions),
        scene_table(largest, fractions[0]),
    ]


def overview(rows: Sequence[Row], fractions: Sequence[float]) -> Table:
    """Tabulate median error and share within 1 spacing of each method at each fraction."""
    median, share = MEDIAN._replace(form=_short), SHARE._replace(form=_whole)
    body = []
    for method in distinct(rows, "method"):
        own = [row for row in rows if row["method"] == method]
        there = [[row for row in own if row["fraction"] == fraction] for fraction in fractions]
        name = _with_scenes(method, len(distinct(own, "scene")), len(distinct(rows, "scene")))
        body.append([name, *(f"{pooled(here, median)} / {pooled(here, share)}" if here else "-" for here in there)])
    head = ["fraction of the points", *(f"{100 * fraction:g} %" for fraction in fractions)]
    return Table("overview", f"median error in spacings / share within 1 spacing{spread_of(rows)}", head, body)


def spread_of(rows: Iterable[Row]) -> str:
    """Describe the spread in a table; empty for one seed, which has none."""
    seeds = len(distinct(rows, "seed"))
    return f", mean ± standard deviation of {seeds} seeds" if seeds > 1 else ""


def method_table(rows: Sequence[Row], fraction: float) -> Table:
    """Tabulate the figures of each method over all scenes, and the number of scenes if some are missing."""
    scenes, columns = len({row["scene"] for row in rows}), _columns()
    body = []
    for method in distinct(rows, "method"):
        own = [row for row in rows if row["method"] == method]
        there = len({row["scene"] for row in own})
        body.append([_with_scenes(method, there, scenes), *(pooled(own, column) for column in columns)])
    title = f"{100 * fraction:g} % of the points, {scenes} scene{'s' if scenes > 1 else ''}"
    return Table(f"{100 * fraction:g}%", title, ["method", *(column.heading for column in columns)], body)


def _with_scenes(method: str, there: int, scenes: int) -> str:
    """Name of a method, with the number of its scenes if some are missing, over which its figures are not pooled."""
    return method if there == scenes else f"{method} ({there} of {scenes} scenes)"


def scene_table(rows: Sequence[Row], fraction: float) -> Table:
    """Tabulate median error and share within 1 spacing of each method on each scene."""
    methods = distinct(rows, "method")
    body = []
    for scene in distinct(rows, "scene"):
        own = [row for row in rows if row["scene"] == scene]
        there = [[row for row in own if row["method"] == method] for method in methods]
        figures = [f"{pooled(here, MEDIAN)} / {pooled(here, SHARE)}" if here else "-" for here in there]
        body.append([scene, own[0]["kind"], str(own[0]["lines"]), *figures])
    title = f"each scene at {100 * fraction:g} %: median / share within 1 spacing"
    return Table("scenes", title, ["scene", "kind", "lines", *methods], body)


def pooled_table(name: str, title: str, rows: Sequence[Row], columns: Sequence[Column]) -> Table:
    """Tabulate figures of each method at each fraction, pooled over the scenes."""
    body = []
    for fraction in fractions_of(rows):
        here = [row for row in rows if row["fraction"] == fraction]
        for method in distinct(here, "method"):
            own = [row for row in here if row["method"] == method]
            scenes = str(len(distinct(own, "scene")))
            body.append([method, f"{100 * fraction:g} %", scenes, *(pooled(own, column) for column in columns)])
    return Table(name, title, ["method", "points", "scenes", *(column.heading for column in columns)], body)


def fractions_of(rows: Iterable[Row]) -> list[float]:
    """List the fractions, the largest first."""
    return sorted(distinct(rows, "fraction"), reverse=True)


def pooled(rows: Sequence[Row], column: Column) -> str:
    """Pool a figure over the scenes of each seed; mean ± standard deviation of several seeds."""
    per_seed = [pool_seed(rows, column, seed) for seed in distinct(rows, "seed")]
    values = np.array([value for value in per_seed if value is not None])
    if not len(values):
        return "-"
    spread = f" ± {column.form(float(values.std(ddof=1)))}" if len(values) > 1 else ""
    return column.form(float(values.mean())) + spread


def pool_seed(rows: Sequence[Row], column: Column, seed: int) -> float | None:
    """Pool a figure over the scenes of one seed; None if no scene has it."""
    values = [row[column.name] for row in rows if row["seed"] == seed and row[column.name] is not None]
    return column.pool(values) if values else None


def distinct(rows: Iterable[Row], name: str) -> list[Any]:
    """List the values of a column, each once, in order of appearance."""
    return list(dict.fromkeys(row[name] for row in rows))
