"""What the cameras make of the world: which keypoints are seen and matched, and in how many images.

The steps are those of an SfM program: a keypoint is detected in a reference image (so texture counts by its area in
the image, not in the world), matched in images that see it from a similar direction and distance, unless it is
hidden there, and kept if at least two images agree. Some matches are wrong and still agree; they become floaters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.simulator.cameras import Cameras
from l2p.simulator.occlusion import hidden
from l2p.simulator.surfaces import LEAVES, Shapes, Stage
from l2p.simulator.texture import Structures, draw_keypoints

#: Cosine to the normal below which a surface is too slanted for its keypoints to be found.
GRAZING = np.float32(0.08)
#: Change of the logarithm of the distance at which a match has lost 40 % of its probability.
MATCH_SCALE = 0.4


@dataclass(frozen=True)
class Capture:
    """How well the images match; varies between scenes as it does between captures.

    Attributes
    ----------
    pixel_noise : float
        Median localisation noise of a keypoint, in pixels.
    match_angle : float
        Change of viewing direction (radians) at which a match has lost 1/e of its probability.
    repeatability : float
        Mean probability to find a keypoint again in an image that sees it well.
    wrong_matches : float
        Share of candidates whose match is wrong although it agrees with the geometry of two images.
    """

    pixel_noise: float
    match_angle: float
    repeatability: float
    wrong_matches: float


@dataclass(frozen=True)
class Sightings:
    """Keypoints that at least two cameras see, and who sees them; ``point`` is sorted.

    Attributes
    ----------
    xyz : (points, 3) float64
        True positions.
    wrong : (points,) bool
        Whether the match is wrong, so that no surface is at ``xyz``.
    rgb : (points, 3) float64
    solid : (points,) int
        Row of the body that carries the keypoint, or -1.
    point, camera : (views,) int
        Row of the point and of the camera of each observation.
    """

    xyz: Float[np.ndarray, "points 3"]
    wrong: Bool[np.ndarray, " points"]
    rgb: Float[np.ndarray, "points 3"]
    solid: Int[np.ndarray, " points"]
    point: Int[np.ndarray, " views"]
    camera: Int[np.ndarray, " views"]

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True)
class Candidates:
    """Keypoints of the world, not yet observed.

    ``normal`` has any length; ``flat`` says that the keypoint lies on a surface and is seen from its front only.
    """

    xyz: Float[np.ndarray, "points 3"]
    normal: Float[np.ndarray, "points 3"]
    flat: Bool[np.ndarray, " points"]
    wrong: Bool[np.ndarray, " points"]
    solid: Int[np.ndarray, " points"]
    reference: Int[np.ndarray, " points"]

    def __len__(self) -> int:
        return len(self.xyz)


class Observer:
    """Draws keypoints of a textured stage as its cameras would find them."""

    def __init__(self, stage: Stage, structures: Structures, cameras: Cameras, capture: Capture) -> None:
        self.surfaces, self.solids = stage.surfaces, stage.solids
        self.relief = np.array([texture.relief for texture in stage.textures])
        self.structures, self.cameras, self.capture = structures, cameras, capture
        resolution = _resolution(structures, self.surfaces, self.relief, cameras)
        self._reference = np.cumsum(resolution, axis=1, dtype=np.float32)
        # The rate of a structure is its texture times the image area it covers in the images that show it best.
        best = (resolution**2).sum(axis=1) / np.maximum(resolution.sum(axis=1), 1e-30)
        self._rate = np.cumsum(structures.weight * best[structures.spot])

    def sight(self, count: int, rng: np.random.Generator) -> Sightings:
        """Draw ``count`` keypoints and keep those that at least two cameras see."""
        pick = np.searchsorted(self._rate, rng.random(count) * self._rate[-1], side="right")
        pick = np.minimum(pick, len(self._rate) - 1)
        xyz, normal, inside = draw_keypoints(self.structures, pick, self.surfaces, self.relief, rng)
        candidates = self._candidates(pick[inside], xyz[inside], normal[inside], rng)
        point, camera = self._visible(candidates, self._found(candidates, rng))
        rgb = self.structures.rgb[pick[inside]] + 18 * rng.standard_normal(candidates.xyz.shape)
        return select(Sightings(candidates.xyz, candidates.wrong, rgb, candidates.solid, point, camera))

    def _candidates(
        self,
        pick: Int[np.ndarray, " points"],
        xyz: Float[np.ndarray, "points 3"],
        normal: Float[np.ndarray, "points 3"],
        rng: np.random.Generator,
    ) -> Candidates:
        """Give each keypoint a reference image; move wrong matches along the reference ray.

        The epipolar line cannot tell a wrong match from a right one there.
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

    def _found(self, candidates: Candidates, rng: np.random.Generator) -> Bool[np.ndarray, "points cameras"]:
        """Which cameras would match each keypoint with its reference, hidden or not."""
        xyz, reference, capture = candidates.xyz, candidates.reference, self.capture
        rows = np.arange(len(xyz))
        distance, seen = _views(xyz, self.cameras)
        cosine = _cosine(xyz, self.cameras.center[reference] - xyz, distance, self.cameras)
        ratio = np.log(distance / distance[rows, reference][:, None])
        chance = np.exp((cosine - 1) * (2 / capture.match_angle**2) - ratio**2 * (0.5 / MATCH_SCALE**2))
        a = 1.5 * capture.repeatability / (1 - capture.repeatability)
        chance *= rng.beta(a, 1.5, (len(xyz), 1)).astype(np.float32)
        chance[rows, reference] = 1.0
        facing = _cosine(xyz, candidates.normal, distance, self.cameras)
        chance *= np.where(candidates.flat[:, None], np.clip(3 * (facing - GRAZING), 0, 1), 1)
        return seen & (rng.random(chance.shape, dtype=np.float32) < chance)

    def _visible(
        self, candidates: Candidates, found: Bool[np.ndarray, "points cameras"]
    ) -> tuple[Int[np.ndarray, " views"], Int[np.ndarray, " views"]]:
        """Observations that nothing hides, of points that their reference sees; wrong matches are in two images."""
        xyz, wrong = candidates.xyz, candidates.wrong
        point, camera = np.nonzero(found)
        right = ~wrong[point]
        cut = np.zeros(len(point), dtype=bool)
        cut[right] = hidden(
            self.cameras.center, camera[right], xyz[point[right]], candidates.solid[point[right]], self.solids
        )
        point, camera = point[~cut], camera[~cut]
        other = camera != candidates.reference[point]
        known = np.zeros(len(xyz), dtype=bool)
        known[point[~other]] = True
        # Observations other than the reference, counted from the first of each point.
        before = np.concatenate([[0], np.cumsum(other)])
        rank = before[:-1] - before[np.searchsorted(point, point)]
        keep = known[point] & (~other | ~wrong[point] | (rank == 0))
        return point[keep], camera[keep]


def select(sightings: Sightings, keep: Bool[np.ndarray, " points"] | None = None) -> Sightings:
    """The points that at least two images see (and that ``keep`` marks), renumbered."""
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
    """Distance to every camera (points, cameras), and whether the point is in its image."""
    offset = np.einsum("cij,cj->ci", cameras.rotation, cameras.center)
    point = xyz.astype(np.float32)
    x, y, z = (point @ cameras.rotation[:, i].T.astype(np.float32) - offset[:, i].astype(np.float32) for i in range(3))
    reach_x, reach_y = 0.5 * cameras.width / cameras.focal, 0.5 * cameras.height / cameras.focal
    seen = (z > np.float32(0.05)) & (np.abs(x) < np.float32(reach_x) * z) & (np.abs(y) < np.float32(reach_y) * z)
    return np.sqrt(x * x + y * y + z * z) + np.float32(1e-3), seen


def _cosine(xyz: np.ndarray, vector: np.ndarray, distance: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Cosine between each point's ``vector`` and its directions to every camera (points, cameras)."""
    vector = vector / np.linalg.norm(vector, axis=1, keepdims=True)
    here = np.einsum("ni,ni->n", vector, xyz).astype(np.float32)
    return (vector.astype(np.float32) @ cameras.center.T.astype(np.float32) - here[:, None]) / distance


def _resolution(structures: Structures, shapes: Shapes, relief: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Pixels per square metre of each spot in each image (spots, cameras), occlusion aside."""
    still = np.random.default_rng(0)
    first = np.searchsorted(structures.spot, np.arange(structures.spot[-1] + 1))
    xyz, normal, _ = draw_keypoints(structures, first, shapes, 0 * relief, still)
    distance, seen = _views(xyz, cameras)
    facing = _cosine(xyz, normal, distance, cameras)
    facing[shapes.shape[structures.surface[first]] == LEAVES] = 1.0
    return np.where(seen & (facing > GRAZING), facing * (np.float32(cameras.focal) / distance) ** 2, 0) + np.float32(
        1e-6
    )
