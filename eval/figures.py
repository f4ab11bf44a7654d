"""The figures of a run: distribution of the error by fraction, and accuracy against density."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eval.scoring import THRESHOLDS, Row
from eval.tables import MEDIAN, SHARE, Column, distinct, pool_seed
from l2p.io.atomic import atomic_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Errors outside these say little: below lies the noise of the map, above any place in the scene.
SHOWN = (0.02, 30)
DPI = 130


def draw_figures(rows: Sequence[Row], knowing: Collection[str], folder: Path, prefix: str) -> list[Path]:
    """Write all figures into ``folder``; methods in ``knowing`` look at the truth and are dashed."""
    import matplotlib

    styles = _styles(distinct(rows, "method"), knowing)
    drawn = []
    # Agg needs no screen; the caller's backend is left as it is.
    with matplotlib.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "legend.frameon": False}):
        for name, draw in (("error-cdf", _cdf_figure), ("density", _density_figure)):
            path = folder / f"{prefix}{name}.png"
            with atomic_file(path, overwrite=True) as file:
                draw(rows, styles).savefig(file, format="png", dpi=DPI, metadata={"Software": None})
            drawn.append(path)
    return drawn


def _cdf_figure(rows: Sequence[Row], styles: dict[str, Any]) -> Figure:
    """Share of points within an error, mean over scenes and seeds: a panel a fraction, a curve a method."""
    fractions = sorted({row["fraction"] for row in rows}, reverse=True)
    columns = min(3, len(fractions))
    figure, panels = _panels(-(-len(fractions) // columns), columns)
    for axes, fraction in zip(panels, fractions, strict=False):
        for method, style in styles.items():
            curves = [row["within"] for row in rows if row["fraction"] == fraction and row["method"] == method]
            if curves:
                axes.plot(THRESHOLDS, np.mean(curves, axis=0), label=method, **style)
        axes.set(xscale="log", xlim=SHOWN, ylim=(0, 1), title=f"{100 * fraction:g} % of the points")
        axes.set(xlabel="error (spacings)", ylabel="share of points within")
    for axes in panels[len(fractions) :]:
        axes.set_axis_off()
    _legend(figure, panels[0], len(styles))
    return figure


def _density_figure(rows: Sequence[Row], styles: dict[str, Any]) -> Figure:
    """Median error and share within 1 spacing against the fraction lifted."""
    figure, panels = _panels(1, 2)
    for axes, column in zip(panels, (MEDIAN, SHARE), strict=True):
        for method, style in styles.items():
            percent, value = _against_fraction([row for row in rows if row["method"] == method], column)
            axes.plot(percent, value, label=method, marker="o", markersize=3, **style)
        axes.set(xscale="log", xlabel="points lifted (%)", ylabel=column.heading)
        percents = sorted({100 * row["fraction"] for row in rows})
        axes.set_xticks(percents, [f"{percent:g}" for percent in percents])
        axes.minorticks_off()
    panels[0].set(ylim=(0, None))
    panels[1].set(ylim=(0, 1))
    _legend(figure, panels[0], len(styles))
    return figure


def _against_fraction(rows: Sequence[Row], column: Column) -> tuple[list[float], list[float]]:
    """The pooled figure at each fraction, mean over seeds."""
    fractions = sorted({row["fraction"] for row in rows})
    values = []
    for fraction in fractions:
        here = [row for row in rows if row["fraction"] == fraction]
        pooled = [pool_seed(here, column, seed) for seed in distinct(here, "seed")]
        values.append(float(np.mean([value for value in pooled if value is not None])))
    return [100 * fraction for fraction in fractions], values


def _styles(methods: Sequence[str], knowing: Collection[str]) -> dict[str, Any]:
    return {
        method: {"color": f"C{i % 10}", "linestyle": "--" if method in knowing else "-"}
        for i, method in enumerate(methods)
    }


def _panels(rows: int, columns: int) -> tuple[Figure, list[Axes]]:
    """A figure of its own, outside pyplot's state, that draws with Agg."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.6 * columns, 2.8 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def _legend(figure: Figure, axes: Axes, count: int) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(4, count))
