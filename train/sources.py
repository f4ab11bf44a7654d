"""Line clouds for training: every scene many times, at varying density, each time lifted anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

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
#: Share of the clouds with single observations of descriptors.
_OBSERVED = 0.5
#: Share of the clouds with descriptors whose kind is hidden, so that the attack must teach itself.
_UNKNOWN = 0.25


class TrainingScene(NamedTuple):
    """A scene to train on: its source, number of points, and attributes; ``turn`` is 0, or more if it comes again."""

    source: str
    points: int
    names: tuple[str, ...] = ()
    turn: int = 0


@dataclass(frozen=True)
class Sources:
    """An endless list of line clouds: the n-th depends only on the seed and n.

    Every scene comes once per turn, in another order each turn. A fifth of the liftings take all points of their scene,
    up to ``max_lines``. The others are thinned such that a random *line*, the unit of training, is in a cloud of
    log-uniform size: clouds of n lines have a frequency in proportion to 1 / n^2. Each attribute of a scene is left out
    with the chance ``absent``; half of the clouds with descriptors have single observations, not means over tracks;
    a quarter hides the kind of its descriptors.
    """

    scenes: tuple[TrainingScene, ...]
    data: DataSettings

    @classmethod
    def of(cls, data: DataSettings) -> Sources:
        """Collect the training scenes: the given ones without those held back for validation, and simulated ones."""
        rng = np.random.default_rng([data.seed, 0])
        held_back = {*_sources(data.val), *_sources(data.val_maps)}
        scenes = [_scene(scene) for scene in _sources(data.scenes) if scene not in held_back]
        maps = [_scene(scene) for scene in _sources(data.maps) if scene not in held_back]
        scenes += [one._replace(turn=turn) for turn in range(data.map_turns) for one in maps]
        low, high = data.simulated_points
        for number in range(data.simulated):
            kind, points = KINDS[number % len(KINDS)], _log_uniform(low, high, rng)
            # The colours of the simulator have no texture that neighbours share, so that nothing is learned from them.
            scenes.append(TrainingScene(f"sim:{kind}:{points}:{FIRST_SIMULATED + data.seed + number}", points))
        if not scenes:
            raise InputError(f"got {len(held_back)} val scenes, and no others to train on; expected more scenes")
        return cls(tuple(scenes), data)

    def __getitem__(self, number: int) -> CloudSource:
        turn, rank = divmod(number, len(self.scenes))
        order = np.random.default_rng([self.data.seed, 1, turn]).permutation(len(self.scenes))
        scene, points, names, _ = self.scenes[order[rank]]
        rng = np.random.default_rng([self.data.seed, 2, number])
        lines = most = min(points, self.data.max_lines)
        if rng.random() >= _FULL:
            lines = _thinned(min(self.data.min_lines, most), most, rng)
        seed = int(rng.integers(1 << 31))
        known = tuple(name for name in names if rng.random() >= self.data.absent)
        observed, unknown = bool(rng.random() < _OBSERVED), bool(rng.random() < _UNKNOWN)
        return CloudSource(scene, round(lines / points, 6), seed, known, observed, unknown, self.data.scheme)


def validation_sources(data: DataSettings) -> list[CloudSource]:
    """One lifting of each held-back scene at each fraction, at most ``max_lines`` lines, for each subset of its
    attributes."""
    sources: list[CloudSource] = []
    for scene in [*_sources(data.val), *_sources(data.val_maps)]:
        one = _scene(scene)
        for fraction in data.val_fractions:
            share = round(min(fraction, data.max_lines / one.points), 6)
            for known in _subsets(one.names):
                for unknown in (False, True) if "descriptor" in known else (False,):
                    source = CloudSource(scene, share, 0, known, unknown=unknown, scheme=data.scheme)
                    if source not in sources:
                        sources.append(source)
    return sources


def _subsets(names: Sequence[str]) -> list[tuple[str, ...]]:
    return [some for size in range(len(names) + 1) for some in combinations(names, size)]


def _sources(entries: Sequence[str]) -> list[str]:
    """Sources of the scenes, with absolute paths, so that they do not depend on the working directory."""
    sources = [scene.source for scene in scenes_of(entries, {})]
    return [source if source.startswith("sim:") else str(Path(source).resolve()) for source in sources]


def _scene(source: str) -> TrainingScene:
    """Read a scene; InputError if it has no extent, so that training fails at the start."""
    scene = read(source)
    try:
        spacing(scene.xyz)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    names = () if source.startswith("sim:") else scene.appearance.names
    return TrainingScene(source, len(scene), names)


def _log_uniform(low: int, high: int, rng: np.random.Generator) -> int:
    """Draw a number with density in proportion to 1 / n."""
    return int(np.exp(rng.uniform(np.log(low), np.log(high))).round())


def _thinned(low: int, high: int, rng: np.random.Generator) -> int:
    """Draw a number with density in proportion to 1 / n^2."""
    return round(1 / rng.uniform(1 / high, 1 / low))
