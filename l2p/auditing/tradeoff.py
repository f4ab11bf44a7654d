"""The decision on a page: sentences, charts and a table of what releases give away and what they are still good for."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from itertools import groupby
from typing import TYPE_CHECKING

from l2p.auditing.attackers import WORDS, Attacker
from l2p.auditing.audit import Audit
from l2p.auditing.charts import Chart, percent_axis, styles, svg
from l2p.auditing.decision import Decision, Goal, Option, best_of, lift_command
from l2p.io.csv_rows import csv_bytes
from l2p.show.page.numbers import SPACE, count, fraction, length, percent
from l2p.utility import BY_TRACKS, POINTS
from l2p.utility.localization import Limit, Localization

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Least share on the axis of what comes back, and the marks of the axis.
_LEAST = 0.0005
_TICKS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
#: Most marks of a logarithmic axis.
_MOST_MARKS = 6
#: Opacity of the dominated.
_GREY = 0.35


@dataclass(frozen=True)
class ReleaseInputs:
    """What the decision of a report needs besides the audit.

    Attributes
    ----------
    goal : Goal or None
        What a release should reach; None: 90 % of the queries localized within a limit.
    scene, descriptors : str
        What ``l2p lift`` is given to make a release.
    drop : tuple of str
        Flags that leave points out of it.
    unlocalized : str
        Why nothing was localized; empty if it is of no interest.
    """

    goal: Goal | None = None
    scene: str = "MODEL"
    descriptors: str | None = None
    drop: tuple[str, ...] = ()
    unlocalized: str = ""


@dataclass(frozen=True)
class OptionRow:
    """Row of the table of releases."""

    name: str
    fraction: str
    recovered: str
    alone: str
    of_published: str
    localized: str
    position: str
    rotation: str
    dominated: bool
    best: bool
    command: str


@dataclass(frozen=True)
class Tradeoff:
    """The section of the page."""

    headline: str
    sentences: list[str]
    command: str
    charts: list[Chart]
    groups: list[tuple[str, list[OptionRow]]]
    limit: str
    unmatched: bool
    csv: str


def tradeoff(audit: Audit, decision: Decision, release: ReleaseInputs = ReleaseInputs()) -> Tradeoff:
    """Make the section of a decision."""
    found = audit.localization
    assert found is not None

    def command(option: Option) -> str:
        return lift_command(option, release.scene, release.descriptors, release.drop)

    rows = [_row(option, decision, found, command(option)) for option in decision.options]
    headline, *further = decision_sentences(audit, decision)
    best = decision.best
    return Tradeoff(
        headline,
        further,
        "" if best is None else command(best),
        [_error_chart(decision, found), _share_chart(decision)],
        [(name, list(group)) for name, group in groupby(rows, lambda row: row.name)],
        str(decision.goal.limit),
        any(not option.matchable for option in decision.options),
        base64.b64encode(_csv(decision, rows)).decode("ascii"),
    )


def option_table(audit: Audit, decision: Decision) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of the releases, for a terminal; a star marks the best, brackets the dominated."""
    found = audit.localization
    assert found is not None
    heads = [
        "release", "points", "of the map comes back", "by lines alone", "of what is published",
        f"within {decision.goal.limit}", "position", "rotation",
    ]  # fmt: skip
    rows = []
    for option in decision.options:
        row = _row(option, decision, found, "")
        name = f"* {row.name}" if row.best else f"({row.name})" if row.dominated else row.name
        rows.append(
            [name, row.fraction, row.recovered, row.alone, row.of_published, row.localized, row.position, row.rotation]
        )
    return heads, rows


def release_name(scheme: str, published: Attacker) -> str:
    """Name what is published.

    >>> release_name("points", ()), release_name("uniform", ("rgb", "descriptor"))
    ('points', 'lines + colours + descriptors')
    """
    what = "points" if scheme == POINTS else "lines" if scheme == "uniform" else f"{scheme} lines"
    return " + ".join((what, *(WORDS[name] for name in published)))


def decision_sentences(audit: Audit, decision: Decision) -> list[str]:
    """Say which release to choose, what it costs, and how that was measured."""
    found, goal, best = audit.localization, decision.goal, decision.best
    assert found is not None
    within = f"within {goal.limit}{'' if goal.limit.metric else ' of the extent of the cameras'}"
    queries = len(found.trials[0].attempts)
    if goal.recovered is None:
        wish = f"localize {percent(goal.localized)} of the cameras {within}"
        rank = "gives away least"
    else:
        wish = f"give away at most {percent(goal.recovered)} of the map"
        rank = f"localizes most cameras {within}"
    if best is None:
        return [f"No release that was tried would {wish}. {_nearest(decision)}", *_measured(found, queries)]
    name = release_name(best.scheme, best.published)
    chosen = [
        f"Of the releases that {wish}, this one {rank}: {name}, {fraction(best.fraction)} of the points.",
        f"An attacker gets back {percent(best.recovered)} of the points of the map within 1 spacing "
        f"({percent(best.of_published)} of those published), and {percent(best.localized)} of {queries} cameras are "
        f"localized {within}; half of them within {_position(best.position, found)} and "
        f"{best.rotation:.2g}{SPACE}deg.",
    ]
    return [*chosen, *_plain(decision, within), *_measured(found, queries), *_dropping(audit, goal.limit, within)]


def _dropping(audit: Audit, limit: Limit, within: str) -> list[str]:
    """What leaving points out costs: cameras localized in lines at the largest fraction, before and after."""
    found, before = audit.localization, audit.undropped
    if found is None or before is None or audit.left_out is None:
        return []
    fraction = audit.fractions[0]
    was, now = (each.of(audit.scheme, fraction) for each in (before, found))
    shares = [percent(trial.within(limit, found.extent)) for trial in (was, now)]
    errors = ["lost" if math.isinf(trial.position) else _position(found.position(trial), found) for trial in (was, now)]
    return [
        f"Leaving {count(audit.left_out.points)} points out changed the share of cameras localized {within} in the "
        f"lines of the others from {shares[0]} to {shares[1]}, and their median error from {errors[0]} to {errors[1]}."
    ]


def _plain(decision: Decision, within: str) -> list[str]:
    """If the release to choose has points as they are: what that means, and the best of those that hide them."""
    best = decision.best
    if best is None or best.scheme != POINTS:
        return []
    said = "These points are published as they are: few in number, but each of them in its true place."
    hidden = best_of([option for option in decision.options if option.scheme != POINTS], decision.goal)
    if hidden is None:
        return [f"{said} No release that hides them reaches as much."]
    return [
        f"{said} Of those that hide them: {release_name(hidden.scheme, hidden.published)}, {fraction(hidden.fraction)} "
        f"of the points; {percent(hidden.recovered)} of the map comes back, {percent(hidden.localized)} of the cameras "
        f"are localized {within}."
    ]


def _nearest(decision: Decision) -> str:
    """The release that comes nearest to the goal."""
    fit = [option for option in decision.options if option.matchable]
    if decision.goal.recovered is None:
        nearest = max(fit, key=lambda option: option.localized)
        reach = f"localizes {percent(nearest.localized)}"
    else:
        nearest = min(fit, key=lambda option: option.recovered)
        reach = f"gives away {percent(nearest.recovered)}"
    return (
        f"The nearest, {release_name(nearest.scheme, nearest.published)} with {fraction(nearest.fraction)} of the "
        f"points, {reach}."
    )


def _measured(found: Localization, queries: int) -> list[str]:
    wrong = found.trials[0].wrong
    how = "by their descriptors" if wrong is None else f"by the tracks of the map, {percent(wrong)} of them made wrong"
    best_case = ": a best case" if found.matching == BY_TRACKS else ""
    return [f"{queries} images of the map were each localized in the map of the others, with matches {how}{best_case}."]


def _row(option: Option, decision: Decision, found: Localization, command: str) -> OptionRow:
    lost = math.isinf(option.position)
    return OptionRow(
        release_name(option.scheme, option.published),
        fraction(option.fraction),
        percent(option.recovered),
        "-" if option.scheme == POINTS else percent(option.alone),
        percent(option.of_published),
        percent(option.localized),
        "lost" if lost else _position(option.position, found),
        "lost" if lost else f"{option.rotation:.2g}{SPACE}deg",
        decision.faint(option),
        option == decision.best,
        command,
    )


def _position(value: float, found: Localization) -> str:
    if found.metric:
        return length(value, metric=True)
    return f"{100 * value:.2g}{SPACE}%"


def _csv(decision: Decision, rows: list[OptionRow]) -> bytes:
    return csv_bytes(
        [
            {
                "release": row.name,
                "fraction": option.fraction,
                "recovered_of_map": option.recovered,
                "recovered_of_map_by_lines_alone": option.alone,
                "recovered_of_published": option.of_published,
                "localized": option.localized,
                "median_position": option.position,
                "median_rotation_deg": option.rotation,
                "dominated": int(row.dominated),
                "best": int(row.best),
                "command": row.command,
            }
            for option, row in zip(decision.options, rows, strict=True)
        ]
    )


def _error_chart(decision: Decision, found: Localization) -> Chart:
    unit = "m" if found.metric else "% of the cameras' extent"
    factor = 1 if found.metric else 100

    def draw(axes: Axes) -> None:
        _draw(axes, decision, "error", lambda option: factor * option.position, unit)
        axes.set_xscale("log")
        marks = _marks(*axes.get_xlim())
        axes.set_xticks(marks, [f"{mark:g}" for mark in marks])
        axes.minorticks_off()

    return _chart(
        decision,
        "What comes back, against the error of localization",
        "Each mark is a release. The further down, the less of the map comes back; the further to the left, the "
        "better cameras are localized. Filled: the attacker uses all that is published; hollow: the lines alone. "
        "Faint: another release is no worse on any side. The ring marks the release above.",
        svg("error", draw),
        "error",
    )


def _share_chart(decision: Decision) -> Chart:
    label = f"cameras within {decision.goal.limit}"

    def draw(axes: Axes) -> None:
        _draw(axes, decision, "share", lambda option: option.localized, label)
        axes.set_xlim(0, 1)
        percent_axis(axes.xaxis)
        axes.minorticks_off()

    return _chart(
        decision,
        "What comes back, against the cameras that are localized",
        f"The same releases by the share of the cameras within {decision.goal.limit}: the further to the right, the "
        "more.",
        svg("share", draw),
        "share",
    )


def _chart(decision: Decision, heading: str, caption: str, drawn: str, name: str) -> Chart:
    """Put the figures of each release into its mark, for the pointer."""
    for number, option in enumerate(decision.options):
        text = (
            f"{release_name(option.scheme, option.published)}, {fraction(option.fraction)} of the points: "
            f"{percent(option.recovered)} of the map comes back ({percent(option.of_published)} of what is published), "
            f"{percent(option.localized)} of the cameras localized"
        )
        mark = f'<g id="{name}-{number}">'
        drawn = drawn.replace(mark, f"{mark}<title>{escape(text)}</title>")
    best = decision.best
    chosen = "" if best is None else f" Best: {release_name(best.scheme, best.published)} at {fraction(best.fraction)}."
    return Chart(heading, caption, f"{heading}.{chosen} The table below has all figures.", drawn)


def _marks(low: float, high: float) -> list[float]:
    """Choose marks of a logarithmic axis: at 1, 2 and 5 of each power of ten, or at 1 only if these are many.

    >>> _marks(0.004, 0.3), _marks(0.0031, 0.0071)
    ([0.005, 0.01, 0.02, 0.05, 0.1, 0.2], [0.004, 0.005, 0.006, 0.007])
    """
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    marks: list[float] = []
    for digits in ((1,), (1, 2, 5), (1, 2, 3, 4, 5, 6, 7, 8, 9)):
        found = [float(f"{digit}e{power}") for power in powers for digit in digits if low <= digit * 10**power <= high]
        if len(found) > _MOST_MARKS:
            break
        marks = found
    return marks


def _draw(axes: Axes, decision: Decision, name: str, place: Callable[[Option], float], label: str) -> None:
    number = {id(option): row for row, option in enumerate(decision.options)}
    curves = decision.curves
    labels = [release_name(*key) for key in curves]
    for ((scheme, published), options), style in zip(curves.items(), styles(labels), strict=True):
        seen = [option for option in options if math.isfinite(place(option))]
        x = [place(option) for option in seen]
        back = [max(option.recovered, _LEAST) for option in seen]
        axes.plot(x, back, **style)
        look = {"marker": "o", "color": style["color"], "linestyle": "none", "clip_on": False}
        hollow = {**look, "markerfacecolor": "none"}
        for option, across, up in zip(seen, x, back, strict=True):
            shown = _GREY if decision.faint(option) else 1.0
            axes.plot([across], [up], gid=f"{name}-{number[id(option)]}", alpha=shown, markersize=6, **look)
            if option == decision.best:
                axes.plot([across], [up], markersize=14, markeredgewidth=2, **hollow)
        if published and scheme != POINTS:
            alone = [max(option.alone, _LEAST) for option in seen]
            axes.plot(x, alone, markersize=4.5, alpha=_GREY, **hollow)
    floor = 0.6 * max(min(min(option.recovered, option.alone) for option in decision.options), _LEAST)
    axes.set(yscale="log", ylim=(floor, 1.1), xlabel=label, ylabel="of the map's points, come back")
    ticks = [tick for tick in _TICKS if tick >= floor]
    axes.set_yticks(ticks, [f"{100 * tick:g} %" for tick in ticks])
