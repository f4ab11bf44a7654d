"""Fixtures of all tests. Types and shapes of l2p are checked by the jaxtyping hook set in pyproject.toml."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

# Small problems are faster on one thread; read when torch loads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Programs that run for minutes or hours; no test, and no doctest, is in them.
collect_ignore = ["stress"]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real scenes beside the project; tests that need it are skipped if it is absent."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip(f"needs the real scenes of {folder}, which is absent here")
    return folder


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint file with random weights, two rounds, and facts as the training writes them."""
    import torch

    from l2p.attacks.learned.checkpoint import Checkpoint, save
    from l2p.attacks.learned.learned_config import LearnedConfig
    from l2p.attacks.learned.network import LineTransformer, NetworkConfig

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = LineTransformer(NetworkConfig(width=8, layers=1, heads=2))
    result = {"scene": "[b]ell", "fraction": 0.05, "lines": 700, "median": [0.4125, 0.3312], "within": [0.58, 0.664]}
    facts = {
        "commit": "0123abcd",
        "seed": 11,
        "steps": 1234,
        "minutes": 56.7,
        "scenes": ["church", "wood", "cup"],
        "results": [{**result, "confident_half": 0.895, "calibration_error": 0.0213}],
    }
    path = tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors"
    calibration = {"lines": [[(1.0, 0.0)] * len(NetworkConfig.radii)] * 2}
    save(path, Checkpoint(network, LearnedConfig(rounds=2, candidates=16), calibration, facts))
    return path


@pytest.fixture
def rng() -> np.random.Generator:
    """A fresh generator for each test."""
    return np.random.default_rng(0)


class Counter:
    """Progress that is not shown; counts the steps of its task."""

    def __init__(self) -> None:
        self.done = self.total = 0

    def task(self, name: str, total: int) -> AbstractContextManager[Callable[[int], None]]:
        self.total = total
        return nullcontext(self.add)

    def add(self, count: int) -> None:
        self.done += count


@pytest.fixture
def counter() -> Counter:
    return Counter()


@pytest.fixture(scope="session")
def on_walls() -> Callable[[int], np.ndarray]:
    """A function that makes ``count`` points on the walls of a room, (count, 3)."""

    def make(count: int) -> np.ndarray:
        rng = np.random.default_rng(0)
        points = rng.uniform(-1, 1, size=(count, 3))
        points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1.0, 1.0], count)
        return points * [3, 2, 1.2]

    return make


@pytest.fixture(scope="session")
def scene_points() -> np.ndarray:
    """400 points on the surface of three boxes on a floor, (400, 3): clustered and planar, as SfM clouds are."""
    rng = np.random.default_rng(7)
    floor = rng.uniform((-2, -2, 0), (2, 2, 0), size=(100, 3))
    corners = np.array([(-1.5, -1.0, 0.0), (0.3, -0.5, 0.0), (-0.5, 0.8, 0.0)])
    points = np.concatenate([floor, *(corner + _box_surface(100, rng) for corner in corners)])
    # Triangulation noise, so that no coordinate repeats.
    points = points + rng.normal(scale=0.004, size=points.shape)
    points.setflags(write=False)
    return points


def _box_surface(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points on the surface of a box of 0.8 x 0.5 x 0.6 with a corner at the origin."""
    points = rng.uniform(size=(count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.integers(0, 2, count)
    return points * (0.8, 0.5, 0.6)
