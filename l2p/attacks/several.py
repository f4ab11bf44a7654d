"""Recovery of a map from several releases: lines that meet give their point away, others keep that of an attack.

Every line has a few places where its point may be: where lines of other releases meet it, each with a probability
(:mod:`l2p.attacks.meetings`), and where an attack on all lines together puts it, with its confidence. Their odds
against "in none of these places" are multiplied where they name one place, which is within a spacing, and the most
probable place wins.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from l2p.attacks.attack import Attack
from l2p.attacks.learned.learned import spacing_ratio
from l2p.attacks.meetings import Meetings, meetings
from l2p.attacks.named import named_attack
from l2p.attacks.run import lines_of, recover
from l2p.attacks.settings import DEFAULT_METHOD, MethodName, owners_of
from l2p.checks import named
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.points import nearest_neighbors
from l2p.io.given_map import given_map
from l2p.maps.appearance import ATTRIBUTES
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.schemes.recognition import recognise
from l2p.work.progress import NO_PROGRESS, Progress

#: The spacing of points is the median distance to so many neighbours (:func:`l2p.judging.accuracy.spacing`).
_SPACING_NEIGHBOR = 50
#: Largest probability of a place in one source, and of one whose confidence only ranks.
_SUREST, _RANKS = 1 - 1e-6, 0.5
#: Share of equal lines from which two files count as the same release.
_SAME = 0.5
#: Pairs of places that are compared at a time.
_BLOCK = 1 << 22


def recover_releases(
    releases: Sequence[LineCloud | str | PathLike[str]],
    method: MethodName | str | Attack = DEFAULT_METHOD,
    *,
    device: str = "cpu",
    memory: float | None = None,
    progress: Progress = NO_PROGRESS,
    **settings: Any,
) -> Recovery:
    """Recover the points behind the first of several releases of one map, lifted with other directions each time.

    Nobody needs to tell which lines belong together. Lines of one point meet in it, which gives the point away up to
    the rounding of the coordinates; lines whose point is in the first release only keep the point that the attack finds
    on the lines of all releases together.

    Parameters
    ----------
    releases : sequence of LineCloud or path
        Two or more, in one coordinate frame. Attributes that all of them have are used.
    method, device, memory, progress, **settings
        As of :func:`l2p.recover`. ``fraction`` is that of the map's points in the first release. The search of meetings
        runs on the CPU.

    Returns
    -------
    Recovery
        Points in the order of the lines of the first release. ``info["releases"]`` has the number of lines of each,
        ``info["met"]`` how many of the first meet a line of another in their point. The confidence is calibrated if
        that of the method is.

    Raises
    ------
    InputError
        If there are fewer than two releases, one has no lines, two are the same lines, or as for :func:`l2p.recover`.

    Examples
    --------
    >>> import numpy as np, l2p
    >>> points = np.random.default_rng(1).normal(size=(300, 3))
    >>> first, second = (l2p.hide(points, seed=seed) for seed in (0, 1))
    >>> found = l2p.recover_releases([first.map, second.map], method="tomography", rounds=0)
    >>> found.info["met"], bool(np.abs(found.xyz - first.truth.xyz).max() < 1e-6)
    (300, True)
    """
    began = time.perf_counter()
    clouds = _clouds(releases)
    _check(clouds)
    common = _common(clouds)
    frame = Frame.of(_together(common))
    first, *others = (entered(frame, lines) for lines in common)
    pairs = [
        meetings(first, other, _descriptors(common[0], lines)) for other, lines in zip(others, common[1:], strict=True)
    ]
    known = {**settings}
    if isinstance(method, str) and method in owners_of("fraction"):
        known["fraction"] = _share(settings.get("fraction"), [len(lines) for lines in common], pairs)
    alone = recover(_together(common), method, device=device, memory=memory, progress=progress, **known)
    # Together they are recognised as several releases; each of them may be of uniform lines.
    attack = method if isinstance(method, Attack) else named_attack(method, **known)
    calibrated = attack.calibrated and all(recognise(lines).expected for lines in common)
    alone = replace(alone, calibrated=calibrated)
    if not alone.one_each:
        raise InputError("got an attack that places several points on a line, or none; expected one point per line")
    count = len(common[0])
    reach = _spacing(alone.xyz[:count]) * spacing_ratio(settings.get("fraction") or 1.0)
    ahead = np.sum(common[0].direction * frame.center, axis=1)
    placed = _Places.of(pairs, (alone.beta[:count] - ahead) / frame.unit, _confidence(alone, count))
    beta, probability, met = placed.best(count, reach / frame.unit)
    # The position of the attack is kept to the bit.
    beta = np.where(met, ahead + frame.unit * beta, alone.beta[:count])
    info = {
        **alone.info,
        "releases": [len(lines) for lines in clouds],
        "met": int(np.sum(met & (probability >= 0.5))),
        "seconds": time.perf_counter() - began,
    }
    return Recovery(
        xyz=clouds[0].at(beta),
        confidence=probability.astype(np.float32),
        beta=beta,
        rgb=clouds[0].rgb,
        info=info,
        calibrated=alone.calibrated,
    )


def _clouds(releases: object) -> list[LineCloud]:
    """The line clouds that are given, or read from their files."""
    if isinstance(releases, str) or not isinstance(releases, Sequence):
        raise InputError(f"got {named(releases)}; expected a list of two or more line clouds, or of their files")
    return [lines_of(given_map(each)) for each in releases]


def _check(releases: Sequence[LineCloud]) -> None:
    if len(releases) < 2:
        raise InputError(f"got {len(releases)} release(s); expected at least two; one is attacked by l2p recover alone")
    for lines in releases:
        if len(lines) == 0:
            raise InputError("got a line cloud without lines; expected at least one line in each release")
    for number, lines in enumerate(releases):
        for before, other in enumerate(releases[:number]):
            same = _equal_lines(other, lines)
            if same > _SAME * min(len(lines), len(other)):
                raise InputError(
                    f"got releases {before + 1} and {number + 1} with {same} equal lines; expected releases with "
                    "directions of their own; leave one of them out"
                )


def _equal_lines(first: LineCloud, second: LineCloud) -> int:
    """Lines of the second release that are lines of the first, up to sign and rounding to single precision."""

    def keys(lines: LineCloud) -> Float[np.ndarray, "lines 3"]:
        largest = np.take_along_axis(lines.direction, np.abs(lines.direction).argmax(axis=1)[:, None], axis=1)
        return np.rint(lines.direction * np.sign(largest) * 2.0**20)

    # Equal directions are enough: of uniform ones, hardly any two are equal to 20 binary digits.
    known = {row.tobytes() for row in keys(first) + 0.0}
    return sum(row.tobytes() in known for row in keys(second) + 0.0)


def _common(releases: Sequence[LineCloud]) -> list[LineCloud]:
    """Leave out the attributes that not all releases have in the same form."""
    forms = [
        {name: (getattr(lines, name).dtype, getattr(lines, name).shape[1]) for name in lines.appearance.names}
        for lines in releases
    ]
    kinds = {lines.descriptor_kind for lines in releases}
    out = [
        name
        for name in ATTRIBUTES
        if len({form.get(name) for form in forms}) > 1 or (name == "descriptor" and len(kinds) > 1)
    ]
    return [lines.without(out) for lines in releases]


def _together(releases: Sequence[LineCloud]) -> LineCloud:
    columns = {
        name: None if getattr(releases[0], name) is None else np.concatenate([getattr(each, name) for each in releases])
        for name in ("direction", "moment", *ATTRIBUTES)
    }
    return replace(releases[0], **columns)


def entered(frame: Frame, lines: LineCloud) -> Lines:
    """Transform lines to the centre and unit of the frame; not rounded as for attacks, since meetings are finer."""
    moment = (lines.moment - np.cross(frame.center, lines.direction)) / frame.unit
    return Lines(torch.as_tensor(lines.direction.copy()), torch.as_tensor(moment))


def _descriptors(first: LineCloud, second: LineCloud) -> tuple[np.ndarray, np.ndarray] | None:
    if first.descriptor is None or second.descriptor is None:
        return None
    return first.descriptor, second.descriptor


def _share(fraction: float | None, counts: Sequence[int], pairs: Sequence[Meetings]) -> float | None:
    """Fraction of the map's points that the lines of all releases hold; pairs of lines are one point."""
    if fraction is None:
        return None
    points = sum(counts) - sum(float(each.probability.sum()) for each in pairs)
    return min(1.0, fraction * max(points, counts[0]) / counts[0])


def _spacing(points: Float[np.ndarray, "points 3"]) -> float:
    distance = nearest_neighbors(points, _SPACING_NEIGHBOR).distance
    return float(np.median(distance[:, -1])) if distance.size else 0.0


def _confidence(alone: Recovery, count: int) -> Float[np.ndarray, " lines"]:
    confidence = alone.confidence[:count].astype(np.float64)
    return confidence if alone.calibrated else confidence.clip(max=_RANKS)


class _Places(NamedTuple):
    """Places where the points of lines may be: by which source, where on the line, at what odds against nowhere."""

    row: Int[np.ndarray, " places"]
    source: Int[np.ndarray, " places"]
    beta: Float[np.ndarray, " places"]
    odds: Float[np.ndarray, " places"]

    @classmethod
    def of(
        cls, pairs: Sequence[Meetings], beta: Float[np.ndarray, " lines"], confidence: Float[np.ndarray, " lines"]
    ) -> _Places:
        """Places of meetings, a source for each release, and of the attack, source -1."""
        lines = np.arange(len(beta))
        sources = [(lines, beta, confidence), *((each.row, each.beta, each.probability) for each in pairs)]
        rows, betas, odds = [], [], []
        for row, place, probability in sources:
            none = 1 - np.bincount(row, probability, len(beta))
            rows.append(row)
            betas.append(place)
            odds.append(probability / np.maximum(none[row], 1 - _SUREST))
        source = np.repeat(np.arange(len(sources)) - 1, [len(row) for row in rows])
        row = np.concatenate(rows)
        order = np.argsort(row, kind="stable")
        return cls(row[order], source[order], np.concatenate(betas)[order], np.concatenate(odds)[order])

    def best(
        self, count: int, reach: float
    ) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"], Bool[np.ndarray, " lines"]]:
        """Most probable place of each line, the probability that the point is within ``reach`` of it, and whether it is
        a meeting."""
        begin = np.searchsorted(self.row, np.arange(count + 1))
        width = int(np.diff(begin).max())
        step = max(1, _BLOCK // width**2)
        found = [self._best(begin[start : start + step + 1], width, reach) for start in range(0, count, step)]
        beta, probability, met = (np.concatenate(column) for column in zip(*found, strict=True))
        return beta, probability, met

    def _best(self, begin: Int[np.ndarray, " bounds"], width: int, reach: float) -> tuple[np.ndarray, ...]:
        index = begin[:-1, None] + np.arange(width)
        real = index < begin[1:, None]
        index = np.where(real, index, begin[:-1, None])
        source, beta, odds = self.source[index], self.beta[index], np.where(real, self.odds[index], 0.0)
        near = np.abs(beta[:, :, None] - beta[:, None, :]) <= reach
        near |= np.eye(width, dtype=np.bool_)
        weight = np.ones(beta.shape)
        for each in np.unique(self.source):
            weight *= 1 + np.einsum("npq,nq->np", near, np.where(source == each, odds, 0.0))
        weight -= 1
        # Places within reach of each other are one.
        own = odds / np.maximum(np.einsum("npq,nq->np", near, odds), 1e-300)
        probability = weight / (1 + (weight * own).sum(axis=1, keepdims=True))
        # In the best place a meeting is exact, the attack is not.
        place = np.take_along_axis(near, np.where(real, probability, -1).argmax(axis=1)[:, None, None], axis=1)[:, 0]
        rank = np.where(real & place, np.where(source >= 0, 1e12, 0) + odds, -1)
        chosen = rank.argmax(axis=1)[:, None]
        picked = (np.take_along_axis(column, chosen, axis=1)[:, 0] for column in (beta, probability, source))
        where, sure, by = picked
        return where, sure.clip(0, 1), by >= 0
