"""What the owner of a map can do about what an audit found; docs/responsible-use.md in short, with its figures."""

from __future__ import annotations

from typing import NamedTuple

from l2p.auditing.attackers import named
from l2p.auditing.audit import Audit
from l2p.auditing.trial import Trial
from l2p.auditing.verdict import Verdict
from l2p.auditing.words import savings
from l2p.show.page.numbers import fraction, percent


class Advice(NamedTuple):
    """Something to do, and why or how."""

    what: str
    how: str


def advice_of(audit: Audit, verdict: Verdict, *, decided: bool, shared: bool) -> list[Advice]:
    """List what can be done, the most effective first.

    Parameters
    ----------
    decided : bool
        The page compares releases by how well cameras are localized in them.
    shared : bool
        The page has no view of the map.
    """
    found = [_publishing(verdict)]
    if audit.known and len(audit.fractions) > 1:
        found.append(_fewer(audit, decided))
    if audit.attackers[0]:
        found.append(Advice(f"Leave out the {named(audit.attackers[0])} that cameras can do without.", savings(audit)))
    if audit.known:
        where = "" if shared else " The picture above shows what a box leaves out (Look at a region)."
        found.append(
            Advice(
                "Leave out the place that nobody may see.",
                "--drop-box, --drop-ids and --drop-masks of l2p lift take its points out with all that belongs to "
                f"them; the same flags of l2p audit prove it.{where}",
            )
        )
        if audit.others is None:
            found.append(
                Advice(
                    "Compare other ways to hide the map.",
                    "l2p audit --schemes ppl rays sphere-50 attacks each by the attack that knows it.",
                )
            )
    found.append(
        Advice(
            "Publish it once.",
            "A second release with fresh directions gives the points away exactly. Keep the seed and the truth file to "
            "yourself, or lift without --seed.",
        )
    )
    return found


def _publishing(verdict: Verdict) -> Advice:
    if verdict.level == "exposed":
        return Advice(
            "Treat these lines like the points.",
            "Give them only to those who may see the map itself; another random seed does not help. If they are public "
            "already, tell the owner of the place.",
        )
    if verdict.level == "partly":
        return Advice(
            "Look at what comes back before you publish.",
            "Walls and large things show first; whether that is too much depends on the place.",
        )
    if verdict.level == "little":
        return Advice(
            "Do not take a low figure for safety.",
            "It is what this attack gets; a better one, or a plan of the building, may give more.",
        )
    return Advice("Audit the map itself.", "With its true points, l2p audit measures what is not known here.")


def _fewer(audit: Audit, decided: bool) -> Advice:
    """How much comes back where fewer points are published, as a share of the whole map, if that can be told."""
    price = (
        "How well cameras are still localized stands below, under Which release?"
        if decided
        else "Cameras are localized less well, which the audit of a COLMAP model measures."
    )
    if audit.few:
        return Advice("Publish fewer points.", price)
    first, last = (_back(trial, audit.kept) for trial in (audit.strongest[0], audit.strongest[-1]))
    told = f"{first[0].upper()}{first[1:]} of the map come back; {last}. {price}"
    return Advice("Publish fewer points.", told)


def _back(trial: Trial, kept: float) -> str:
    assert trial.within is not None
    published = trial.fraction * kept
    return f"with {fraction(trial.fraction)} of the points published, {percent(trial.within * published)}"
