"""Pose of a query from matches with wrong ones among them: RANSAC, local optimisation, Cauchy least squares."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.errors import InputError
from l2p.maps.short_repr import short_repr
from l2p.utility.landmarks import Gravity, Landmarks
from l2p.utility.queries import Pose

#: Share of samples without a wrong match that give the right pose: noise, and poses that a solver drops.
_YIELD = 0.75
#: The search ends when a pose with so many times the inliers of the best would have been found. What agrees with a
#: wrong pose is far less than what agrees with the right one, and the refinement finds the rest of its inliers; to
#: demand 1 costs 1.25^6 = 3.8 times the samples for poses that differ by less than their noise.
_MORE = 1.25
#: Matches, as a multiple of a sample, that have to agree: a sample always agrees with its own poses.
_AGREE = 2
#: Most matches among which the search draws and judges; the last refinement has all. So many tell which pose is best.
_SEARCHED = 400
#: Steps of a local refinement; rounds of the last one, and steps in each.
_LOCAL, _ROUNDS, _STEPS = 2, 5, 20
#: Relative fall of the loss at which a refinement ends.
_GAIN = 1e-9
#: Damping of a step of least squares, relative to the diagonal.
_DAMPING = 1e-9


@dataclass(frozen=True)
class RansacConfig:
    """Settings of the localization.

    Attributes
    ----------
    threshold : float
        Largest residual of an inlier, pixels.
    scale : float
        Scale of the Cauchy loss of the refinement, pixels.
    confidence : float
        Probability that a better pose would have been found, at which the search ends.
    least_samples, most_samples : int
        Samples that are drawn, at least and at most.
    """

    threshold: float = 4.0
    scale: float = 1.0
    confidence: float = 0.999
    least_samples: int = 20
    most_samples: int = 3000

    def __post_init__(self) -> None:
        for name in ("threshold", "scale"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"got {name} {getattr(self, name)} of the localization; expected more than 0 pixels")
        if not 0 < self.confidence < 1:
            raise InputError(f"got confidence {self.confidence} of the localization; expected a number in (0, 1)")
        if not 1 <= self.least_samples <= self.most_samples:
            raise InputError(
                f"got {self.least_samples} to {self.most_samples} samples of the localization; expected at least 1, "
                "and no fewer at most"
            )


@dataclass(frozen=True, eq=False)
class Located:
    """A pose, and what led to it.

    Attributes
    ----------
    pose : Pose
    inliers : (matches,) bool
        Matches within the threshold.
    samples : int
        Samples drawn.
    """

    pose: Pose
    inliers: Bool[np.ndarray, " matches"]
    samples: int

    __repr__ = short_repr


def locate(
    landmarks: Landmarks,
    bearing: Float[np.ndarray, "matches 3"],
    pixel: Float[np.ndarray, " matches"],
    rows: Int[np.ndarray, " matches"],
    config: RansacConfig,
    rng: np.random.Generator,
    gravity: Gravity | None = None,
) -> Located | None:
    """Find the pose that most matches agree with; None if hardly more agree than a sample.

    Parameters
    ----------
    landmarks : Landmarks
    bearing, pixel : (matches, 3) and (matches,) float64
        Unit vectors towards keypoints, and the radians in a pixel there.
    rows : (matches,) int64
        Landmark of each match.
    config : RansacConfig
    rng : numpy.random.Generator
    gravity : Gravity, optional
        Where known, samples are smaller. The refinement does not hold the pose to it.

    Notes
    -----
    Poses are scored by the truncated squares of their residuals (MSAC; Torr and Zisserman, 2000). Each pose that is
    better than all before is refined on its inliers (Chum et al., 2003), and the number of samples follows from the
    inliers of the best. The last refinement finds the least Cauchy loss of the inliers.
    """
    size = landmarks.sample if gravity is None else landmarks.upright_sample
    count = len(rows)
    if count < max(_AGREE * size, size + 1):
        return None
    whole = _Score(landmarks, bearing, pixel, rows, config)
    some = np.sort(rng.choice(count, size=_SEARCHED, replace=False)) if count > _SEARCHED else np.arange(count)
    best, drawn = _searched(_Score(landmarks, bearing[some], pixel[some], rows[some], config), size, rng, gravity)
    if best is None:
        return None
    best = whole.refined(best)
    inliers = whole.inliers(best)
    if inliers.sum() < _AGREE * size:
        return None
    return Located(landmarks.leave(best), inliers, drawn)


def _searched(
    score: _Score, size: int, rng: np.random.Generator, gravity: Gravity | None
) -> tuple[Float[np.ndarray, "3 4"] | None, int]:
    """Find the best pose of samples of the matches; return it, and the number of samples drawn."""
    config, count = score.config, len(score.rows)
    # Of few matches, many have to agree: a pose with the least share that is accepted would have been found by then.
    most = min(config.most_samples, _samples(_AGREE * size / count, size, config.confidence))
    best, least, wanted, drawn = None, math.inf, most, 0
    while drawn < min(max(wanted, config.least_samples), config.most_samples):
        drawn += 1
        some = rng.choice(count, size=size, replace=False, shuffle=False)
        poses = score.landmarks.poses(score.bearing[some], score.rows[some], gravity)
        if not len(poses):
            continue
        losses = score.losses(poses)
        first = int(np.argmin(losses))
        if losses[first] >= least:
            continue
        best, least = score.improved(poses[first], float(losses[first]))
        # A sample agrees with its own pose: only the other matches tell how many agree.
        agree = (int(score.inliers(best).sum()) - size) / (count - size)
        wanted = min(most, _samples(_MORE * max(agree, 0), size, config.confidence))
    return best, drawn


def _samples(share: float, size: int, confidence: float) -> int:
    """Number of samples after which one without a wrong match is as probable as the confidence."""
    good = _YIELD * min(share, 1) ** size
    return math.ceil(min(math.log(1 - confidence) / math.log1p(-max(good, 1e-12)), 1e9))


@dataclass(frozen=True, eq=False)
class _Score:
    """Residuals of the matches of one query."""

    landmarks: Landmarks
    bearing: Float[np.ndarray, "matches 3"]
    pixel: Float[np.ndarray, " matches"]
    rows: Int[np.ndarray, " matches"]
    config: RansacConfig

    __repr__ = short_repr

    def residuals(self, poses: Float[np.ndarray, "poses 3 4"]) -> Float[np.ndarray, "poses matches"]:
        """Residuals in pixels."""
        return self.landmarks.residuals(poses, self.bearing, self.rows) / self.pixel

    def losses(self, poses: Float[np.ndarray, "poses 3 4"]) -> Float[np.ndarray, " poses"]:
        """Sums of truncated squares."""
        return np.minimum(self.residuals(poses) ** 2, self.config.threshold**2).sum(axis=1)

    def inliers(self, pose: Float[np.ndarray, "3 4"]) -> Bool[np.ndarray, " matches"]:
        """Matches within the threshold."""
        return self.residuals(pose[None])[0] <= self.config.threshold

    def cauchy(self, pose: Float[np.ndarray, "3 4"], inliers: Bool[np.ndarray, " matches"]) -> float:
        """Sum of the Cauchy losses of some matches."""
        return float(np.log1p((self.residuals(pose[None])[0, inliers] / self.config.scale) ** 2).sum())

    def improved(self, pose: Float[np.ndarray, "3 4"], loss: float) -> tuple[Float[np.ndarray, "3 4"], float]:
        """Improve a pose by a few steps, each on its inliers, as long as the truncated squares fall."""
        for _ in range(_LOCAL):
            inliers = self.inliers(pose)
            if inliers.sum() < self.landmarks.sample:
                break
            moved = self._moved(pose, inliers)
            fallen = float(self.losses(moved[None])[0])
            if not fallen < loss:
                break
            pose, loss = moved, fallen
        return pose, loss

    def refined(self, pose: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "3 4"]:
        """Find the least Cauchy loss of the inliers of a pose; then that of its inliers, until they stay the same."""
        inliers = self.inliers(pose)
        for _ in range(_ROUNDS):
            if inliers.sum() < self.landmarks.sample:
                break
            loss = self.cauchy(pose, inliers)
            for _ in range(_STEPS):
                moved = self._moved(pose, inliers)
                fallen = self.cauchy(moved, inliers)
                if not fallen < loss:
                    break
                small = loss - fallen <= _GAIN * loss
                pose, loss = moved, fallen
                if small:
                    break
            before, inliers = inliers, self.inliers(pose)
            if (before == inliers).all():
                break
        return pose

    def _moved(self, pose: Float[np.ndarray, "3 4"], inliers: Bool[np.ndarray, " matches"]) -> Float[np.ndarray, "3 4"]:
        bearing, pixel, rows = self.bearing[inliers], self.pixel[inliers], self.rows[inliers]
        return _step(self.landmarks, pose, bearing, pixel, rows, self.config)


def _step(
    landmarks: Landmarks,
    pose: Float[np.ndarray, "3 4"],
    bearing: Float[np.ndarray, "inliers 3"],
    pixel: Float[np.ndarray, " inliers"],
    rows: Int[np.ndarray, " inliers"],
    config: RansacConfig,
) -> Float[np.ndarray, "3 4"]:
    """One step of iteratively reweighted least squares under the Cauchy loss."""
    from scipy.spatial.transform import Rotation

    residual, slope = landmarks.linearized(pose, bearing, rows)
    residual, slope = residual / pixel[:, None], slope / pixel[:, None, None]
    weight = 1 / (1 + np.sum(residual**2, axis=1) / config.scale**2)
    normal = np.einsum("m,mki,mkj->ij", weight, slope, slope, optimize=True)
    gradient = np.einsum("m,mki,mk->i", weight, slope, residual, optimize=True)
    normal[np.diag_indices(6)] *= 1 + _DAMPING
    step = np.linalg.lstsq(normal, -gradient, rcond=None)[0]
    return np.column_stack([Rotation.from_rotvec(step[:3]).as_matrix() @ pose[:, :3], pose[:, 3] + step[3:]])
