"""Which line clouds are trained on: every scene is lifted several times, thinly and densely."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eval.scenes import scenes_of
from l2p.simulator import KINDS
from train.clouds import CloudSource, read
from train.config import DataSettings

#: Simulated scenes are numbered from here on, away from the small seeds that people try.
FIRST_SIMULATED = 10_000


def training_sources(data: DataSettings) -> list[CloudSource]:
    """Liftings of all training scenes, each with its own seed and number of lines (log-uniform).

    The first lifting of a scene takes as many lines as ``max_lines`` allows. With ``total_lines``, clouds are drawn
    until no further one fits: every round has to run on all of them before the next one is trained.
    """
    rng = np.random.default_rng([data.seed, 0])
    scenes = [(scene, len(read(scene).xyz)) for scene in _found(data.scenes)]
    low, high = data.simulated_points
    for number in range(data.simulated):
        kind, points = KINDS[number % len(KINDS)], _log_uniform(low, high, rng)
        scenes.append((f"sim:{kind}:{points}:{FIRST_SIMULATED + data.seed + number}", points))
    sources: list[tuple[CloudSource, int]] = []
    for number, (scene, points) in enumerate(scenes):
        most = min(points, data.max_lines)
        for lifting in range(data.liftings):
            lines = most if lifting == 0 else _log_uniform(min(data.min_lines, most), most, rng)
            sources.append((CloudSource(scene, round(lines / points, 6), 1000 * lifting + number), lines))
    return _drawn(sources, data.total_lines, rng)


def validation_sources(data: DataSettings) -> list[CloudSource]:
    """One lifting of each held-back scene at each fraction, never more than ``max_lines``."""
    sources: list[CloudSource] = []
    for scene in _found(data.val):
        points = len(read(scene).xyz)
        for fraction in data.val_fractions:
            source = CloudSource(scene, round(min(fraction, data.max_lines / points), 6), 0)
            if source not in sources:
                sources.append(source)
    return sources


def _drawn(sources: list[tuple[CloudSource, int]], total: int | None, rng: np.random.Generator) -> list[CloudSource]:
    """As many of the clouds, in random order, as the total of lines allows."""
    if total is None:
        return [source for source, _ in sources]
    drawn, left = [], total
    for place in rng.permutation(len(sources)):
        source, lines = sources[place]
        if lines <= left:
            drawn.append(source)
            left -= lines
    return drawn


def _found(entries: tuple[str, ...]) -> list[str]:
    """Scenes by the names of the cache, which do not depend on where the program is started."""
    sources = [scene.source for scene in scenes_of(entries, {})]
    return [source if source.startswith("sim:") else str(Path(source).resolve()) for source in sources]


def _log_uniform(low: int, high: int, rng: np.random.Generator) -> int:
    return int(np.exp(rng.uniform(np.log(low), np.log(high))).round())
