"""The report of an audit: a folder with an HTML page and a JSON file of all figures."""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable, Sequence
from itertools import groupby
from os import PathLike
from typing import Any

from l2p.auditing import FIGURES, FILES, PAGE
from l2p.auditing.advice import advice_of
from l2p.auditing.attackers import named, others, seen_by
from l2p.auditing.audit import Audit
from l2p.auditing.charts import charts
from l2p.auditing.decision import decide
from l2p.auditing.exposed_parts import part_rows, parts_dict, parts_of
from l2p.auditing.left_out import LeftOut
from l2p.auditing.page_table import Group, Head, Row, Table
from l2p.auditing.picture_section import picture_tables
from l2p.auditing.published_again import EXACT, PublishedAgain
from l2p.auditing.region_asked import AskedRegion
from l2p.auditing.scheme_comparison import comparison_chart, comparison_table
from l2p.auditing.sharing import holding, shared_figures, shared_release
from l2p.auditing.tradeoff import ReleaseInputs, tradeoff
from l2p.auditing.trial import Trial
from l2p.auditing.verdict import verdict_of
from l2p.auditing.words import sentences, times
from l2p.io.atomic import atomic_folder
from l2p.judging.accuracy import errors
from l2p.judging.measure import Figure, Form, Need, figures
from l2p.show.exhibit import Exhibit
from l2p.show.page import MOST_POINTS
from l2p.show.page.numbers import count, fraction, length, percent
from l2p.show.page.render import render

#: Printing function of each kind of figure, for the page.
_FORMS: dict[Form, Callable[[Any], str]] = {
    Form.COUNT: count,
    Form.LENGTH: "{:.4g}".format,
    Form.SPACINGS: "{:.2f}".format,
    Form.SHARE: percent,
    Form.NUMBER: "{:.3f}".format,
}


def save_report(
    audit: Audit,
    folder: str | PathLike[str],
    *,
    overwrite: bool = False,
    command: str | None = None,
    most_points: int = MOST_POINTS,
    release: ReleaseInputs = ReleaseInputs(),
    share: bool = False,
) -> None:
    """Write the report of an audit: an HTML page, and all figures as JSON.

    The page holds points of the map, true and recovered ones, for its picture: treat it like the map, or ``share`` it.

    Parameters
    ----------
    folder : path
        Folder of ``index.html`` and ``audit.json``, written whole or not at all.
    overwrite : bool
        Replace the folder of an earlier report.
    command : str, optional
        Command line that repeats this audit, for the page.
    most_points : int
        Most points of each cloud in the view; the figures count all points.
    release : ReleaseInputs
        For an audit with queries: what a release should reach, and what it is made from.
    share : bool
        Leave out whatever tells more than figures: every point, so the picture, too; coordinates, paths of ``release``,
        the machine. ``command`` and the name of the audit are told as they are given.

    Raises
    ------
    InputError
        If the folder exists and may not be replaced, or cannot be written.
    """
    with atomic_folder(folder, overwrite=overwrite, replaceable=frozenset(FILES)) as place:
        content = figures_of(audit, command, release, share)
        (place / FIGURES).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        (place / PAGE).write_bytes(report_page(audit, command, most_points, release, share))


def figures_of(
    audit: Audit, command: str | None = None, release: ReleaseInputs = ReleaseInputs(), share: bool = False
) -> dict[str, Any]:
    """Return the content of ``audit.json``."""
    decision = decide(audit, release.goal)
    figures = {
        **audit.as_dict(),
        "verdict": verdict_of(audit).level,
        "parts": parts_dict(parts_of(audit)),
        "decision": None if decision is None else decision.as_dict(),
        "command": command,
    }
    return shared_figures(figures) if share else figures


def report_page(
    audit: Audit,
    command: str | None = None,
    most_points: int = MOST_POINTS,
    release: ReleaseInputs = ReleaseInputs(),
    share: bool = False,
) -> bytes:
    """Render the page of an audit, UTF-8."""
    exhibits = [] if share else [(fraction(trial.fraction), _exhibit(trial, audit)) for trial in audit.trials]
    release = shared_release(release) if share else release
    used, verdict, decision = audit.attackers[0], verdict_of(audit), decide(audit, release.goal)
    return render(
        "audit.html",
        f"Privacy audit of {audit.name}",
        exhibits,
        most_points,
        attackers=[seen_by(attacker) for attacker in audit.attackers],
        audit=audit,
        shared=share,
        holding=holding(audit, share),
        verdict=verdict,
        sentences=sentences(audit),
        parts=[] if share else part_rows(parts_of(audit)),
        advice=advice_of(audit, verdict, decided=decision is not None, shared=share),
        used=used,
        used_words=named(used),
        unseen=[named([name]) for name in others(used)],
        tables=_tables(audit),
        tradeoff=None if decision is None else tradeoff(audit, decision, release),
        unlocalized=release.unlocalized,
        charts=[
            *([] if audit.others is None else [comparison_chart(audit, audit.others)]),
            *([] if audit.few else charts(audit)),
        ],
        spacing=length(audit.spacing, audit.metric),
        picture_tables=[] if share else picture_tables(audit),
        seconds=_duration(audit.trials[0].seconds),
        own_colors=not share and audit.trials[0].rgb is not None and "rgb" not in used,
        command=command,
        facts=_facts(audit, share),
    )


def _exhibit(trial: Trial, audit: Audit) -> Exhibit:
    """Gather the layers of one attack; of a map of few points, no errors in spacings."""
    recovery, truth = trial.recovery, trial.truth
    return Exhibit(
        points=None if truth is None else truth.xyz,
        lines=trial.lines,
        recovered=recovery.xyz,
        rgb=trial.rgb,
        confidence=recovery.confidence,
        calibrated=audit.calibrated and not audit.few,
        error=None if truth is None or audit.few else errors(recovery, truth) / audit.spacing,
        camera_centers=audit.camera_centers,
        up=audit.up,
        spacing=audit.spacing,
    )


def _tables(audit: Audit) -> list[Table]:
    if not audit.known:
        return [_predicted_table(audit)]
    left_out = [] if audit.left_out is None else [_left_out_table(audit, audit.left_out)]
    region = [] if audit.region is None else [_region_table(audit, audit.region)]
    again = [] if audit.again is None else [_again_table(audit.again)]
    metric = [_metric_table(audit)] if audit.metric else []
    others = [] if audit.others is None else [comparison_table(audit, audit.others)]
    return [_measured_table(audit), *metric, *others, *again, *left_out, *region]


def _measured_table(audit: Audit) -> Table:
    shown = [figure for figure in _shown(audit) if figure.need is not Need.METRIC]
    note = " ".join(filter(None, (figure.note for figure in shown)))
    if not audit.calibrated:
        lines = "" if audit.recognised["expected"] else " on these lines"
        note += f" The confidence of the method {audit.method} ranks points and is no probability{lines}."
    heads = [*_heads(shown), Head("Seconds")]
    rows = [[*_values(trial, shown), f"{trial.seconds:.1f}"] for trial in audit.trials]
    by = "By fraction of the points" if len(audit.attackers) == 1 else "By fraction of the points, and by attacker"
    return _by_trial(audit, by, heads, rows, note)


def _metric_table(audit: Audit) -> Table:
    shown = [figure for figure in _shown(audit) if figure.need is Need.METRIC]
    rows = []
    for trial in audit.trials:
        assert trial.scores is not None
        rows.append([length(trial.scores.median, True), *_values(trial, shown)])
    heads = [Head("Median error"), *_heads(shown)]
    return _by_trial(
        audit, "In centimetres", heads, rows, "These lengths are right if the units of the map are metres."
    )


def _region_table(audit: Audit, region: AskedRegion) -> Table:
    """What comes back of the region that was asked about."""
    heads = [Head("Published in it"), Head("Of these, within 1 spacing"), Head("Median error (spacings)")]
    rows = [
        [
            count(trial.published),
            "-" if trial.within is None else percent(trial.within),
            "-" if trial.median is None else f"{trial.median:.2f}",
        ]
        for trial in region.trials
    ]
    note = f"{count(region.points)} points of the map are in the region, by their true places, ids or masks."
    return _by_trial(audit, "The region", heads, rows, note)


def _again_table(again: PublishedAgain) -> Table:
    """What several releases give away together."""
    heads = [
        Head("Points in each release"),
        Head("Lines"),
        Head("Meet another of their point"),
        Head("Recovered within", (f"{EXACT:g} spacings", "1 spacing")),
        Head("Median error (spacings)"),
        Head("Seconds"),
    ]
    rows = [
        [
            fraction(trial.fraction),
            count(trial.lines),
            percent(trial.met / trial.lines),
            percent(trial.exact),
            percent(trial.within),
            "< 0.001" if trial.median < 0.001 else f"{trial.median:.3f}",
            f"{trial.seconds:.1f}",
        ]
        for trial in again.trials
    ]
    note = (
        f"The map is lifted {times(again.releases)}, with other directions and, below 100 %, other points each time. "
        "The attacker sees the lines alone, of all releases, and does not know which belong together. The figures are "
        "of the points of the first release: those that another release has too are given away."
    )
    return Table(f"Published {times(again.releases)}", heads, [Group("", rows)], note)


def _left_out_table(audit: Audit, left_out: LeftOut) -> Table:
    heads = [Head("Left out"), Head("Of these, within 1 spacing of", ("a recovered point", "a published point"))]
    rows = [[count(left_out.points), percent(near.recovered), percent(near.published)] for near in left_out.near]
    note = (
        "What is left out leaves no line, colour or descriptor. What comes back near it belongs to neighbours that are "
        "published: at the border, points are near what is left out by nature, which the last column counts with their "
        "true places; recovered points may also lie there by mistake. The spacing is that of the map with all points."
    )
    return _by_trial(audit, "What was left out", heads, rows, note)


def _by_trial(audit: Audit, heading: str, heads: Sequence[Head], rows: Sequence[Row], note: str) -> Table:
    """Table with a row per trial: named by its fraction; with several attackers, by the attacker in groups of a
    fraction."""
    named_rows = list(zip(audit.trials, rows, strict=True))
    if len(audit.attackers) == 1:
        groups = [Group("", [[fraction(trial.fraction), *row] for trial, row in named_rows])]
        return Table(heading, [Head("Points published"), *heads], groups, note)
    groups = [
        Group(
            f"{fraction(share)} of the points published" if audit.known else "",
            [[seen_by(trial.used), *row] for trial, row in named_rows if trial.fraction == share],
        )
        for share in audit.fractions
    ]
    return Table(heading, [Head("Attacker sees"), *heads], groups, note)


def _shown(audit: Audit) -> list[Figure]:
    """List the figures of the page that at least one trial has; of a map of few points, none that is measured by the
    spacing, but its errors as lengths."""
    scores = [trial.scores.figures for trial in audit.trials if trial.scores]
    page = [each for each in figures() if (not each.by_spacing if audit.few else each.page)]
    return [each for each in page if any(found[each.name] is not None for found in scores)]


def _heads(shown: Sequence[Figure]) -> list[Head]:
    """Return the headings of the columns; adjacent columns with the same upper heading share it."""
    heads = []
    for over, group in groupby(shown, lambda figure: figure.over or figure.name):
        own = list(group)
        under = tuple(figure.column for figure in own)
        heads.append(Head(over, under) if own[0].over else Head(own[0].heading[0].upper() + own[0].heading[1:]))
    return heads


def _values(trial: Trial, shown: Sequence[Figure]) -> list[str]:
    assert trial.scores is not None
    values = [(figure, trial.scores.figures[figure.name]) for figure in shown]
    return [
        "-" if value is None else figure.counted(value, len(trial)) or _FORMS[figure.form](value)
        for figure, value in values
    ]


def _predicted_table(audit: Audit) -> Table:
    heads = [Head("Lines"), Head("1 spacing, estimated")]
    rows = [[count(len(trial)), length(audit.spacing, audit.metric)] for trial in audit.trials]
    note = "The spacing is that of the recovered points, which is usually a little below that of the map."
    if not audit.recognised["expected"]:
        # Points that are wrong throughout, as all at one centre, have a spacing of their own.
        heads, rows = heads[:1], [row[:1] for row in rows]
        note = "On these lines, not even the spacing of the map can be estimated from the recovered points."
    if audit.calibrated:
        heads += [Head("Expected within 1 spacing", ("all points", "confident half"))]
        for row, trial in zip(rows, audit.trials, strict=True):
            assert trial.prediction is not None
            row += [percent(trial.prediction.within_spacing), percent(trial.prediction.confident_half)]
        note = f"The expected share is the mean confidence, also of the most confident half. {note}"
    heading = "Predicted, not measured" if audit.calibrated else "Not measured"
    heads.append(Head("Seconds"))
    rows = [[*row, f"{trial.seconds:.1f}"] for row, trial in zip(rows, audit.trials, strict=True)]
    if len(audit.attackers) > 1:
        return _by_trial(audit, heading, heads, rows, note)
    return Table(heading, heads, [Group("", rows)], note)


def _facts(audit: Audit, share: bool) -> list[tuple[str, str]]:
    """List the facts of the run: method, settings, machine, time."""
    settings, weights = audit.trials[0].recovery.info["settings"], ""
    if "checkpoint" in settings:
        weights = f"SHA-256 begins with {settings['digest']}"
        weights = weights if share else f"{settings['checkpoint']}, {weights}"
    made = audit.as_dict()
    where = made["machine"]
    memory = "" if where["memory_gib"] is None else f", {where['memory_gib']:g} GiB"
    machine = f"{where['processor']}, {where['threads']} of {where['cores']} cores{memory}, {where['system']}"
    facts = [
        ("Given", f"{audit.name}: {count(audit.points)} {'points' if audit.known else 'lines'}"),
        ("Left out on request", "" if audit.left_out is None else f"{count(audit.left_out.points)} points"),
        ("Published beside the lines", named(audit.published)),
        ("Ignored on request", named(audit.ignored)),
        ("Method", audit.method),
        ("Checkpoint", weights),
        ("Seed of the line clouds", "" if audit.seed is None else str(audit.seed)),
        ("Versions", ", ".join(f"{name} {version}" for name, version in made["versions"].items())),
        ("Machine", "" if share else machine),
        ("Date", datetime.datetime.now(datetime.timezone.utc).date().isoformat()),
    ]
    return [(what, value) for what, value in facts if value]


def _duration(seconds: float) -> str:
    """
    >>> _duration(0.3), _duration(42), _duration(600)
    ('less than a second', '42 seconds', '10 minutes')
    """
    if seconds < 1:
        return "less than a second"
    if seconds < 120:
        return f"{seconds:.0f} second{'s' if round(seconds) != 1 else ''}"
    return f"{seconds / 60:.0f} minutes"
