"""Figures of a run: distributions of the error, accuracy against density, quality of confidence and affinity.

Curves are means over scenes, each with equal weight, and over seeds.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from eval.mean_curves import pooled_reliability
from eval.result_tables import MEDIAN, SHARE, Column, distinct, pool_seed
from eval.scoring import Row
from l2p.judging.curves import SHARES, SHOWN, THRESHOLDS
from l2p.programs.scenes import PAPER_KIND

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Drawing(NamedTuple):
    """Image file: name, caption, bytes."""

    name: str
    caption: str
    content: bytes


TICKS = (0.1, 1, 10)
#: Height of a legend's row, width of an entry without label, width of a letter, all in inches; most entries per row.
LEGEND_ROW, LEGEND_KEY, LEGEND_LETTER, LEGEND_MOST = 0.18, 0.6, 0.075, 4
#: Colour and dashes of each method, the same in every panel.
Styles = dict[str, dict[str, Any]]
#: Settings of matplotlib: the same rows give the same file; text as outlines, to look the same everywhere.
RC: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "svg.hashsalt": "l2p",
    "svg.fonttype": "path",
}


def draw_figures(rows: Sequence[Row], knowing: Collection[str]) -> list[Drawing]:
    """Draw the figures for which the rows have curves; methods in ``knowing``, which use the truth, are dashed."""
    import matplotlib

    styles = _styles(distinct(rows, "method"), knowing)
    drawn = []
    # Agg needs no screen; the caller's backend does not change.
    with matplotlib.rc_context(RC):
        for name, caption, draw in FIGURES:
            figure = draw(rows, styles)
            if figure is None:
                continue
            file = io.BytesIO()
            figure.savefig(file, format="svg", metadata={"Date": None})
            drawn.append(Drawing(f"{name}.svg", caption, file.getvalue()))
    return drawn


def _by_fraction(rows: Sequence[Row], styles: Styles) -> Figure:
    parts = [
        (f"{100 * fraction:g} % of the points", [row for row in rows if row["fraction"] == fraction])
        for fraction in _fractions(rows)
    ]
    return _distributions(parts, styles, "method")


def _by_kind(rows: Sequence[Row], styles: Styles) -> Figure | None:
    """Draw the distributions of the error at the largest fraction, one panel per kind of scene."""
    top = _fractions(rows)[0]
    rows = [row for row in rows if row["fraction"] == top]
    kinds = [kind for kind in PAPER_KIND if any(row["kind"] == kind for row in rows)]
    if len(kinds) < 2:
        return None
    parts = [(f"{kind}, {100 * top:g} %", [row for row in rows if row["kind"] == kind]) for kind in kinds]
    return _distributions(parts, styles, "method")


def _by_sparsity(rows: Sequence[Row], styles: Styles) -> Figure | None:
    from matplotlib import colormaps

    fractions = _fractions(rows)
    if len(fractions) < 2:
        return None
    shades = colormaps["viridis"](np.linspace(0, 0.85, len(fractions)))
    densities = {fraction: {"color": shade} for fraction, shade in zip(fractions, shades, strict=True)}
    parts = [(method, [row for row in rows if row["method"] == method]) for method in styles]
    return _distributions(parts, densities, "fraction")


def _distributions(parts: Sequence[tuple[str, Sequence[Row]]], styles: dict[Any, Any], column: str) -> Figure:
    """Draw the share of points within an error: one panel per part, one curve per value of the column."""
    figure, panels = _panels(len(parts))
    for axes, (title, own) in zip(panels, parts, strict=True):
        for value, style in styles.items():
            curves = [row["curves"]["within"] for row in own if row[column] == value]
            if curves:
                label = f"{100 * value:g} % of the points" if column == "fraction" else value
                axes.plot(THRESHOLDS, np.mean(curves, axis=0), label=label, **style)
        axes.set(xscale="log", xlim=SHOWN, ylim=(0, 1), title=title)
        axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
        axes.set(xlabel="error (spacings)", ylabel="share of points within")
    _legend(figure, panels)
    return figure


def _density(rows: Sequence[Row], styles: Styles) -> Figure:
    figure, panels = _panels(2)
    for axes, column in zip(panels, (MEDIAN, SHARE), strict=True):
        for method, style in styles.items():
            percent, value, spread = _against_fraction([row for row in rows if row["method"] == method], column)
            axes.errorbar(percent, value, spread, label=method, marker="o", markersize=3, capsize=2, **style)
        axes.set(xscale="log", xlabel="fraction of the points (%)", ylabel=column.heading)
        percents = sorted({100 * row["fraction"] for row in rows})
        axes.set_xticks(percents, [f"{percent:g}" for percent in percents])
        axes.minorticks_off()
    panels[0].set(ylim=(0, None))
    panels[1].set(ylim=(0, 1))
    _legend(figure, panels)
    return figure


def _risk_coverage(rows: Sequence[Row], styles: Styles) -> Figure | None:
    def draw(axes: Axes, own: Sequence[Row], style: dict[str, Any]) -> None:
        axes.plot(SHARES, np.mean([row["curves"]["risk"] for row in own], axis=0), **style)

    figure = _each_fraction(rows, styles, "risk", draw)
    if figure is not None:
        for axes in figure.axes:
            axes.set(xlim=(0, 1), ylim=(0, None))
            axes.set(xlabel="share of points kept, most confident first", ylabel="share of these beyond 1 spacing")
    return figure


def _calibration(rows: Sequence[Row], styles: Styles) -> Figure | None:
    def draw(axes: Axes, own: Sequence[Row], style: dict[str, Any]) -> None:
        diagram = pooled_reliability([row["curves"]["reliability"] for row in own])
        axes.plot(diagram.confidence, diagram.inside, marker="o", markersize=3, **style)

    figure = _each_fraction(rows, styles, "reliability", draw)
    if figure is not None:
        for axes in figure.axes:
            axes.plot([0, 1], [0, 1], color="0.6", linewidth=0.8, zorder=0)
            axes.set(xlim=(0, 1), ylim=(0, 1))
            axes.set(xlabel="confidence", ylabel="share of points within 1 spacing")
    return figure


def _neighbors(rows: Sequence[Row], styles: Styles) -> Figure | None:
    def draw(axes: Axes, own: Sequence[Row], style: dict[str, Any]) -> None:
        precision = np.mean([row["curves"]["neighbors"] for row in own], axis=0)
        # Recall is share x precision, since the numbers of used and true neighbours are equal.
        axes.plot(SHARES * precision, precision, marker="o", markevery=[-1], markersize=4, clip_on=False, **style)

    figure = _each_fraction(rows, styles, "neighbors", draw)
    if figure is not None:
        for axes in figure.axes:
            axes.set(xlim=(0, 1), ylim=(0, 1.02))
            axes.set(xlabel="recall of the true neighbours", ylabel="precision")
    return figure


class _Drawn(NamedTuple):
    """Figure: name of its file, caption, and function that draws it, or returns None for rows without such curves."""

    name: str
    caption: str
    draw: Callable[[Sequence[Row], Styles], Any]


FIGURES = (
    _Drawn("error_cdf", "Share of points within an error at each density; dashed methods know the truth", _by_fraction),
    _Drawn("error_kinds", "Share of points within an error, for each kind of scene", _by_kind),
    _Drawn("error_sparsity", "Share of points within an error, for each method from dense to sparse", _by_sparsity),
    _Drawn(
        "density",
        "Median error and share within 1 spacing against the share of the points; bars: deviation over several seeds",
        _density,
    ),
    _Drawn("risk_coverage", "How wrong the points are that a method is most confident of", _risk_coverage),
    _Drawn("calibration", "What a calibrated confidence says, and what holds: the diagonal is right", _calibration),
    _Drawn(
        "neighbors",
        "Precision and recall of neighbours, those of the greatest affinity first; the dot is all that are used",
        _neighbors,
    ),
)


def _each_fraction(
    rows: Sequence[Row], styles: Styles, curve: str, draw: Callable[[Axes, Sequence[Row], dict[str, Any]], None]
) -> Figure | None:
    """Draw one panel per fraction, with a curve of each method that has one."""
    rows = [row for row in rows if row["curves"][curve] is not None]
    if not rows:
        return None
    figure, panels = _panels(len(_fractions(rows)))
    for axes, fraction in zip(panels, _fractions(rows), strict=True):
        for method, style in styles.items():
            own = [row for row in rows if row["fraction"] == fraction and row["method"] == method]
            if own:
                draw(axes, own, {"label": method, **style})
        axes.set(title=f"{100 * fraction:g} % of the points")
    _legend(figure, panels)
    return figure


def _against_fraction(rows: Sequence[Row], column: Column) -> tuple[list[float], list[float], list[float] | None]:
    """Return percents, the pooled figure at each (mean over seeds), and its standard deviation (None for one seed)."""
    fractions = sorted({row["fraction"] for row in rows})
    values, spreads = [], []
    for fraction in fractions:
        here = [row for row in rows if row["fraction"] == fraction]
        pooled = [pool_seed(here, column, seed) for seed in distinct(here, "seed")]
        found = [value for value in pooled if value is not None]
        values.append(float(np.mean(found)))
        spreads.append(float(np.std(found, ddof=1)) if len(found) > 1 else 0.0)
    return [100 * fraction for fraction in fractions], values, spreads if any(spreads) else None


def _fractions(rows: Sequence[Row]) -> list[float]:
    return sorted({row["fraction"] for row in rows}, reverse=True)


def _styles(methods: Sequence[str], knowing: Collection[str]) -> Styles:
    return {
        method: {"color": f"C{i % 10}", "linestyle": "--" if method in knowing else "-"}
        for i, method in enumerate(methods)
    }


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    return empty_panels(count, count if count < 4 else 2 if count == 4 else 3, (3.6, 2.6))


def empty_panels(count: int, columns: int, size: tuple[float, float], below: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Create a figure outside pyplot's state that draws with Agg; ``size`` of a panel and ``below`` in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = -(-count // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows + below), layout="constrained")
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in panels[count:]:
        axes.remove()
    return figure, panels[:count]


def _legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """Add one legend for all panels, in a strip below them that is no wider than the figure."""
    found = {label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    width, height = figure.get_size_inches()
    fitting = int(width / (LEGEND_KEY + LEGEND_LETTER * max(map(len, found))))
    rows = -(-len(found) // max(1, min(fitting, LEGEND_MOST)))
    figure.set_size_inches(width, height + LEGEND_ROW * rows)
    figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=-(-len(found) // rows))
