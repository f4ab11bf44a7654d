"""The audit: how much of a map an attacker would recover, at several fractions of its points.

A scene is lifted, attacked and scored against its own points. A line cloud, whose points are unknown, is attacked as it
is, and its scores are predicted from the calibrated confidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from l2p.attacks.run import recover
from l2p.attacks.settings import DEFAULT_METHOD, owners_of
from l2p.auditing import FRACTIONS
from l2p.checks import check_fraction
from l2p.errors import InputError
from l2p.judging.accuracy import compare, spacing
from l2p.judging.curves import SHARES, THRESHOLDS, Curves, measured_curves, predicted_curves
from l2p.judging.measure import measured
from l2p.judging.provenance import machine, versions
from l2p.judging.scores import Scores
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene
from l2p.maps.truth import Truth
from l2p.schemes.hide import hide
from l2p.work.progress import NO_PROGRESS, Progress

#: Version of the layout of ``audit.json``, written into it.
AUDIT_VERSION = 1


@dataclass(frozen=True)
class Prediction:
    """Scores predicted from the calibrated confidence, without the truth.

    Attributes
    ----------
    within_spacing : float
        Expected share of points within 1 spacing: the mean confidence.
    confident_half : float
        Expected share among the most confident half.
    """

    within_spacing: float
    confident_half: float

    @classmethod
    def of(cls, recovery: Recovery) -> Prediction | None:
        """Predict from the confidences of a recovery; None if they only rank."""
        if not recovery.calibrated:
            return None
        ordered = np.sort(recovery.confidence.astype(np.float64))[::-1]
        return cls(float(ordered.mean()), float(ordered[: (len(ordered) + 1) // 2].mean()))


@dataclass(frozen=True, eq=False)
class Trial:
    """One attack of an audit.

    Attributes
    ----------
    fraction : float
        Fraction of the map's points that was lifted.
    lines : LineCloud
    recovery : Recovery
        The recovery without neighbours and affinities.
    truth : Truth or None
        The points behind the lines; None if the audit was given a line cloud.
    rgb : (lines, 3) uint8 or None
        Colours of the points behind the lines, for pictures; the attack does not use them.
    scores : Scores or None
        None without the truth.
    prediction : Prediction or None
        None if the confidence of the method is no probability.
    curves : Curves
    """

    fraction: float
    lines: LineCloud
    recovery: Recovery
    truth: Truth | None
    rgb: UInt8[np.ndarray, "lines 3"] | None
    scores: Scores | None
    prediction: Prediction | None
    curves: Curves

    @property
    def seconds(self) -> float:
        """Wall time of the attack."""
        return float(self.recovery.info["seconds"])

    def __len__(self) -> int:
        return len(self.lines)


@dataclass(frozen=True, eq=False)
class Audit:
    """Results of an audit.

    Attributes
    ----------
    name : str
        Name of the map, chosen by the user.
    points : int
        Number of points of the map; of lines, if a line cloud was given.
    spacing : float
        Spacing of the whole map, scene units; estimated from the recovered points if a line cloud was given.
    trials : tuple of Trial
        From the largest to the smallest fraction.
    method : str
    seed : int or None
        Seed of the liftings; None if a line cloud was given.
    metric : bool
        The scene is in metres.
    camera_centers : (cameras, 3) float64 or None
        Camera centres of the scene, if it has any, scene units.
    """

    name: str
    points: int
    spacing: float
    trials: tuple[Trial, ...]
    method: str
    seed: int | None
    metric: bool
    camera_centers: Float[np.ndarray, "cameras 3"] | None = None

    @property
    def known(self) -> bool:
        """Whether the points behind the lines are known, so that errors are measured and not predicted."""
        return self.trials[0].truth is not None

    @property
    def calibrated(self) -> bool:
        """Whether the confidence is the probability of lying within 1 spacing."""
        return self.trials[0].recovery.calibrated

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
            "versions": versions(),
            "machine": {**machine(), "threads": torch.get_num_threads()},
            "thresholds": THRESHOLDS.tolist(),
            "coverage": SHARES.tolist(),
            "trials": [_as_dict(trial) for trial in self.trials],
        }


def audit(
    scene: Scene | LineCloud | Float[np.ndarray, "points 3"],
    fractions: Sequence[float] | None = None,
    seed: int = 0,
    *,
    method: str = DEFAULT_METHOD,
    metric: bool = False,
    device: str = "cpu",
    memory: float | None = None,
    progress: Progress = NO_PROGRESS,
    name: str = "map",
    **settings: Any,
) -> Audit:
    """Measure how much of a map an attacker would recover, if its line cloud were published.

    Parameters
    ----------
    scene : Scene, (points, 3) array or LineCloud
        A scene or its points are lifted, attacked and scored. A line cloud is attacked as it is.
    fractions : sequence of float, optional
        Fractions of the points to lift, in (0, 1]; default :data:`FRACTIONS`. Not with a line cloud.
    seed : int
        Seed of the liftings, for repeatable audits. Line clouds to publish must be lifted without a seed.
    method, device, memory, **settings
        See :func:`l2p.recover`; attacks that use the fraction of the points get the true one.
    metric : bool
        The scene is in metres.
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
        If the checkpoint does not exist.
    InputError
        If a fraction is out of range or given with a line cloud, the points have no extent, or as for
        :func:`l2p.recover`.

    Examples
    --------
    >>> import l2p
    >>> found = l2p.audit(l2p.simulate("room", 200).xyz, fractions=[1, 0.5], method="tomography")
    >>> [len(trial) for trial in found.trials]
    [200, 100]
    """
    settings |= {"method": method, "device": device, "memory": memory}
    if isinstance(scene, LineCloud):
        if fractions is not None:
            raise InputError("got fractions for a line cloud; expected none, since it is attacked as it is")
        return _audit_lines(scene, settings, metric, progress, name)
    scene = scene if isinstance(scene, Scene) else Scene(scene)
    wanted = _fractions(FRACTIONS if fractions is None else fractions)
    scale = spacing(scene.xyz)
    trials: list[Trial] = []
    with progress.task("lines attacked", total=sum(max(1, round(len(scene) * share)) for share in wanted)) as advance:
        for share in wanted:
            trials.append(_trial(scene, share, seed, scale, settings, metric, progress))
            advance(len(trials[-1]))
    return Audit(name, len(scene), scale, tuple(trials[::-1]), method, seed, metric, scene.camera_centers)


def _fractions(wanted: Sequence[float]) -> list[float]:
    """Fractions, each once, from the smallest to the largest."""
    if not len(wanted):
        raise InputError("got no fraction; expected at least one, a number in (0, 1]")
    for share in wanted:
        check_fraction(share)
    return sorted({float(share) for share in wanted})


def _trial(
    scene: Scene,
    fraction: float,
    seed: int,
    scale: float,
    settings: dict[str, Any],
    metric: bool,
    progress: Progress,
) -> Trial:
    """Lift a fraction of the scene, attack it, and score the recovery."""
    hidden = hide(scene, seed, fraction)
    truth = replace(hidden.truth, spacing=scale)
    rgb = None if scene.rgb is None else scene.rgb[truth.index]
    recovery = _attack(hidden.map, fraction, settings, progress)
    found = compare(recovery, truth, metric=metric)
    return Trial(
        fraction,
        hidden.map,
        recovery,
        truth,
        rgb,
        Scores(measured(found)),
        Prediction.of(recovery),
        measured_curves(found),
    )


def _audit_lines(lines: LineCloud, settings: dict[str, Any], metric: bool, progress: Progress, name: str) -> Audit:
    """Attack a line cloud whose points are unknown."""
    recovery = _attack(lines, 1.0, settings, progress)
    trial = Trial(1.0, lines, recovery, None, lines.rgb, None, Prediction.of(recovery), predicted_curves(recovery))
    return Audit(name, len(lines), spacing(recovery.xyz), (trial,), settings["method"], None, metric)


def _attack(lines: LineCloud, fraction: float, settings: dict[str, Any], progress: Progress) -> Recovery:
    """Recover, then drop neighbours and affinities; pass the true fraction to attacks with that setting."""
    known = {"fraction": fraction} if settings["method"] in owners_of("fraction") else {}
    recovery = recover(lines, progress=progress, **known, **settings)
    return replace(recovery, neighbors=None, affinity=None)


def _as_dict(trial: Trial) -> dict[str, Any]:
    return {
        "fraction": trial.fraction,
        "lines": len(trial),
        "attack": trial.recovery.info,
        "scores": None if trial.scores is None else trial.scores.as_dict(),
        "prediction": None if trial.prediction is None else asdict(trial.prediction),
        "curves": trial.curves.as_dict(),
    }
