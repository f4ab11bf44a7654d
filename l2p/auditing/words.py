"""Sentences of a report: the figures in plain words."""

from __future__ import annotations

import numpy as np

from l2p.attacks.apart import apart_words
from l2p.auditing.attackers import Attacker, named
from l2p.auditing.audit import Audit
from l2p.auditing.published_again import EXACT
from l2p.auditing.trial import Trial
from l2p.judging.intervals import interval
from l2p.judging.measure import as_count
from l2p.schemes.rounding import resolution_words
from l2p.show.page.numbers import SPACE, count, fraction, length, percent

#: Lines below which a share is told with its interval, and below which nobody can tell what an attacker knows.
_COUNTED, _FEW_LINES = 1000, 100
#: Share of a spacing above which the steps of the coordinates are worth a sentence.
_STEP = 0.02
#: Least gain in the share within 1 spacing, from all points to the most confident half, that is called informative.
_TELLING = 0.02


def sentences(audit: Audit) -> list[str]:
    """Return all sentences, the headline first."""
    return [
        each
        for make in (
            headline,
            chance,
            apart,
            steps,
            again,
            unexpected,
            region,
            left_out,
            alone,
            savings,
            typical,
            sparser,
        )
        if (each := make(audit))
    ]


def headline(audit: Audit) -> str:
    """Share of the map that the attacker who uses most recovers, at the largest fraction, and whether he knows which
    points are right."""
    trial = audit.trials[0]
    within, half = trial.within, trial.confident_half
    spacing = f"1 spacing ({length(audit.spacing, audit.metric)})"
    knowing = f"With the {named(trial.used)} beside the lines, " if trial.used else ""
    if audit.few:
        return _tiny(audit)
    if within is None:
        return f"{knowing}{count(len(trial))} points were recovered, but how many of them are right is not known."
    of = "points"
    if audit.known and trial.fraction < 1:
        whole = "the map" if audit.left_out is None else "what is left"
        of = f"published points ({fraction(trial.fraction)} of {whole})"
    elif audit.left_out is not None:
        of = "published points"
    if not audit.known and half is not None:
        return (
            f"{knowing}{'about' if knowing else 'About'} {percent(within)} of the {of} are expected to be recovered "
            f"within {spacing}; among the most confident half, {percent(half)}."
        )
    recovered = f"{knowing}{percent(within)} of the {of} are recovered within {spacing}"
    return (
        f"{recovered}."
        if half is None or len(trial) < _FEW_LINES
        else f"{recovered}; {_knowledge(within, half)} of the time."
    )


def _tiny(audit: Audit) -> str:
    """Headline of a map of a few points, whose spacing is about its size: errors over the size, or nothing."""
    trial = audit.trials[0]
    what = "points" if audit.known else "lines"
    few = (
        f"The map has {count(audit.points)} {what if audit.points != 1 else what[:-1]}, too few to measure by a spacing"
    )
    if trial.scores is None or trial.truth is None:
        return f"{few}: how many of them come back is not known."
    size = float(np.linalg.norm(np.ptp(trial.truth.xyz, axis=0)))
    return (
        f"{few}: the median error is {length(trial.scores.median, audit.metric)} in a map that is "
        f"{length(size, audit.metric)} across."
    )


def chance(audit: Audit) -> str:
    """Interval of the headline's share, if it was measured on few lines; empty for others."""
    trial = audit.trials[0]
    if audit.few or trial.scores is None or trial.within is None or len(trial) >= _COUNTED:
        return ""
    low, high = interval(trial.within, len(trial))
    return (
        f"On {count(len(trial))} lines, {percent(low)} to {percent(high)} would be no surprise (95{SPACE}% interval)."
    )


def apart(audit: Audit) -> str:
    """Lines that lie far outside the rest; empty for ordinary maps."""
    return apart_words(audit.trials[0].recovery.info)


def steps(audit: Audit) -> str:
    """Steps of the coordinates, if they are a part of a spacing that shows; empty if not, or without the points."""
    truth = audit.trials[0].truth
    words = "" if truth is None else resolution_words(truth.xyz, _STEP * audit.spacing)
    if not words:
        return ""
    return (
        f"The {words}, in scene units: each point is moved within its step before it is lifted, so that smaller errors "
        "cannot be measured."
    )


def unexpected(audit: Audit) -> str:
    """What the lines are, if the attack was not calibrated on such; empty for uniform lines."""
    found = audit.recognised
    if found["expected"]:
        return ""
    if audit.calibrated:
        return found["sentence"]
    return f"{found['sentence']} No probability is stated, because the attack was not calibrated on such lines."


def _knowledge(within: float, half: float) -> str:
    """Whether the attacker can tell which points are right."""
    if 1 - half <= (1 - within) / 2:
        return f"the attacker knows which: the most confident half is right {percent(half)}"
    if half - within >= _TELLING:
        return f"the attacker has some idea which: the most confident half is right {percent(half)}"
    return f"the attacker can hardly tell which: the most confident half is right only {percent(half)}"


def again(audit: Audit) -> str:
    """What further releases of the map give away, at the largest fraction; empty if they were not asked about."""
    if audit.again is None:
        return ""
    first = audit.again.trials[0]
    return (
        f"A map must be lifted once and for ever. If it is published {times(audit.again.releases)}, with fresh "
        f"directions, {percent(first.exact)} of the points are recovered within {EXACT:g} spacings and "
        f"{percent(first.within)} within 1, although nobody tells which lines belong together."
    )


def times(releases: int) -> str:
    """
    >>> times(2), times(3)
    ('twice', '3 times')
    """
    return "twice" if releases == 2 else f"{releases} times"


def region(audit: Audit) -> str:
    """What comes back of the region that was asked about, at the largest fraction; empty if none was."""
    asked = audit.region
    if asked is None:
        return ""
    first = asked.trials[0]
    what = f"{count(asked.points)} points of the map are in the region"
    if first.within is None or first.median is None:
        return f"{what}; none of them is published."
    whole = audit.trials[0].within
    than = "" if whole is None else f", of all published points {percent(whole)}"
    return (
        f"{what}: of {count(first.published)} that are published {percent(first.within)} come back within 1 "
        f"spacing{than}; their median error is {first.median:.2g} spacings."
    )


def left_out(audit: Audit) -> str:
    """How many of the points that were left out have something near, at the largest fraction; empty if none were."""
    out = audit.left_out
    if out is None:
        return ""
    near, share = out.near[0], percent(out.points / audit.points)
    were = "point of the map was" if out.points == 1 else "points of the map were"
    return (
        f"{count(out.points)} {were} left out ({share}): {percent(near.recovered)} of them have a recovered point "
        f"within 1 spacing; {percent(near.published)} have a published neighbour that near."
    )


def alone(audit: Audit) -> str:
    """Share recovered from the lines alone, at the largest fraction; empty if nobody uses more, or it is not known."""
    bare = audit.of_attacker(())[0].within
    saved = _saved(audit, audit.attackers[0])
    if bare is None or saved is None or audit.few:
        return ""
    if saved > 0:
        return f"From the lines alone, {percent(bare)} would be {'recovered' if audit.known else 'expected'}."
    if saved == 0:
        return "From the lines alone, it would be about as many."
    return (
        f"From the lines alone, it would be more, {percent(bare)}: what is published beside them misleads this attack, "
        "and an attacker can ignore it."
    )


def savings(audit: Audit) -> str:
    """Points that leaving out each attribute, and both, would save at the largest fraction; empty if nobody uses any,
    or it is not known."""
    if audit.few:
        return ""
    used = audit.attackers[0]
    options: list[Attacker] = [(name,) for name in reversed(used)]
    options += [used] if len(used) > 1 else []
    found = [(each, _saved(audit, each)) for each in options]
    return " ".join(_saving(audit, each, saved) for each, saved in found if saved is not None)


def _saving(audit: Audit, attributes: Attacker, saved: int) -> str:
    """What leaving out some attributes would save, in a sentence."""
    about, recovers = ("", "recovers") if audit.known else ("about ", "expects")
    if saved > 0:
        effect = f"save {about}{saved} of 100 points"
    elif saved == 0:
        effect = "save hardly any point"
    else:
        effect = f"save nothing, as this attack {recovers} {-saved} of 100 points more without them"
    what = "both" if len(attributes) > 1 else f"the {named(attributes)}"
    price = "; cameras are then no longer localized by them" if attributes == ("descriptor",) else ""
    return f"Leaving out {what} would {effect}{price}."


def _saved(audit: Audit, attributes: Attacker) -> int | None:
    """Points of 100 that come back less without some attributes; None without attributes or figures.

    The difference of whole percents, as they are shown.
    """
    least, most = audit.without(attributes).within, audit.trials[0].within
    if not attributes or least is None or most is None:
        return None
    return round(100 * most) - round(100 * least)


def typical(audit: Audit) -> str:
    """Median error at the largest fraction of the map; empty unless the scene is metric and the truth known."""
    scores = audit.trials[0].scores
    if scores is None or not audit.metric:
        return ""
    return f"Half of the points come out within {length(scores.median, True)} of their true place."


def sparser(audit: Audit) -> str:
    """Share recovered at the smallest fraction of the map; empty if only one fraction was tried."""
    if len(audit.fractions) < 2 or audit.few:
        return ""
    trial, bare = audit.strongest[-1], audit.trials[-1]
    lines = f"{count(len(trial))} line{'' if len(trial) == 1 else 's'}"
    return (
        f"If only {fraction(trial.fraction)} of the points are published ({lines}), "
        f"{_share(trial)}{' of these' if '%' in _share(trial) else ''} are recovered within 1 spacing"
        f"{f', and {_share(bare)} from the lines alone' if trial.used else ''}."
    )


def _share(trial: Trial) -> str:
    """Share within 1 spacing; of a few lines, their number."""
    assert trial.within is not None
    counted = "" if trial.scores is None else as_count(trial.within, len(trial))
    return counted or percent(trial.within)
