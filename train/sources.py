"""Line clouds for training: every scene many times, at varying density, each time lifted anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from l2p.errors import InputError
from l2p.judging.accuracy import spacing
from l2p.programs.scenes import scenes_of
from l2p.simulator import KINDS
from train.clouds import CloudSource, read
from train.train_config import DataSettings

#: First seed of simulated scenes, far from the small seeds that users try.
FIRST_SIMULATED = 10_000
#: Fraction of liftings with as many lines as allowed; they have most of the lines, since the others are small.
_FULL = 0.2


@dataclass(frozen=True)
class Sources:
    """An endless list of line clouds: the n-th depends only on the seed and n.

    Every scene comes once per turn, in another order each turn. A fifth of the liftings take all points of their scene,
    up to ``max_lines``. The others are thinned such that a random *line*, the unit of training, is in a cloud of
    log-uniform size: clouds of n lines have a frequency in proportion to 1 / n^2.
    """

    scenes: tuple[tuple[str, int], ...]
    data: DataSettings

    @classmethod
    def of(cls, data: DataSettings) -> Sources:
        """Collect the training scenes: the given ones without those held back for validation, and simulated ones."""
        rng = np.random.default_rng([data.seed, 0])
        held_back = set(_sources(data.val))
        scenes = [(scene, _points(scene)) for scene in _sources(data.scenes) if scene not in held_back]
        low, high = data.simulated_points
        for number in range(data.simulated):
            kind, points = KINDS[number % len(KINDS)], _log_uniform(low, high, rng)
            scenes.append((f"sim:{kind}:{points}:{FIRST_SIMULATED + data.seed + number}", points))
        if not scenes:
            raise InputError(f"got {len(held_back)} val scenes, and no others to train on; expected more scenes")
        return cls(tuple(scenes), data)

    def __getitem__(self, number: int) -> CloudSource:
        turn, rank = divmod(number, len(self.scenes))
        order = np.random.default_rng([self.data.seed, 1, turn]).permutation(len(self.scenes))
        scene, points = self.scenes[order[rank]]
        rng = np.random.default_rng([self.data.seed, 2, number])
        lines = most = min(points, self.data.max_lines)
        if rng.random() >= _FULL:
            lines = _thinned(min(self.data.min_lines, most), most, rng)
        return CloudSource(scene, round(lines / points, 6), int(rng.integers(1 << 31)))


def validation_sources(data: DataSettings) -> list[CloudSource]:
    """One lifting of each held-back scene at each fraction, at most ``max_lines`` lines."""
    sources: list[CloudSource] = []
    for scene in _sources(data.val):
        points = _points(scene)
        for fraction in data.val_fractions:
            source = CloudSource(scene, round(min(fraction, data.max_lines / points), 6), 0)
            if source not in sources:
                sources.append(source)
    return sources


def _sources(entries: Sequence[str]) -> list[str]:
    """Sources of the scenes, with absolute paths, so that they do not depend on the working directory."""
    sources = [scene.source for scene in scenes_of(entries, {})]
    return [source if source.startswith("sim:") else str(Path(source).resolve()) for source in sources]


def _points(scene: str) -> int:
    """Number of points of a scene; InputError if it has no extent, so that training fails at the start."""
    points = read(scene).xyz
    try:
        spacing(points)
    except InputError as error:
        raise InputError(f"{scene}: {error}") from error
    return len(points)


def _log_uniform(low: int, high: int, rng: np.random.Generator) -> int:
    """Draw a number with density in proportion to 1 / n."""
    return int(np.exp(rng.uniform(np.log(low), np.log(high))).round())


def _thinned(low: int, high: int, rng: np.random.Generator) -> int:
    """Draw a number with density in proportion to 1 / n^2."""
    return round(1 / rng.uniform(1 / high, 1 / low))
