"""The decision: releases of a map, what each gives away, and how well cameras are localized in it.

Every release that an audit has figures of is an :class:`Option`: points as they are, or lines, with some of the
attributes, at each fraction. One that gives away no less and localizes no better than another is dominated.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from l2p.auditing.attackers import Attacker
from l2p.auditing.audit import Audit
from l2p.errors import InputError
from l2p.utility import POINTS
from l2p.utility.localization import LIMITS, Limit, Localization, checked_limits, finite, parsed_limit

#: Share of the queries that must be localized, if the user does not say.
_ENOUGH = 0.9


@dataclass(frozen=True)
class Goal:
    """What a release is wanted to reach.

    Attributes
    ----------
    limit : Limit
        Errors within which a query counts as localized.
    localized : float
        Least share of the queries that must be.
    recovered : float or None
        Largest share of the map's points that may come back; then the release that localizes best is sought, else the
        one that gives away least.
    """

    limit: Limit
    localized: float = _ENOUGH
    recovered: float | None = None


@dataclass(frozen=True)
class Option:
    """One release.

    Attributes
    ----------
    scheme : str
        ``points``, or the scheme that hides them.
    published : tuple of str
        Attributes published with it.
    fraction : float
        Share of the points that is published, of those that are not left out.
    recovered : float
        Share of the *map's* points that come back within 1 spacing, if the attacker uses all that is published.
    alone : float
        The same, if he uses the lines alone.
    of_published : float
        Share of the *published* points that come back.
    localized : float
        Share of the queries within the limit.
    position, rotation : float
        Median errors of the queries: share of the cameras' extent (metres in a metric map), degrees.
    matchable : bool
        Whether cameras can find matches by the descriptors of the release, as far as the map has any.
    """

    scheme: str
    published: Attacker
    fraction: float
    recovered: float
    alone: float
    of_published: float
    localized: float
    position: float
    rotation: float
    matchable: bool

    def dominates(self, other: Option) -> bool:
        """Whether this release is no worse than another and better in something: in what it gives away, in the share of
        localized queries, or in their error of position."""
        if other.matchable and not self.matchable:
            return False
        mine, its = self._cost(), other._cost()
        return all(a <= b for a, b in zip(mine, its, strict=True)) and mine != its

    def _cost(self) -> tuple[float, float, float]:
        return self.recovered, -self.localized, self.position


@dataclass(frozen=True)
class Decision:
    """Releases of a map, and the one to choose.

    Attributes
    ----------
    goal : Goal
    options : tuple of Option
        By scheme and attributes, each from the largest to the smallest fraction.
    best : Option or None
        Release that reaches the goal; None if none does.
    """

    goal: Goal
    options: tuple[Option, ...]
    best: Option | None

    def dominated(self, option: Option) -> bool:
        """Whether another release is better on one side and no worse on the other."""
        return any(other.dominates(option) for other in self.options)

    def faint(self, option: Option) -> bool:
        """Whether a release is shown in grey: it is dominated, or cameras could not find matches in it."""
        return self.dominated(option) or not option.matchable

    @property
    def curves(self) -> dict[tuple[str, Attacker], list[Option]]:
        """Releases that differ in the fraction only."""
        found: dict[tuple[str, Attacker], list[Option]] = {}
        for option in self.options:
            found.setdefault((option.scheme, option.published), []).append(option)
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for a JSON file."""
        return {
            "goal": {
                "limit": str(self.goal.limit),
                "localized": self.goal.localized,
                "recovered": self.goal.recovered,
            },
            "releases": [
                {
                    **asdict(option),
                    "published": list(option.published),
                    "position": finite(option.position),
                    "rotation": finite(option.rotation),
                    "dominated": self.dominated(option),
                    "best": option == self.best,
                }
                for option in self.options
            ],
        }


def decide(audit: Audit, goal: Goal | None = None) -> Decision | None:
    """Compare the releases of an audit; None if nothing was localized or the points are not known.

    Raises
    ------
    InputError
        If the goal is in metres and the map is not.
    """
    found = audit.localization
    if found is None or not audit.known:
        return None
    goal = goal or Goal(found.limits[1 if not found.metric else 0])
    checked_limits([goal.limit], found.metric)
    options = tuple(_options(audit, found, goal.limit))
    return Decision(goal, options, best_of(options, goal))


def _options(audit: Audit, found: Localization, limit: Limit) -> list[Option]:
    described = "descriptor" in audit.attackers[0]
    options = []
    full, kept = audit.attackers[0], audit.kept
    for fraction in audit.fractions:
        plain = _figures(found, POINTS, fraction, limit)
        options.append(Option(POINTS, full, fraction, kept * fraction, kept * fraction, 1.0, *plain, matchable=True))
    for attacker in audit.attackers:
        for trial in audit.of_attacker(attacker):
            bare = next(each for each in audit.of_attacker(()) if each.fraction == trial.fraction)
            assert trial.within is not None and bare.within is not None
            options.append(
                Option(
                    audit.scheme,
                    attacker,
                    trial.fraction,
                    kept * trial.fraction * trial.within,
                    kept * trial.fraction * bare.within,
                    trial.within,
                    *_figures(found, audit.scheme, trial.fraction, limit),
                    matchable=not described or "descriptor" in attacker,
                )
            )
    return [*options, *_other_options(audit, found, limit)]


def _other_options(audit: Audit, found: Localization, limit: Limit) -> list[Option]:
    """Releases of the other schemes in which cameras can be localized, with all that is published."""
    if audit.others is None:
        return []
    used, options = audit.attackers[0], []
    for scheme, fraction in audit.others.hidden:
        full, bare = (audit.others.of_scheme(scheme, fraction, attacker) for attacker in (used, ()))
        back, alone = (trial.points / audit.points * trial.within for trial in (full, bare))
        figures = _figures(found, scheme, fraction, limit)
        options.append(Option(scheme, used, fraction, back, alone, full.within, *figures, matchable=True))
    return options


def _figures(found: Localization, scheme: str, fraction: float, limit: Limit) -> tuple[float, float, float]:
    """Share of the queries within the limit, and median errors."""
    trial = found.of(scheme, fraction)
    return trial.within(limit, found.extent), found.position(trial), trial.rotation


def best_of(options: Sequence[Option], goal: Goal) -> Option | None:
    """The release that reaches the goal best; None if none does."""
    fit = [option for option in options if option.matchable]
    if goal.recovered is not None:
        fit = [option for option in fit if option.recovered <= goal.recovered]
        return max(fit, key=lambda option: (option.localized, -option.position, -option.recovered), default=None)
    fit = [option for option in fit if option.localized >= goal.localized]
    return min(fit, key=lambda option: (option.recovered, -option.localized), default=None)


def parsed_goal(localize: str | None, recovered: str | None) -> Goal | None:
    """Parse ``0.25m,2deg=90%`` and ``20%``, of which one at most may be given; None: neither.

    Raises
    ------
    InputError
        If a text is something else, or both are given.

    Examples
    --------
    >>> parsed_goal("0.5%=95%", None)
    Goal(limit=Limit(position=0.005, rotation=inf, metric=False), localized=0.95, recovered=None)
    """
    if localize is None and recovered is None:
        return None
    limit, _, share = (localize or "").partition("=")
    if recovered is None:
        return Goal(parsed_limit(limit), _share(share or "90%", "--localize"))
    if share:
        raise InputError(f"got --localize {localize} and --recovered {recovered}; expected one share to reach, not two")
    return Goal(parsed_limit(limit) if limit else LIMITS[1], recovered=_share(recovered, "--recovered"))


def _share(text: str, flag: str) -> float:
    try:
        value = float(text.strip().removesuffix("%")) / (100 if "%" in text else 1)
    except ValueError:
        value = math.nan
    if not 0 < value <= 1:
        raise InputError(f"got {flag} with the share {text!r}; expected one above 0 % and at most 100 %, such as 90%")
    return value


def lift_command(option: Option, scene: str, descriptors: str | None = None, drop: Sequence[str] = ()) -> str:
    """Return the command that makes a release."""
    words = ["l2p", "lift", scene, "-o", "points.npz" if option.scheme == POINTS else "lines.npz"]
    words += ["--scheme", option.scheme, "--fraction", f"{option.fraction:.15g}"]
    words += ["--rgb"] if "rgb" in option.published else []
    if "descriptor" in option.published:
        words += ["--descriptors", *([descriptors] if descriptors else [])]
    words += drop
    return shlex.join(words)
