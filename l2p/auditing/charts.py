"""Curves of an audit as SVG with the colours of the page, readable in its light and dark modes."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from l2p.auditing.audit import Audit, Trial
from l2p.judging.curves import SHARES, SHOWN, THRESHOLDS
from l2p.show.page.numbers import fraction, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

#: Number of curve colours of the page (``--series-0`` and so on); further curves reuse them with other dashes.
SERIES = 4
_DASHES = ("-", "--", "-.", ":")
# Placeholders, replaced by colours of the page; nothing else in a chart has these colours.
_INK, _GRID, _PAPER = "#010101", "#020202", "#030303"
_VARIABLES = {
    _INK: "var(--ink)",
    _GRID: "var(--grid)",
    _PAPER: "var(--paper)",
    **{f"#04040{number}": f"var(--series-{number})" for number in range(SERIES)},
}
_WIDTH, _HEIGHT = 4.1, 3.5


@dataclass(frozen=True)
class Chart:
    """A chart with its heading, caption and alternative text; ``svg`` is safe to embed."""

    heading: str
    caption: str
    alternative: str
    svg: str


def charts(audit: Audit) -> list[Chart]:
    """Draw the charts for which this audit has curves."""
    curves = [trial.curves for trial in audit.trials]
    drawn = []
    if all(each.within for each in curves):
        drawn.append(_distribution(audit))
    if all(each.risk for each in curves):
        drawn.append(_risk(audit))
    if all(each.claimed for each in curves):
        drawn.append(_reliability(audit))
    return drawn


def _distribution(audit: Audit) -> Chart:
    def draw(axes: Axes) -> None:
        axes.axvline(1, color=_INK, linewidth=0.8, linestyle=(0, (1, 2)))
        for trial, style in _styled(audit):
            axes.plot(THRESHOLDS, trial.curves.within, **style)
        axes.set(xscale="log", xlim=SHOWN, ylim=(0, 1))
        ticks = (0.05, 0.25, 1, 5, 20)
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set(xlabel="error (spacings)", ylabel="points with at most this error")

    ends = "; ".join(
        f"{_of(trial.fraction)}: {percent(trial.scores.within_spacings['1'])}" for trial in audit.trials if trial.scores
    )
    return Chart(
        "How far off are the recovered points?",
        "Share of the points with an error of at most so many spacings, for each share of the map that is published. "
        "A curve further to the left and up means that more is given away. The dotted line marks 1 spacing.",
        f"Curves of the share of points against the error. Within 1 spacing: {ends}.",
        _svg("distribution", draw),
    )


def _risk(audit: Audit) -> Chart:
    def draw(axes: Axes) -> None:
        for trial, style in _styled(audit):
            axes.plot(SHARES, trial.curves.risk, **style)
        axes.set(xlim=(0, 1), ylim=(0, None), xlabel="points kept, most confident first", ylabel="of these, wrong")
        _percent_axis(axes.xaxis)

    half = int(np.searchsorted(SHARES, 0.5))
    ends = "; ".join(f"{_of(trial.fraction)}: {percent(trial.curves.risk[half])}" for trial in audit.trials)
    expected = "" if audit.known else " This is what the confidence predicts; nothing was measured."
    return Chart(
        "Does the attacker know which points are right?",
        "Risk-coverage: of the points that the attacker keeps, the most confident ones, how many are wrong, which is "
        "more than 1 spacing off. Where the curve falls to the left, the attacker can tell right from wrong."
        f"{expected}",
        f"Curves of the share of wrong points against the share kept. Wrong among the most confident half: {ends}.",
        _svg("risk", draw),
    )


def _reliability(audit: Audit) -> Chart:
    def draw(axes: Axes) -> None:
        axes.plot([0, 1], [0, 1], color=_INK, linewidth=0.8, linestyle=(0, (1, 2)))
        for trial, style in _styled(audit):
            axes.plot(trial.curves.claimed, trial.curves.right, marker="o", markersize=3.5, clip_on=False, **style)
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="confidence of the attack", ylabel="of these, right")
        _percent_axis(axes.xaxis)

    ends = "; ".join(
        f"{_of(trial.fraction)}: {trial.scores.calibration_error:.3f}" for trial in audit.trials if trial.scores
    )
    return Chart(
        "Is the confidence honest?",
        "Calibration: of the points that the attack gives a confidence of 80 %, 80 % should be within 1 spacing. On "
        "the dotted line the confidence is exactly right; below it, the attack is too sure of itself.",
        f"Curves of the share of right points against their confidence. Calibration error, {ends}.",
        _svg("reliability", draw),
    )


def _styled(audit: Audit) -> Iterator[tuple[Trial, dict[str, Any]]]:
    """Yield each trial with the style of its curve."""
    for number, trial in enumerate(audit.trials):
        yield (
            trial,
            {
                "color": f"#04040{number % SERIES}",
                "linestyle": _DASHES[(number + number // SERIES) % len(_DASHES)],
                "label": _of(trial.fraction) if audit.known else "expected",
                "linewidth": 1.8,
            },
        )


def _svg(name: str, draw: Callable[[Axes], None]) -> str:
    """Draw one chart, without the XML header, with text as text, and with colours as variables of the page."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    look: Any = {
        "svg.fonttype": "none",
        # Makes the names of clip paths and markers unique in the page, which holds all charts.
        "svg.hashsalt": name,
        "font.size": 10.5,
        "axes.edgecolor": _GRID,
        "axes.facecolor": _PAPER,
        "figure.facecolor": _PAPER,
        "grid.color": _GRID,
        "axes.grid": True,
        "axes.axisbelow": True,
        **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), _INK),
    }
    with matplotlib.rc_context(look):
        figure = Figure(figsize=(_WIDTH, _HEIGHT), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.subplots()
        draw(axes)
        _percent_axis(axes.yaxis)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=9, handlelength=2.6, frameon=False)
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return _themed(file.getvalue())


def _themed(svg: str) -> str:
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # The page scales the chart; the view box keeps its proportions.
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r"(font: [0-9.]+px) [^;\"]*", r"\1 var(--font)", svg)
    for color, variable in _VARIABLES.items():
        svg = svg.replace(color, variable)
    return svg


def _percent_axis(axis: Axis) -> None:
    """Set few ticks, each with all its digits."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axis.set_major_locator(MaxNLocator(nbins=7, steps=[1, 2, 5, 10]))
    axis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:.6g} %"))


def _of(share: float) -> str:
    return f"{fraction(share)} of the points"
