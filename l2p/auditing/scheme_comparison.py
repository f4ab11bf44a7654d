"""The ways to hide a map beside each other on a page: a table and a chart."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from l2p.auditing.attackers import named
from l2p.auditing.audit import Audit
from l2p.auditing.charts import Chart, percent_axis, styles, svg
from l2p.auditing.other_schemes import OtherSchemes, SchemeTrial
from l2p.auditing.page_table import Group, Head, Row, Table
from l2p.schemes.scheme import MEANINGS, UNATTACKED
from l2p.show.page.numbers import count, fraction, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def compared(audit: Audit, others: OtherSchemes) -> list[SchemeTrial]:
    """Attacks on all schemes, that of the audit first: by all that is published, and without appearance."""
    own = []
    for trial in audit.trials:
        if trial.used not in (audit.attackers[0], ()) or trial.scores is None:
            continue
        scores = trial.scores
        own.append(
            SchemeTrial(
                audit.scheme,
                trial.fraction,
                trial.used,
                len(trial),
                scores.within_spacings["1"],
                scores.median_spacings,
                None,
                None,
                trial.seconds,
            )
        )
    return [*own, *others.trials]


def comparison_table(audit: Audit, others: OtherSchemes) -> Table:
    """What comes back of the map for each way to hide it."""
    trials = compared(audit, others)
    heads = [Head("Scheme"), Head("Attacker sees"), Head("Points behind it"), Head("Within 1 spacing")]
    heads += [Head("Median error (spacings)")]
    pairs, fakes = any(t.both is not None for t in trials), any(t.real is not None for t in trials)
    heads += [Head("Both points of a line")] if pairs else []
    heads += [Head("Real told from fake (AUC)")] if fakes else []
    heads.append(Head("Seconds"))
    groups = []
    for share in audit.fractions:
        rows: list[Row] = []
        for trial in (each for each in trials if each.fraction == share):
            row = [trial.scheme, f"all + {named(trial.used)}" if trial.used else "nothing else", count(trial.points)]
            row += [percent(trial.within), f"{trial.median:.2f}"]
            row += ["-" if trial.both is None else percent(trial.both)] if pairs else []
            row += ["-" if trial.real is None else f"{trial.real:.2f}"] if fakes else []
            rows.append([*row, f"{trial.seconds:.1f}"])
        groups.append(Group(f"{fraction(share)} of the points", rows))
    meanings = "; ".join(f"{name}: {MEANINGS[name]}" for name in (audit.scheme, *others.schemes))
    note = (
        "Each map is attacked by the attack that knows its scheme. Shares are of the points that the scheme publishes; "
        f"some leave points out. {meanings[0].upper()}{meanings[1:]}."
    )
    if unknown := [name for name in (audit.scheme, *others.schemes) if name in UNATTACKED]:
        note += f" No attack was made for {', '.join(unknown)}: one that knows it may recover more."
    return Table("Other ways to hide this map", heads, groups, note)


def comparison_chart(audit: Audit, others: OtherSchemes) -> Chart:
    """Draw the share that comes back of each scheme at the largest fraction."""
    largest = audit.fractions[0]
    trials = [trial for trial in compared(audit, others) if trial.fraction == largest]
    schemes = list(dict.fromkeys(trial.scheme for trial in trials))
    used = audit.attackers[0]
    labels = [f"with {named(used)}", "without"] if used else ["attacked"]

    def draw(axes: Axes) -> None:
        for attacker, label, style in zip(dict.fromkeys((used, ())), labels, styles(labels), strict=True):
            own = {trial.scheme: trial.within for trial in trials if trial.used == attacker}
            look: dict[str, Any] = {"color": style["color"], "linestyle": "none", "clip_on": False, "markersize": 6}
            face: dict[str, Any] = {} if attacker == used else {"markerfacecolor": "none"}
            axes.plot([own[scheme] for scheme in schemes], range(len(schemes)), marker="o", label=label, **look, **face)
        axes.set(xlim=(0, 1), ylim=(len(schemes) - 0.5, -0.5), xlabel="of the published points, within 1 spacing")
        axes.set_yticks(range(len(schemes)), schemes)
        percent_axis(axes.xaxis)
        axes.minorticks_off()

    best = {scheme: max(t.within for t in trials if t.scheme == scheme) for scheme in schemes}
    ends = "; ".join(f"{scheme}: {percent(share)}" for scheme, share in best.items())
    return Chart(
        "What does each way of hiding give away?",
        f"Share of the published points that come back within 1 spacing, if {fraction(largest)} of the map are hidden "
        "by each scheme and attacked by the attack that knows it. Further to the right means that more is given away.",
        f"A mark for each scheme and attacker. The most that comes back: {ends}.",
        svg("schemes", draw),
    )
