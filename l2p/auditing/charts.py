"""Curves of an audit as SVG with the colours of the page, readable in its light and dark modes."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from l2p.auditing.attackers import named, seen_by
from l2p.auditing.audit import Audit
from l2p.auditing.trial import Trial
from l2p.judging.curves import SHARES, SHOWN, THRESHOLDS
from l2p.show.page.numbers import fraction, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

#: Number of curve colours of the page (``--series-0`` and so on); further curves reuse them with other dashes.
SERIES = 5
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
#: Letters of a label of which two stand beside each other in a legend; rows that a legend has room for, and
#: the height of a further one.
_NARROW, _MOST_ROWS, _ROW = 22, 4, 0.19
#: Least ratio of two fractions that are both labelled.
_TICKS_APART = 1.6


@dataclass(frozen=True)
class Chart:
    """A chart with its heading, caption and alternative text; ``svg`` is safe to embed."""

    heading: str
    caption: str
    alternative: str
    svg: str


def charts(audit: Audit) -> list[Chart]:
    """Draw the charts for which this audit has curves: comparisons of attackers, then the strongest attacker alone."""
    curves = [trial.curves for trial in audit.trials]
    drawn = []
    if len(audit.attackers) > 1 and audit.known:
        drawn.append(_attackers(audit))
        if len(audit.fractions) > 1:
            drawn.append(_thinned(audit))
    if all(each.within for each in curves):
        drawn.append(_distribution(audit))
    if all(each.risk for each in curves):
        drawn.append(_risk(audit))
    if all(each.claimed for each in curves):
        drawn.append(_reliability(audit))
    return drawn


def _attackers(audit: Audit) -> Chart:
    trials = [trial for trial in audit.trials if trial.fraction == audit.fractions[0]]
    labels = [seen_by(trial.used) for trial in trials]
    return Chart(
        f"How much do {named(audit.attackers[0])} give away?",
        "Share of the points with an error of at most so many spacings, for each attacker, if "
        f"{_of(audit.fractions[0])} are published. The dotted line marks 1 spacing.",
        f"Curves of the share of points against the error. Within 1 spacing: {_within(trials, labels)}.",
        svg("attackers", lambda axes: _draw_errors(axes, trials, labels)),
    )


def _thinned(audit: Audit) -> Chart:
    labels = [seen_by(attacker) for attacker in audit.attackers]
    curves = [audit.of_attacker(attacker) for attacker in audit.attackers]

    def draw(axes: Axes) -> None:
        for trials, style in zip(curves, styles(labels), strict=True):
            within = [np.nan if trial.within is None else trial.within for trial in trials]
            axes.plot(audit.fractions, within, marker="o", markersize=3.5, clip_on=False, **style)
        axes.set(xscale="log", ylim=(0, 1), xlabel="points published", ylabel="of these, right")
        ticks = _apart(audit.fractions)
        axes.set_xticks(ticks, [fraction(tick) for tick in ticks])
        axes.minorticks_off()

    places = [_of(each) for each in audit.fractions]
    ends = "; ".join(f"{label}: {_within(trials, places)}" for label, trials in zip(labels, curves, strict=True))
    return Chart(
        "How much does a thinner map give away?",
        "Share of the published points that come back within 1 spacing of the whole map, for each attacker: compare "
        "what leaving out points saves with what leaving out attributes saves.",
        f"Curves of the share of right points against the share published. {ends}.",
        svg("thinned", draw),
    )


def _distribution(audit: Audit) -> Chart:
    trials, labels = _shown(audit)
    return Chart(
        "How far off are the recovered points?",
        "Share of the points with an error of at most so many spacings, for each share of the map that is published. "
        "A curve further to the left and up means that more is given away. The dotted line marks 1 spacing."
        f"{_who(audit)}",
        f"Curves of the share of points against the error. Within 1 spacing: {_within(trials, labels)}.",
        svg("distribution", lambda axes: _draw_errors(axes, trials, labels)),
    )


def _draw_errors(axes: Axes, trials: Sequence[Trial], labels: Sequence[str]) -> None:
    """Draw the distribution of errors of each trial."""
    axes.axvline(1, color=_INK, linewidth=0.8, linestyle=(0, (1, 2)))
    for trial, style in zip(trials, styles(labels), strict=True):
        axes.plot(THRESHOLDS, trial.curves.within, **style)
    axes.set(xscale="log", xlim=SHOWN, ylim=(0, 1))
    ticks = (0.05, 0.25, 1, 5, 20)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set(xlabel="error (spacings)", ylabel="points with at most this error")


def _risk(audit: Audit) -> Chart:
    trials, labels = _shown(audit)

    def draw(axes: Axes) -> None:
        for trial, style in zip(trials, styles(labels), strict=True):
            axes.plot(SHARES, trial.curves.risk, **style)
        axes.set(xlim=(0, 1), ylim=(0, None), xlabel="points kept, most confident first", ylabel="of these, wrong")
        percent_axis(axes.xaxis)

    half = int(np.searchsorted(SHARES, 0.5))
    ends = "; ".join(
        f"{label}: {percent(trial.curves.risk[half])}" for trial, label in zip(trials, labels, strict=True)
    )
    expected = "" if audit.known else " This is what the confidence predicts; nothing was measured."
    return Chart(
        "Does the attacker know which points are right?",
        "Risk-coverage: of the points that the attacker keeps, the most confident ones, how many are wrong, which is "
        "more than 1 spacing off. Where the curve falls to the left, the attacker can tell right from wrong."
        f"{expected}{_who(audit)}",
        f"Curves of the share of wrong points against the share kept. Wrong among the most confident half: {ends}.",
        svg("risk", draw),
    )


def _reliability(audit: Audit) -> Chart:
    trials, labels = _shown(audit)

    def draw(axes: Axes) -> None:
        axes.plot([0, 1], [0, 1], color=_INK, linewidth=0.8, linestyle=(0, (1, 2)))
        for trial, style in zip(trials, styles(labels), strict=True):
            axes.plot(trial.curves.claimed, trial.curves.right, marker="o", markersize=3.5, clip_on=False, **style)
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="confidence of the attack", ylabel="of these, right")
        percent_axis(axes.xaxis)

    ends = "; ".join(
        f"{label}: {trial.scores.calibration_error:.3f}"
        for trial, label in zip(trials, labels, strict=True)
        if trial.scores
    )
    return Chart(
        "Is the confidence honest?",
        "Calibration: of the points that the attack gives a confidence of 80 %, 80 % should be within 1 spacing. On "
        f"the dotted line the confidence is exactly right; below it, the attack is too sure of itself.{_who(audit)}",
        f"Curves of the share of right points against their confidence. Calibration error, {ends}.",
        svg("reliability", draw),
    )


def _shown(audit: Audit) -> tuple[tuple[Trial, ...], list[str]]:
    """Trials of the strongest attacker, by fraction; of a line cloud, those of all attackers. With their labels."""
    if audit.known:
        return audit.strongest, [_of(trial.fraction) for trial in audit.strongest]
    several = len(audit.attackers) > 1
    return audit.trials, [seen_by(trial.used) if several else "expected" for trial in audit.trials]


def _who(audit: Audit) -> str:
    """Name the only attacker of a chart, where there are others."""
    if not audit.known or len(audit.attackers) == 1:
        return ""
    return f" The attacker sees {seen_by(audit.attackers[0])}."


def _within(trials: Iterable[Trial], labels: Iterable[str]) -> str:
    """List the share within 1 spacing of each trial."""
    known = [(label, trial.within) for trial, label in zip(trials, labels, strict=True)]
    return "; ".join(f"{label}: {percent(within)}" for label, within in known if within is not None)


def styles(labels: Iterable[str]) -> Iterator[dict[str, Any]]:
    """Yield the style of each curve."""
    for number, label in enumerate(labels):
        yield {
            "color": f"#04040{number % SERIES}",
            "linestyle": _DASHES[(number + number // SERIES) % len(_DASHES)],
            "label": label,
            "linewidth": 1.8,
        }


def svg(name: str, draw: Callable[[Axes], None]) -> str:
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
        percent_axis(axes.yaxis)
        draw(axes)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        handles, labels = axes.get_legend_handles_labels()
        columns = 2 if max(map(len, labels), default=0) <= _NARROW else 1
        rows = -(-len(labels) // columns)
        figure.set_figheight(_HEIGHT + _ROW * max(0, rows - _MOST_ROWS))
        look = {"fontsize": 9, "handlelength": 2.6, "frameon": False}
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, **look)
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return _themed(file.getvalue())


def _themed(text: str) -> str:
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # The page scales the chart; the view box keeps its proportions.
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"(font: [0-9.]+px) [^;\"]*", r"\1 var(--font)", text)
    for color, variable in _VARIABLES.items():
        text = text.replace(color, variable)
    return text


def percent_axis(axis: Axis) -> None:
    """Set few ticks, each with all its digits."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axis.set_major_locator(MaxNLocator(nbins=7, steps=[1, 2, 5, 10]))
    axis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:.6g} %"))


def _apart(fractions: Sequence[float]) -> list[float]:
    """Choose fractions, given in descending order, whose labels do not overlap on a logarithmic axis."""
    chosen = [fractions[0]]
    for each in fractions[1:]:
        if each <= chosen[-1] / _TICKS_APART:
            chosen.append(each)
    return chosen


def _of(share: float) -> str:
    return f"{fraction(share)} of the points"
