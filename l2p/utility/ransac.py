"""Pose of a query from matches with wrong ones among them: RANSAC, local optimisation, Cauchy least squares."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.errors import InputError
from l2p.utility.landmarks import Gravity, Landmarks
from l2p.utility.queries import Pose

#: Share of samples without a wrong match that give the right pose: noise, and poses that a solver drops.
_YIELD = 0.75
#: Matches, as a multiple of a sample, that have to agree: a sample always agrees with its own poses.
_AGREE = 2
#: Steps of a refinement, and the relative gain at which it ends.
_STEPS, _GAIN = 10, 1e-6
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
        Probability that a sample without a wrong match was drawn, at which the search ends.
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
    inliers of the best.
    """
    size = landmarks.sample if gravity is None else landmarks.upright_sample
    count = len(rows)
    if count < max(_AGREE * size, size + 1):
        return None
    score = _Score(landmarks, bearing, pixel, rows, config)
    best, least, wanted, drawn = None, math.inf, config.most_samples, 0
    while drawn < max(wanted, config.least_samples) and drawn < config.most_samples:
        drawn += 1
        some = rng.choice(count, size=size, replace=False, shuffle=False)
        poses = landmarks.poses(bearing[some], rows[some], gravity)
        if not len(poses):
            continue
        losses = score.losses(poses)
        first = int(np.argmin(losses))
        if losses[first] >= least:
            continue
        pose, loss = score.refined(poses[first], losses[first], 2)
        best, least = pose, loss
        wanted = _samples(score.inliers(best).mean(), size, config.confidence)
    if best is None:
        return None
    best, _ = score.refined(best, least, _STEPS)
    inliers = score.inliers(best)
    if inliers.sum() < _AGREE * size:
        return None
    return Located(landmarks.leave(best), inliers, drawn)


def _samples(share: float, size: int, confidence: float) -> int:
    """Number of samples after which one without a wrong match is as probable as the confidence."""
    good = _YIELD * float(share) ** size
    if good >= 1 - 1e-12:
        return 1
    return math.ceil(min(math.log(1 - confidence) / math.log1p(-max(good, 1e-12)), 1e9))


@dataclass(frozen=True, eq=False)
class _Score:
    """Residuals of the matches of one query."""

    landmarks: Landmarks
    bearing: Float[np.ndarray, "matches 3"]
    pixel: Float[np.ndarray, " matches"]
    rows: Int[np.ndarray, " matches"]
    config: RansacConfig

    def residuals(self, poses: Float[np.ndarray, "poses 3 4"]) -> Float[np.ndarray, "poses matches"]:
        """Residuals in pixels."""
        return self.landmarks.residuals(poses, self.bearing, self.rows) / self.pixel

    def losses(self, poses: Float[np.ndarray, "poses 3 4"]) -> Float[np.ndarray, " poses"]:
        """Sums of truncated squares."""
        return np.minimum(self.residuals(poses) ** 2, self.config.threshold**2).sum(axis=1)

    def inliers(self, pose: Float[np.ndarray, "3 4"]) -> Bool[np.ndarray, " matches"]:
        """Matches within the threshold."""
        return self.residuals(pose[None])[0] <= self.config.threshold

    def refined(
        self, pose: Float[np.ndarray, "3 4"], loss: float, rounds: int
    ) -> tuple[Float[np.ndarray, "3 4"], float]:
        """Refine a pose on its inliers, which are chosen anew in each round, as long as its loss falls."""
        for _ in range(rounds):
            inliers = self.inliers(pose)
            if inliers.sum() < self.landmarks.sample:
                break
            moved = _step(
                self.landmarks, pose, self.bearing[inliers], self.pixel[inliers], self.rows[inliers], self.config
            )
            fallen = float(self.losses(moved[None])[0])
            if not fallen < loss:
                break
            small = loss - fallen <= _GAIN * loss
            pose, loss = moved, fallen
            if small:
                break
        return pose, loss


def _step(
    landmarks: Landmarks,
    pose: Float[np.ndarray, "3 4"],
    bearing: Float[np.ndarray, "inliers 3"],
    pixel: Float[np.ndarray, " inliers"],
    rows: Int[np.ndarray, " inliers"],
    config: RansacConfig,
) -> Float[np.ndarray, "3 4"]:
    """One step of iteratively reweighted least squares under the Cauchy loss."""
    residual, slope = landmarks.linearized(pose, bearing, rows)
    residual, slope = residual / pixel[:, None], slope / pixel[:, None, None]
    weight = 1 / (1 + np.sum(residual**2, axis=1) / config.scale**2)
    normal = np.einsum("m,mki,mkj->ij", weight, slope, slope, optimize=True)
    gradient = np.einsum("m,mki,mk->i", weight, slope, residual, optimize=True)
    normal[np.diag_indices(6)] *= 1 + _DAMPING
    step = np.linalg.lstsq(normal, -gradient, rcond=None)[0]
    return np.column_stack([_turned(step[:3]) @ pose[:, :3], pose[:, 3] + step[3:]])


def _turned(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation by a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    axis = vector / angle
    skew = np.cross(axis, np.eye(3)).T
    return np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * skew @ skew
