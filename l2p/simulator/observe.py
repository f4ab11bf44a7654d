"""Observations: the keypoints that cameras detect, and the images in which they are matched.

The steps are those of an SfM program: a keypoint is detected in a reference image (so texture counts by its area in
the image, not in the world), matched in images that see it from a similar direction and distance, unless it is
occluded there, and kept if at least two images match. Some wrong matches pass, too; they become floaters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.maps.short_repr import short_repr
from l2p.simulator.cameras import Cameras
from l2p.simulator.occlusion import hidden
from l2p.simulator.surfaces import LEAVES, Shapes, Stage
from l2p.simulator.texture import Structures, draw_keypoints

#: Cosine between the viewing direction and the normal below which keypoints of a surface are not detected.
GRAZING = np.float32(0.08)
#: Change of the logarithm of the distance at which the probability of a match falls to 60 %.
MATCH_SCALE = 0.4


@dataclass(frozen=True)
class Capture:
    """Quality of the matches; varies between scenes, as it does between real captures.

    Attributes
    ----------
    pixel_noise : float
        Median localisation noise of a keypoint, in pixels.
    match_angle : float
        Change of viewing direction (radians) at which the probability of a match falls to 1/e.
    repeatability : float
        Mean probability that a keypoint is detected again in an image that sees it well.
    wrong_matches : float
        Share of candidates with a wrong match that satisfies the epipolar geometry of two images.
    """

    pixel_noise: float
    match_angle: float
    repeatability: float
    wrong_matches: float


@dataclass(frozen=True)
class Sightings:
    """Keypoints that at least two cameras see, and their observations; ``point`` is sorted.

    Attributes
    ----------
    xyz : (points, 3) float64
        True positions, in metres.
    wrong : (points,) bool
        Whether the match is wrong, so that no surface is at ``xyz``.
    rgb : (points, 3) float64
        About 0 to 255, not clipped.
    solid : (points,) int
        Row of the solid that carries the keypoint, or -1.
    point, camera : (views,) int
        Row of the point and of the camera of each observation.
    """

    xyz: Float[np.ndarray, "points 3"]
    wrong: Bool[np.ndarray, " points"]
    rgb: Float[np.ndarray, "points 3"]
    solid: Int[np.ndarray, " points"]
    point: Int[np.ndarray, " views"]
    camera: Int[np.ndarray, " views"]

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True)
class Candidates:
    """Keypoints of the world, not yet observed.

    ``normal`` has any length; ``flat`` keypoints lie on a surface and are seen from its front only; ``reference`` is
    the row of the camera that detects the keypoint.
    """

    xyz: Float[np.ndarray, "points 3"]
    normal: Float[np.ndarray, "points 3"]
    flat: Bool[np.ndarray, " points"]
    wrong: Bool[np.ndarray, " points"]
    solid: Int[np.ndarray, " points"]
    reference: Int[np.ndarray, " points"]

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.xyz)


class Observer:
    """Draws keypoints of a textured stage, and their observations by its cameras."""

    def __init__(self, stage: Stage, structures: Structures, cameras: Cameras, capture: Capture) -> None:
        self.surfaces, self.solids = stage.surfaces, stage.solids
        self.relief = np.array([texture.relief for texture in stage.textures])
        self.structures, self.cameras, self.capture = structures, cameras, capture
        resolution = _resolution(structures, self.surfaces, self.relief, cameras)
        self._reference = np.cumsum(resolution, axis=1, dtype=np.float32)
        # The rate of a structure is its weight times the image area that it covers in the images that show it best.
        best = (resolution**2).sum(axis=1) / np.maximum(resolution.sum(axis=1), 1e-30)
        self._rate = np.cumsum(structures.weight * best[structures.spot])

    def sight(self, count: int, rng: np.random.Generator) -> Sightings:
        """Draw ``count`` keypoints and keep those that at least two cameras see."""
        pick = np.searchsorted(self._rate, rng.random(count) * self._rate[-1], side="right")
        pick = np.minimum(pick, len(self._rate) - 1)
        xyz, normal, inside = draw_keypoints(self.structures, pick, self.surfaces, self.relief, rng)
        candidates = self._candidates(pick[inside], xyz[inside], normal[inside], rng)
        point, camera = self._visible(candidates, self._matched(candidates, rng))
        rgb = self.structures.rgb[pick[inside]] + 18 * rng.standard_normal(candidates.xyz.shape)
        return select(Sightings(candidates.xyz, candidates.wrong, rgb, candidates.solid, point, camera))

    def _candidates(
        self,
        pick: Int[np.ndarray, " points"],
        xyz: Float[np.ndarray, "points 3"],
        normal: Float[np.ndarray, "points 3"],
        rng: np.random.Generator,
    ) -> Candidates:
        """Draw the reference image of each keypoint; move wrong matches along the ray of the reference.

        Moved along that ray, they still satisfy the epipolar constraint.
        """
        total = self._reference[self.structures.spot[pick]]
        reference = (total > rng.random((len(pick), 1), dtype=np.float32) * total[:, -1:]).argmax(axis=1)
        wrong = rng.random(len(pick)) < self.capture.wrong_matches
        center = self.cameras.center[reference]
        stretch = np.where(wrong, np.exp(0.6 * rng.standard_normal(len(xyz))), 1.0)[:, None]
        surface = self.structures.surface[pick]
        return Candidates(
            xyz=center + stretch * (xyz - center),
            normal=np.where(wrong[:, None], center - xyz, normal),
            flat=(self.surfaces.shape[surface] != LEAVES) & ~wrong,
            wrong=wrong,
            solid=self.surfaces.solid[surface],
            reference=reference,
        )

    def _matched(self, candidates: Candidates, rng: np.random.Generator) -> Bool[np.ndarray, "points cameras"]:
        """Whether each camera matches the keypoint with its reference image; occlusion is ignored."""
        xyz, reference, capture = candidates.xyz, candidates.reference, self.capture
        rows = np.arange(len(xyz))
        distance, seen = _views(xyz, self.cameras)
        cosine = _cosine(xyz, self.cameras.center[reference] - xyz, distance, self.cameras)
        ratio = np.log(distance / distance[rows, reference][:, None])
        chance = np.exp((cosine - 1) * (2 / capture.match_angle**2) - ratio**2 * (0.5 / MATCH_SCALE**2))
        # A beta distribution with mean ``repeatability``.
        a = 1.5 * capture.repeatability / (1 - capture.repeatability)
        chance *= rng.beta(a, 1.5, (len(xyz), 1)).astype(np.float32)
        chance[rows, reference] = 1.0
        facing = _cosine(xyz, candidates.normal, distance, self.cameras)
        chance *= np.where(candidates.flat[:, None], np.clip(3 * (facing - GRAZING), 0, 1), 1)
        return seen & (rng.random(chance.shape, dtype=np.float32) < chance)

    def _visible(
        self, candidates: Candidates, matched: Bool[np.ndarray, "points cameras"]
    ) -> tuple[Int[np.ndarray, " views"], Int[np.ndarray, " views"]]:
        """Points and cameras of the unoccluded observations; the reference must see the point.

        Wrong matches keep two observations: the reference and the first other one.
        """
        xyz, wrong = candidates.xyz, candidates.wrong
        point, camera = np.nonzero(matched)
        right = ~wrong[point]
        occluded = np.zeros(len(point), dtype=bool)
        occluded[right] = hidden(
            self.cameras.center, camera[right], xyz[point[right]], candidates.solid[point[right]], self.solids
        )
        point, camera = point[~occluded], camera[~occluded]
        other = camera != candidates.reference[point]
        detected = np.zeros(len(xyz), dtype=bool)
        detected[point[~other]] = True
        # Number of each observation other than the reference among those of its point, from 0.
        before = np.concatenate([[0], np.cumsum(other)])
        rank = before[:-1] - before[np.searchsorted(point, point)]
        keep = detected[point] & (~other | ~wrong[point] | (rank == 0))
        return point[keep], camera[keep]


def select(sightings: Sightings, keep: Bool[np.ndarray, " points"] | None = None) -> Sightings:
    """Select the points that at least two images see (and that ``keep`` marks), and renumber them."""
    kept = np.bincount(sightings.point, minlength=len(sightings)) >= 2
    if keep is not None:
        kept &= keep
    row = np.cumsum(kept) - 1
    views = kept[sightings.point]
    return Sightings(
        sightings.xyz[kept],
        sightings.wrong[kept],
        sightings.rgb[kept],
        sightings.solid[kept],
        row[sightings.point[views]],
        sightings.camera[views],
    )


def _views(xyz: np.ndarray, cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Distance to every camera, and whether the point is in its image; both (points, cameras)."""
    offset = np.einsum("cij,cj->ci", cameras.rotation, cameras.center)
    point = xyz.astype(np.float32)
    x, y, z = (point @ cameras.rotation[:, i].T.astype(np.float32) - offset[:, i].astype(np.float32) for i in range(3))
    reach_x, reach_y = 0.5 * cameras.width / cameras.focal, 0.5 * cameras.height / cameras.focal
    seen = (z > np.float32(0.05)) & (np.abs(x) < np.float32(reach_x) * z) & (np.abs(y) < np.float32(reach_y) * z)
    return np.sqrt(x * x + y * y + z * z) + np.float32(1e-3), seen


def _cosine(xyz: np.ndarray, vector: np.ndarray, distance: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Cosine between each point's ``vector`` and its directions to every camera (points, cameras)."""
    vector = vector / np.linalg.norm(vector, axis=1, keepdims=True)
    offset = np.einsum("ni,ni->n", vector, xyz).astype(np.float32)
    return (vector.astype(np.float32) @ cameras.center.T.astype(np.float32) - offset[:, None]) / distance


def _resolution(structures: Structures, shapes: Shapes, relief: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Pixels per square metre of each spot in each image (spots, cameras); occlusion is ignored."""
    rng = np.random.default_rng(0)
    first = np.searchsorted(structures.spot, np.arange(structures.spot[-1] + 1))
    xyz, normal, _ = draw_keypoints(structures, first, shapes, 0 * relief, rng)
    distance, seen = _views(xyz, cameras)
    facing = _cosine(xyz, normal, distance, cameras)
    facing[shapes.shape[structures.surface[first]] == LEAVES] = 1.0
    return np.where(seen & (facing > GRAZING), facing * (np.float32(cameras.focal) / distance) ** 2, 0) + np.float32(
        1e-6
    )
