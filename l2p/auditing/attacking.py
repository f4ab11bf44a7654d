"""Attacks of an audit: on a lifted share of a scene, whose points are known, or on the lines of a user."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool

from l2p.attacks.run import recover
from l2p.attacks.settings import owners_of
from l2p.attacks.several import recover_releases
from l2p.auditing.attackers import Attacker, others
from l2p.auditing.trial import Prediction, Trial
from l2p.errors import InputError
from l2p.judging.accuracy import compare, spacing
from l2p.judging.curves import measured_curves, predicted_curves
from l2p.judging.measure import measured
from l2p.judging.scores import Scores
from l2p.maps.appearance import ATTRIBUTES
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene
from l2p.schemes.hide import hide

#: Recovers lines that hold a fraction of the map's points.
Recover = Callable[[LineCloud, float], Recovery]


def lifted_trials(
    scene: Scene,
    drop: Bool[np.ndarray, " points"] | None,
    fraction: float,
    seed: int,
    scale: float,
    attackers: Sequence[Attacker],
    attack: Recover,
    metric: bool,
    advance: Callable[[int], None],
) -> list[Trial]:
    """Lift a fraction of the scene once, attack it as each attacker, and score the recoveries."""
    used = attackers[0]
    hidden = hide(scene, seed, fraction, rgb="rgb" in used, descriptor="descriptor" in used, drop=drop)
    truth = replace(hidden.truth, spacing=scale)
    rgb = None if scene.rgb is None else scene.rgb[truth.index]
    bare, trials = hidden.map.without(ATTRIBUTES), []
    for attacker in attackers:
        recovery = attack(hidden.map.without(others(attacker)), fraction)
        found = compare(recovery, truth, metric=metric)
        scores, curves = Scores(measured(found)), measured_curves(found)
        trials.append(Trial(fraction, attacker, bare, recovery, truth, rgb, scores, Prediction.of(recovery), curves))
        advance(len(bare))
    return trials


def line_trials(
    lines: LineCloud, attackers: Sequence[Attacker], attack: Recover, advance: Callable[[int], None]
) -> tuple[Trial, ...]:
    """Attack a line cloud whose points are unknown as each attacker."""
    bare, trials = lines.without(ATTRIBUTES), []
    for attacker in attackers:
        recovery = attack(lines.without(others(attacker)), 1.0)
        prediction, curves = Prediction.of(recovery), predicted_curves(recovery)
        trials.append(Trial(1.0, attacker, bare, recovery, None, lines.rgb, None, prediction, curves))
        advance(len(lines))
    return tuple(trials)


def estimated_spacing(trial: Trial) -> float:
    """Spacing of the recovered points; of points that coincide, as of lines through one centre, the size of the map."""
    try:
        return spacing(trial.recovery.xyz)
    except InputError:
        if trial.recovery.info["recognised"]["expected"]:
            raise
        return float(np.ptp(trial.lines.origin, axis=0).max()) or 1.0


def recovered(
    lines: LineCloud | list[LineCloud], fraction: float, *, method: str, settings: dict[str, Any], **where: Any
) -> Recovery:
    """Recover, from one release or several, then drop neighbours and affinities; pass the true fraction to attacks with
    that setting."""
    known = {"fraction": fraction} if method in owners_of("fraction") else {}
    if isinstance(lines, list):
        return recover_releases(lines, method, **where, **known, **settings)
    recovery = recover(lines, method, **where, **known, **settings)
    return replace(recovery, neighbors=None, affinity=None)
