"""What tests of localization share: a camera that sees points, and COLMAP models of simulated rooms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import l2p
from l2p.simulator import simulate_model
from l2p.utility.landmarks import Landmarks, LineLandmarks, PointLandmarks
from l2p.utility.queries import Pose

#: Radians in a pixel of the cameras here.
PIXEL = 1e-3


@dataclass(frozen=True, eq=False)
class View:
    """A camera, the points before it, the lines that hide them, and its bearings towards them."""

    xyz: np.ndarray
    lines: l2p.LineCloud
    pose: Pose
    bearing: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        return np.arange(len(self.xyz))

    @property
    def pixel(self) -> np.ndarray:
        return np.full(len(self.xyz), PIXEL)

    def landmarks(self, kind: str) -> Landmarks:
        return LineLandmarks(self.lines) if kind == "lines" else PointLandmarks(self.xyz)

    def error(self, pose: Pose) -> float:
        """Largest difference of a pose from the true one, in its rotation and its centre (in units of the scene)."""
        return max(np.abs(pose.rotation - self.pose.rotation).max(), np.abs(pose.center - self.pose.center).max())


@pytest.fixture
def view() -> Callable[..., View]:
    """Make a view of random points around (1, -2, 3), some units before the camera."""

    def make(seed: int = 0, count: int = 80, noise: float = 0.0) -> View:
        rng = np.random.default_rng(seed)
        rotation = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
        local = rng.uniform((-2, -2, 3), (2, 2, 8), size=(count, 3))
        center = np.array([1.0, -2.0, 3.0]) - rotation.T @ [0, 0, 5.5]
        pose = Pose(rotation, -rotation @ center)
        xyz = (local - pose.translation) @ rotation
        direction = rng.normal(size=(count, 3))
        bearing = local / np.linalg.norm(local, axis=1, keepdims=True)
        bearing += noise * PIXEL * rng.normal(size=bearing.shape)
        lines = l2p.LineCloud.through(xyz, direction / np.linalg.norm(direction, axis=1, keepdims=True))
        return View(xyz, lines, pose, bearing / np.linalg.norm(bearing, axis=1, keepdims=True))

    return make


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The COLMAP model of a simulated room."""
    path = tmp_path_factory.mktemp("room") / "model"
    simulate_model("room", 1500, seed=2).save_colmap(path)
    return path
