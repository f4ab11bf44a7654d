"""Results of a localization: errors of each query, and their figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from l2p.errors import InputError
from l2p.maps.short_repr import short_repr


@dataclass(frozen=True)
class Limit:
    """Largest errors of a query that counts as localized.

    Attributes
    ----------
    position : float
        In metres, or a share of the cameras' extent.
    rotation : float
        In degrees; infinite: any.
    metric : bool
        Whether ``position`` is in metres.
    """

    position: float
    rotation: float = math.inf
    metric: bool = False

    def __str__(self) -> str:
        """
        >>> str(Limit(0.25, 2, True)), str(Limit(0.005))
        ('0.25 m, 2 deg', '0.5 %')
        """
        position = f"{self.position:g} m" if self.metric else f"{100 * self.position:g} %"
        return position if math.isinf(self.rotation) else f"{position}, {self.rotation:g} deg"


#: Limits in metric maps (Sattler et al., CVPR 2018), and in others.
METRIC_LIMITS = (Limit(0.25, 2, True), Limit(0.5, 5, True), Limit(5, 10, True))
LIMITS = (Limit(0.001), Limit(0.005), Limit(0.01))


@dataclass(frozen=True)
class Attempt:
    """Localization of one query.

    Attributes
    ----------
    name : str
        Name of the image.
    matches, right : int
        Matches with the release, and those of them that the model has.
    position : float
        Distance of the camera's centre from its place in the model, scene units; infinite if no pose was found.
    rotation : float
        Angle between its rotation and that in the model, degrees.
    inliers, samples : int
        Matches that agree with the pose, and samples that were drawn.
    seconds : float
        Time of matching and pose.
    """

    name: str
    matches: int
    right: int
    position: float = math.inf
    rotation: float = math.inf
    inliers: int = 0
    samples: int = 0
    seconds: float = 0.0

    @property
    def found(self) -> bool:
        """Whether a pose was found."""
        return math.isfinite(self.position)


@dataclass(frozen=True)
class Localized:
    """All queries in one release.

    Attributes
    ----------
    scheme : str
        ``points``, or the scheme that hid them.
    fraction : float
        Share of the map's points that is published.
    wrong : float or None
        Share of wrong matches by tracks; None if matches are by descriptors.
    attempts : tuple of Attempt
    """

    scheme: str
    fraction: float
    wrong: float | None
    attempts: tuple[Attempt, ...]

    __repr__ = short_repr

    @property
    def position(self) -> float:
        """Median error of position, scene units; infinite if half of the queries were not localized."""
        return float(np.median([attempt.position for attempt in self.attempts]))

    @property
    def rotation(self) -> float:
        """Median error of rotation, degrees."""
        return float(np.median([attempt.rotation for attempt in self.attempts]))

    @property
    def seconds(self) -> float:
        """Mean time of a query."""
        return float(np.mean([attempt.seconds for attempt in self.attempts]))

    @property
    def matches(self) -> float:
        """Median number of matches."""
        return float(np.median([attempt.matches for attempt in self.attempts]))

    @property
    def inliers(self) -> float:
        """Median number of inliers."""
        return float(np.median([attempt.inliers for attempt in self.attempts]))

    def within(self, limit: Limit, extent: float) -> float:
        """Share of the queries within a limit; ``extent`` is that of the cameras, scene units."""
        most = limit.position if limit.metric else limit.position * extent
        good = [attempt.position <= most and attempt.rotation <= limit.rotation for attempt in self.attempts]
        return float(np.mean(good))


@dataclass(frozen=True)
class Localization:
    """Queries of a model in releases of its map.

    Attributes
    ----------
    name : str
        Name of the map.
    points : int
        Points of the map.
    extent : float
        Diagonal of the box around the cameras, scene units.
    metric : bool
        The map is in metres.
    matching : str
        ``tracks`` or ``descriptors``.
    upright : bool
        Whether gravity was known.
    seed : int
    trials : tuple of Localized
        Releases from the largest to the smallest share, each with all shares of wrong matches.
    """

    name: str
    points: int
    extent: float
    metric: bool
    matching: str
    upright: bool
    seed: int
    trials: tuple[Localized, ...]

    __repr__ = short_repr

    @property
    def limits(self) -> tuple[Limit, ...]:
        """Limits at which the share of localized queries is told."""
        return METRIC_LIMITS if self.metric else LIMITS

    def of(self, scheme: str, fraction: float) -> Localized:
        """The first trial of a release."""
        return next(trial for trial in self.trials if (trial.scheme, trial.fraction) == (scheme, fraction))

    def position(self, trial: Localized) -> float:
        """Median error of position: metres in a metric map, else a share of the cameras' extent."""
        return trial.position if self.metric else trial.position / self.extent

    def as_dict(self) -> dict[str, Any]:
        """Return all figures as plain values, for a JSON file; None in place of infinite errors."""
        return {
            "name": self.name,
            "points": self.points,
            "extent": self.extent,
            "metric": self.metric,
            "matching": self.matching,
            "gravity_known": self.upright,
            "seed": self.seed,
            "queries": len(self.trials[0].attempts),
            "limits": [str(limit) for limit in self.limits],
            "trials": [self._figures(trial) for trial in self.trials],
        }

    def _figures(self, trial: Localized) -> dict[str, Any]:
        return {
            "scheme": trial.scheme,
            "fraction": trial.fraction,
            "wrong_matches": trial.wrong,
            "matches": trial.matches,
            "inliers": trial.inliers,
            "median_position": finite(trial.position),
            "median_position_of_extent": finite(trial.position / self.extent),
            "median_rotation": finite(trial.rotation),
            "within": {str(limit): trial.within(limit, self.extent) for limit in self.limits},
            "seconds": trial.seconds,
        }

    def rows(self) -> list[dict[str, Any]]:
        """List every query of every trial as plain values, for a CSV file."""
        return [
            {"scheme": trial.scheme, "fraction": trial.fraction, "wrong_matches": trial.wrong, **asdict(attempt)}
            for trial in self.trials
            for attempt in trial.attempts
        ]


def finite(value: float) -> float | None:
    """The number, or None if it is infinite."""
    return value if math.isfinite(value) else None


def parsed_limit(text: str) -> Limit:
    """Parse ``0.25m,2deg``, ``0.5%`` or ``0.5%,1deg``.

    Raises
    ------
    InputError
        If it is something else.

    Examples
    --------
    >>> parsed_limit("0.25m,2deg")
    Limit(position=0.25, rotation=2.0, metric=True)
    """
    position, rotation, metric = None, None, False
    for part in text.replace(" ", "").split(","):
        for unit in ("deg", "cm", "m", "%"):
            if part.endswith(unit):
                value = _number(part.removesuffix(unit), text)
                if (rotation if unit == "deg" else position) is not None:
                    raise InputError(_refused(text))
                if unit == "deg":
                    rotation = value
                else:
                    position, metric = value / (1 if unit == "m" else 100), unit != "%"
                break
        else:
            raise InputError(_refused(text))
    if position is None:
        raise InputError(_refused(text))
    return Limit(position, math.inf if rotation is None else rotation, metric)


def _number(word: str, text: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise InputError(_refused(text))
    return value


def _refused(text: str) -> str:
    return f"got limit {text!r}; expected metres and degrees, 0.25m,2deg, or a share of the cameras' extent, 0.5%"


def checked_limits(limits: Sequence[Limit], metric: bool) -> None:
    """Refuse limits in metres for a map whose unit is not known."""
    if not metric and any(limit.metric for limit in limits):
        raise InputError(
            "got a limit in metres for a map whose unit is not known; say that it is in metres (--metric), or give a "
            "share of the cameras' extent, such as 0.5%"
        )
