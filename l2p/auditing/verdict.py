"""The verdict of an audit: in a few plain words, how much of the map its line cloud gives away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from l2p.auditing.audit import Audit
from l2p.show.page.numbers import count, fraction, length, percent

#: Shares of the points that come back, from which a map counts as exposed and as partly exposed.
_EXPOSED, _PARTLY = 0.5, 0.1
#: The same for the most confident half: an attacker who keeps these has a thinner but clean map.
_EXPOSED_HALF = 0.8
#: Fewest lines with a verdict: of fewer points, the 50th neighbour, and with it 1 spacing, is a good part of the map.
FEW = 200


#: How much is given away.
Level = Literal["exposed", "partly", "little", "unknown"]
#: First words of a verdict: measured, and predicted of a line cloud.
_WORDS: dict[Level, tuple[str, str]] = {
    "exposed": ("Exposed", "Probably exposed"),
    "partly": ("Partly exposed", "Probably exposed in part"),
    "little": ("Little comes back", "Little is likely to come back"),
    "unknown": ("No verdict", "No verdict"),
}


@dataclass(frozen=True)
class Verdict:
    """What an audit found, for a reader in a hurry.

    Attributes
    ----------
    level : Level
    word : str
        First words, such as ``Exposed``.
    sentence : str
        The rest, without figures of the trade.
    """

    level: Level
    word: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.word}: {self.sentence}"


def verdict_of(audit: Audit) -> Verdict:
    """Judge the largest fraction, attacked by all that is published."""
    trial = audit.trials[0]
    within, half = trial.within, trial.confident_half
    if within is None:
        why = "nobody can tell how many of the recovered points are right."
    elif len(trial) < FEW:
        why = f"{count(len(trial))} points are too few; of a map of {count(FEW)} and more the shares mean something."
    else:
        level = _level(within, half)
        return Verdict(level, _WORDS[level][0 if audit.known else 1], _sentence(audit, level, within))
    return Verdict("unknown", _WORDS["unknown"][0], why)


def _level(within: float, half: float | None) -> Level:
    """
    >>> _level(0.88, 0.97), _level(0.45, 0.85), _level(0.2, 0.3), _level(0.03, None)
    ('exposed', 'exposed', 'partly', 'little')
    """
    if within >= _EXPOSED or (half is not None and half >= _EXPOSED_HALF):
        return "exposed"
    return "partly" if within >= _PARTLY else "little"


def _sentence(audit: Audit, level: Level, within: float) -> str:
    share = audit.trials[0].fraction
    what = "points" if share == 1 and audit.left_out is None else "published points"
    what += f" ({fraction(share)} of all)" if share < 1 else ""
    who = "this attack" if level == "little" else "an attacker"
    gets = f"gets {percent(within)}" if audit.known else f"is expected to get about {percent(within)}"
    place = (
        f", to within {length(audit.spacing, True)} of where they were" if audit.metric else ", near where they were"
    )
    doubt = " A better attack may get more." if level == "little" else ""
    return f"{who} {gets} of the {what} back{place}.{doubt}"
