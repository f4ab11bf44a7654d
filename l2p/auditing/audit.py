"""The audit: how much of a map attackers would recover, at several fractions of its points.

A scene is lifted, attacked and scored against its own points. A line cloud, whose points are unknown, is attacked as it
is, and its scores are predicted from the calibrated confidence. Attackers differ in the published attributes that they
use; all attack the same lines.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from l2p.attacks.named import named_attack
from l2p.attacks.settings import DEFAULT_METHOD, MethodName
from l2p.auditing import FRACTIONS
from l2p.auditing.asked import check_asked
from l2p.auditing.attackers import Attacker, attackers_of
from l2p.auditing.attacking import estimated_spacing, lifted_trials, line_trials, recovered
from l2p.auditing.left_out import LeftOut
from l2p.auditing.other_schemes import OtherSchemes, attacks_of
from l2p.auditing.published_again import PublishedAgain
from l2p.auditing.region_asked import AskedRegion
from l2p.auditing.seen import Seen
from l2p.auditing.trial import Trial
from l2p.checks import check_fraction, check_seed
from l2p.errors import InputError
from l2p.io.given import GivenScene, given_scene
from l2p.judging.accuracy import spacing
from l2p.judging.curves import SHARES, THRESHOLDS
from l2p.judging.provenance import machine, versions
from l2p.maps import AttributeName
from l2p.maps.appearance import ATTRIBUTES
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.maps.region import kept_rows
from l2p.maps.scene import Scene
from l2p.maps.short_repr import short_repr
from l2p.maps.truth import Hiding
from l2p.schemes.hide import hide
from l2p.schemes.scheme import SchemeName
from l2p.utility.localization import Localization
from l2p.utility.queries import Queries
from l2p.utility.releases import LocalizeConfig, localize_hidden
from l2p.work.progress import NO_PROGRESS, Progress

#: Version of the layout of ``audit.json``, written into it.
AUDIT_VERSION = 5
#: Points of a map, at most, whose spacing is about the size of the map: that is the distance to the 50th neighbour.
FEW_POINTS = 100


@dataclass(frozen=True, eq=False)
class Audit:
    """Results of an audit.

    Attributes
    ----------
    name : str
        Name of the map, chosen by the user.
    points : int
        Number of points of the map, also of those left out; of lines, if a line cloud was given.
    spacing : float
        Spacing of the whole map, scene units; estimated from the recovered points if a line cloud was given, which
        means little unless its lines are uniform.
    trials : tuple of Trial
        From the largest to the smallest fraction, and in each from the attacker who uses most to the one who sees lines
        alone.
    method : str
    seed : int or None
        Seed of the liftings; None if a line cloud was given.
    metric : bool
        The scene is in metres.
    camera_centers : (cameras, 3) float64 or None
        Camera centres of the scene, if it has any, scene units.
    published : tuple of str
        Attributes of the map that attackers may use, also if the method uses none.
    ignored : tuple of str
        Attributes that were left out on request.
    left_out : LeftOut or None
        Points that were left out on request.
    region : AskedRegion or None
        What comes back of the region that was asked about.
    localization : Localization or None
        Images of the map, localized in its releases; None without queries.
    undropped : Localization or None
        The same at the largest fraction if no point were left out; None if none was.
    others : OtherSchemes or None
        Attacks on the map hidden by other schemes; None if none was asked for.
    again : PublishedAgain or None
        What several releases of the map give away together; None if only one was asked about.
    pictures : tuple of Seen
        Pictures of some views (:func:`l2p.auditing.seen.pictures_of`).
    up : (3,) float64 or None
        Unit vector of up in the scene, if it is known.
    """

    name: str
    points: int
    spacing: float
    trials: tuple[Trial, ...]
    method: str
    seed: int | None
    metric: bool
    camera_centers: Float[np.ndarray, "cameras 3"] | None = None
    published: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()
    left_out: LeftOut | None = None
    region: AskedRegion | None = None
    localization: Localization | None = None
    undropped: Localization | None = None
    others: OtherSchemes | None = None
    again: PublishedAgain | None = None
    pictures: tuple[Seen, ...] = ()
    up: Float[np.ndarray, "3"] | None = None

    __repr__ = short_repr

    @property
    def scheme(self) -> str:
        """Scheme of the lines."""
        return self.trials[0].lines.scheme

    @property
    def few(self) -> bool:
        """Whether the map has too few points to measure by its spacing."""
        return self.points <= FEW_POINTS

    @property
    def kept(self) -> float:
        """Share of the map's points that were not left out."""
        return 1 - (0 if self.left_out is None else self.left_out.points / self.points)

    @property
    def fractions(self) -> tuple[float, ...]:
        """Fractions, the largest first."""
        return tuple(dict.fromkeys(trial.fraction for trial in self.trials))

    @property
    def attackers(self) -> tuple[Attacker, ...]:
        """Attackers, from the one who uses most to the one who sees lines alone."""
        return tuple(dict.fromkeys(trial.used for trial in self.trials))

    def of_attacker(self, attacker: Attacker) -> tuple[Trial, ...]:
        """Trials of one attacker, the largest fraction first."""
        return tuple(trial for trial in self.trials if trial.used == attacker)

    @property
    def strongest(self) -> tuple[Trial, ...]:
        """Trials of the attacker who uses most, the largest fraction first."""
        return self.of_attacker(self.attackers[0])

    def without(self, attributes: Collection[str]) -> Trial:
        """Trial at the largest fraction of the attacker who uses most of what is left without these attributes."""
        return next(trial for trial in self.trials if not set(trial.used) & set(attributes))

    @property
    def known(self) -> bool:
        """Whether the points behind the lines are known, so that errors are measured and not predicted."""
        return self.trials[0].truth is not None

    @property
    def calibrated(self) -> bool:
        """Whether the confidence is the probability of lying within 1 spacing."""
        return self.trials[0].recovery.calibrated

    @property
    def recognised(self) -> dict[str, Any]:
        """What the lines were recognised as (:meth:`l2p.schemes.recognition.Recognition.as_dict`)."""
        return self.trials[0].recovery.info["recognised"]

    def as_dict(self) -> dict[str, Any]:
        """Return all figures, settings and versions as plain values, for a JSON file."""
        return {
            "version": AUDIT_VERSION,
            "name": self.name,
            "points": self.points,
            "truth_known": self.known,
            "spacing": self.spacing,
            "metric": self.metric,
            "seed": self.seed,
            "method": self.method,
            "published": list(self.published),
            "ignored": list(self.ignored),
            "left_out": None if self.left_out is None else self.left_out.as_dict(),
            "region": None if self.region is None else self.region.as_dict(),
            "other_schemes": None if self.others is None else self.others.as_dict(),
            "published_again": None if self.again is None else self.again.as_dict(),
            "versions": versions(),
            "machine": {**machine(), "threads": torch.get_num_threads()},
            "thresholds": THRESHOLDS.tolist(),
            "coverage": SHARES.tolist(),
            "trials": [trial.as_dict() for trial in self.trials],
            "pictures": [seen.as_dict() for seen in self.pictures],
            "localization": None if self.localization is None else self.localization.as_dict(),
        }


def audit(
    scene: GivenScene,
    fractions: Sequence[float] | float | None = None,
    seed: int = 0,
    *,
    method: MethodName | str = DEFAULT_METHOD,
    ignore: Collection[AttributeName | str] = (),
    drop: Bool[np.ndarray, " points"] | None = None,
    region: Bool[np.ndarray, " points"] | None = None,
    schemes: Sequence[SchemeName | str] = (),
    releases: int = 1,
    metric: bool = False,
    device: str = "cpu",
    memory: float | None = None,
    queries: Queries | None = None,
    localizing: LocalizeConfig | None = None,
    progress: Progress = NO_PROGRESS,
    name: str = "map",
    **settings: Any,
) -> Audit:
    """Measure how much of a map attackers would recover, if its line cloud were published.

    At each fraction, one attacker uses all published attributes (colours, descriptors) that the method can use, others
    leave some or all of them out: up to four attacks on the same lines.

    Parameters
    ----------
    scene : Scene, (points, 3) array, LineCloud or path
        The map, or the path of its file. A scene or its points are lifted, attacked and scored. A line cloud is
        attacked as it is. Its colours and descriptors are taken as published.
    fractions : sequence of float, optional
        Fractions of the points to lift, in (0, 1]; default :data:`FRACTIONS`. Not with a line cloud.
    seed : int
        Seed of the liftings, for repeatable audits. Line clouds to publish must be lifted without a seed.
    method, device, memory, **settings
        See :func:`l2p.recover`; attacks that use the fraction of the points get the true one.
    ignore : collection of str
        Attributes that no attacker may use, some of ``rgb`` and ``descriptor``: those that will not be published.
    drop : (points,) bool, optional
        True for each point to leave out before any is published (:func:`l2p.hide`). The audit says how many of them
        have something within 1 spacing that is still there. Not with a line cloud.
    region : (points,) bool, optional
        True for each point of a region: the audit also says how much comes back of it. Not with a line cloud.
    schemes : sequence of str
        Other ways to hide the map (:data:`l2p.schemes.scheme.SCHEMES`) to compare at the same fractions, each against
        the attack that knows it. Not with a line cloud.
    releases : int
        2 or more: the audit also says what so many releases, with other directions each, give away together by their
        lines alone (:func:`l2p.recover_releases`). Not with a line cloud.
    metric : bool
        The scene is in metres.
    queries : Queries, optional
        Images of the scene's model (:func:`l2p.utility.releases.read_queries`): also measure how well they are
        localized at each fraction, in the lines and in the points as they are.
    localizing : LocalizeConfig, optional
        Settings of that.
    progress : Progress
        Shows the progress; the smallest fraction comes first, so that the rate is soon known.
    name : str
        Name of the map, for the report.

    Returns
    -------
    Audit
        ``l2p.save_report(audit, "report")`` writes it as an HTML page.

    Raises
    ------
    FileNotFoundError
        If the file or the checkpoint does not exist.
    InputError
        If it is no map, a fraction is out of range, an attribute is unknown, none or all of the points are dropped,
        fractions or points to drop are given with a line cloud, the points have no extent, or as for
        :func:`l2p.recover`.

    Examples
    --------
    >>> import l2p
    >>> found = l2p.audit(l2p.simulate("room", 200).xyz, fractions=[1, 0.5], method="tomography")
    >>> [len(trial) for trial in found.trials]
    [200, 100]
    """
    scene = given_scene(scene)
    check_seed(seed)
    # One name, or one number, where several may be given.
    ignore = (ignore,) if isinstance(ignore, str) else ignore
    schemes = (schemes,) if isinstance(schemes, str) else schemes
    fractions = [fractions] if isinstance(fractions, int | float) else fractions
    drop, region = (None if each is None else np.asarray(each) for each in (drop, region))
    check_asked(scene, fractions, queries, drop, region, schemes, releases)
    published = scene.appearance.without(ignore)
    attackers = attackers_of(named_attack(method, **settings), published)
    ignored = tuple(attribute for attribute in ATTRIBUTES if attribute in ignore)
    attack = partial(recovered, method=method, device=device, memory=memory, progress=progress, settings=settings)
    if isinstance(scene, LineCloud):
        with _task(progress, [len(scene)], attackers) as advance:
            trials = line_trials(scene, attackers, attack, advance)
        scale = estimated_spacing(trials[0])
        return Audit(name, len(scene), scale, trials, method, None, metric, None, published.names, ignored)
    wanted = _fractions(FRACTIONS if fractions is None else fractions)
    kept = len(scene) if drop is None else len(kept_rows(drop, len(scene)))
    scale = spacing(scene.xyz)
    trials = ()
    with _task(progress, [max(1, round(kept * share)) for share in wanted], attackers) as advance:
        for share in wanted:
            trials = (*lifted_trials(scene, drop, share, seed, scale, attackers, attack, metric, advance), *trials)
    pairs = [(trial.recovery, trial.truth) for trial in trials if trial.truth is not None]
    found = Audit(
        name,
        len(scene),
        scale,
        trials,
        method,
        seed,
        metric,
        scene.camera_centers,
        published.names,
        ignored,
        None if drop is None else LeftOut.of(scene.xyz[drop], pairs, scale),
        None if region is None else AskedRegion.of(region, trials, scale),
        up=scene.up,
    )
    if schemes:
        found = replace(found, others=_others(found, scene, drop, schemes, progress, attack))
    if releases > 1:
        found = replace(found, again=_again(found, scene, drop, releases, progress, attack))
    if queries is None:
        return found
    config, largest = localizing or LocalizeConfig(), found.fractions[0]
    localized_in = partial(localize_hidden, queries, config=config, metric=metric, progress=progress, name=name)
    whole = None if drop is None else localized_in({largest: hide(scene, seed, largest)})
    published = {trial.fraction: Hiding(trial.lines, trial.truth) for trial in trials if trial.truth is not None}
    beside = None if found.others is None else found.others.hidden
    return replace(found, localization=localized_in(published, others=beside), undropped=whole)


def _fractions(wanted: Sequence[float]) -> list[float]:
    """Fractions, each once, from the smallest to the largest."""
    if not len(wanted):
        raise InputError("got no fraction; expected at least one, a number in (0, 1]")
    for share in wanted:
        check_fraction(share)
    return sorted({float(share) for share in wanted})


def _task(
    progress: Progress, lines: Sequence[int], attackers: Sequence[Attacker]
) -> AbstractContextManager[Callable[[int], None]]:
    """Open the progress of all attacks; ``lines`` of each fraction."""
    attacks = len(lines) * len(attackers)
    name = f"lines of {attacks} attacks" if attacks > 1 else "lines attacked"
    return progress.task(name, total=sum(lines) * len(attackers))


def _others(
    found: Audit,
    scene: Scene,
    drop: Bool[np.ndarray, " points"] | None,
    schemes: Sequence[str],
    progress: Progress,
    attack: Callable[[Any, float], Recovery],
) -> OtherSchemes:
    """Hide the scene of an audit by other schemes, and attack it."""
    assert found.seed is not None
    wanted, used = [name for name in dict.fromkeys(schemes) if name != found.scheme], found.attackers[0]
    with progress.task("attacks on other schemes", total=attacks_of(wanted, found.fractions, used)) as advance:

        def counted(hidden: Any, fraction: float) -> Recovery:
            recovery = attack(hidden, fraction)
            advance(1)
            return recovery

        return OtherSchemes.of(scene, wanted, found.fractions, found.seed, found.spacing, used, counted, drop)


def _again(
    found: Audit,
    scene: Scene,
    drop: Bool[np.ndarray, " points"] | None,
    releases: int,
    progress: Progress,
    attack: Callable[[list[LineCloud], float], Recovery],
) -> PublishedAgain:
    """Lift the scene of an audit again, and attack its releases together."""
    assert found.seed is not None
    kept = sum(len(trial) for trial in found.strongest)
    with progress.task(f"lines of {releases} releases", total=releases * kept) as advance:

        def counted(lines: list[LineCloud], fraction: float) -> Recovery:
            recovery = attack(lines, fraction)
            advance(sum(map(len, lines)))
            return recovery

        return PublishedAgain.of(scene, releases, found.fractions, found.seed, found.spacing, counted, drop)
