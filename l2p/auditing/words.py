"""Sentences of a report: the figures in plain words."""

from __future__ import annotations

from l2p.auditing.audit import Audit, Trial
from l2p.show.page.numbers import count, fraction, length, percent

#: Least gain in the share within 1 spacing, from all points to the most confident half, that is called informative.
_TELLING = 0.02


def headline(audit: Audit) -> str:
    """Share of the map recovered at the largest fraction, and whether the attacker knows which points are right."""
    trial = audit.trials[0]
    within, half = _figures(trial)
    spacing = f"1 spacing ({length(audit.spacing, audit.metric)})"
    if within is None:
        return f"{count(len(trial))} points were recovered, but how many of them are right is not known."
    of = "points"
    if audit.known and trial.fraction < 1:
        of = f"published points ({fraction(trial.fraction)} of the map)"
    if not audit.known and half is not None:
        return (
            f"About {percent(within)} of the {of} are expected to be recovered within {spacing}; among the most "
            f"confident half, {percent(half)}."
        )
    recovered = f"{percent(within)} of the {of} are recovered within {spacing}"
    return f"{recovered}." if half is None else f"{recovered}; {_knowledge(within, half)} of the time."


def _knowledge(within: float, half: float) -> str:
    """Whether the attacker can tell which points are right."""
    if 1 - half <= (1 - within) / 2:
        return f"the attacker knows which: the most confident half is right {percent(half)}"
    if half - within >= _TELLING:
        return f"the attacker has some idea which: the most confident half is right {percent(half)}"
    return f"the attacker can hardly tell which: the most confident half is right only {percent(half)}"


def typical(audit: Audit) -> str:
    """Median error at the largest fraction of the map; empty unless the scene is metric and the truth known."""
    scores = audit.trials[0].scores
    if scores is None or not audit.metric:
        return ""
    return f"Half of the points come out within {length(scores.median, True)} of their true place."


def sparser(audit: Audit) -> str:
    """Share recovered at the smallest fraction of the map; empty if only one fraction was tried."""
    if len(audit.trials) < 2:
        return ""
    trial = audit.trials[-1]
    within, _ = _figures(trial)
    assert within is not None
    return (
        f"If only {fraction(trial.fraction)} of the points are published ({count(len(trial))} lines), "
        f"{percent(within)} of these are recovered within 1 spacing."
    )


def _figures(trial: Trial) -> tuple[float | None, float | None]:
    """Share within 1 spacing among all points and the most confident half; measured if possible, else predicted."""
    if trial.scores is not None:
        return trial.scores.within_spacings["1"], trial.scores.confident_half
    if trial.prediction is not None:
        return trial.prediction.within_spacing, trial.prediction.confident_half
    return None, None
