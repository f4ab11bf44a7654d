"""Compare the confidence of the learned attack with what it gets right, for inputs that are uniform lines and are not.

    python benchmarks/recognition.py ../shared/maps/val/office_lounge --lines 4000

Each map is hidden in several ways, recognised (:mod:`l2p.schemes.recognition`) and attacked. A row says what was
recognised, the share of the recovered points within 1 spacing of a point behind their line, the mean confidence, and
whether the attack states that confidence as a probability. Where it does, the two should differ by at most ``CLOSE``.
Prints a table in Markdown, and the rows that break this rule.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from harness import print_table
from jaxtyping import Float

import l2p
from l2p.judging.accuracy import spacing
from l2p.maps.truth import Hiding, Truth
from l2p.programs.scenes import scene_at

#: Largest difference of share right and mean confidence where a probability is stated.
CLOSE = 0.05
HEADS = ("map", "input", "lines", "recognised as", "right", "mean confidence", "stated")

Points = Float[np.ndarray, "points 3"]


def through(
    points: Points, direction: Points, rng: np.random.Generator, element: np.ndarray | None = None, real: int = -1
) -> Hiding:
    """Hide points in lines along given directions, in random order; the first ``real`` lines have a point.

    With ``element``, ``points`` are one of those on each line, and it is the line of each row of the truth.
    """
    count = len(points)
    order = rng.permutation(count)
    lines = l2p.LineCloud.through(points[order], direction[order])
    rank = np.argsort(order)[: count if real < 0 else real]
    return Hiding(lines, Truth(points[: len(rank)], np.arange(len(rank)), element=rank))


def isotropic(count: int, rng: np.random.Generator) -> Points:
    """Directions of uniform lines."""
    return rng.normal(size=(count, 3))


def uniform(points: Points, rng: np.random.Generator) -> Hiding:
    """A line of random direction through each point."""
    return through(points, isotropic(len(points), rng), rng)


def pairs(points: Points, rng: np.random.Generator) -> Hiding:
    """Lines through pairs of points; of maps that have points twice, without pairs of the same place."""
    both = points[: len(points) // 2 * 2].reshape(-1, 2, 3)
    one, other = both[(both[:, 0] != both[:, 1]).any(axis=1)].swapaxes(0, 1)
    lines = l2p.LineCloud.through(one, other - one)
    element = np.tile(np.arange(len(one)), 2)
    return Hiding(lines, Truth(np.concatenate((one, other)), np.arange(2 * len(one)), element=element))


def rays(points: Points, rng: np.random.Generator) -> Hiding:
    """Lines to one of two centres, the means of the halves of the map along its longest axis."""
    along = (points - points.mean(axis=0)) @ np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    centers = np.stack([points[along < np.median(along)].mean(axis=0), points[along >= np.median(along)].mean(axis=0)])
    return through(points, points - centers[rng.integers(0, 2, len(points))], rng)


def sphere(points: Points, rng: np.random.Generator) -> Hiding:
    """Lines to the mean of the points."""
    return through(points, points - points.mean(axis=0), rng)


def parallel(points: Points, rng: np.random.Generator) -> Hiding:
    """Parallel lines."""
    return through(points, np.tile(isotropic(1, rng), (len(points), 1)), rng)


def axes(points: Points, rng: np.random.Generator) -> Hiding:
    """Lines along one of three axes."""
    return through(points, np.eye(3)[rng.integers(0, 3, len(points))], rng)


def flattened(points: Points, rng: np.random.Generator) -> Hiding:
    """Random directions, most of them nearly horizontal."""
    return through(points, isotropic(len(points), rng) * [1, 1, 0.3], rng)


def half_fake(points: Points, rng: np.random.Generator) -> Hiding:
    """Uniform lines, half of them through random places in the box of the map."""
    real = len(points) // 2
    box = rng.uniform(points.min(axis=0), points.max(axis=0), points[real:].shape)
    return through(np.concatenate((points[:real], box)), isotropic(len(points), rng), rng, real=real)


def half_same(points: Points, rng: np.random.Generator) -> Hiding:
    """Uniform lines, half of them one and the same."""
    direction = isotropic(len(points), rng)
    half = len(points) // 2
    direction[half:] = direction[half]
    return through(np.concatenate((points[:half], np.tile(points[half], (len(points) - half, 1)))), direction, rng)


def twice(points: Points, rng: np.random.Generator) -> Hiding:
    """Two releases of half of the points, with new directions, in one file."""
    half = points[: len(points) // 2]
    both = np.concatenate((half, half))
    return through(both, isotropic(len(both), rng), rng)


#: Ways to hide, by the name in the table.
INPUTS: dict[str, Callable[[Points, np.random.Generator], Hiding]] = {
    "uniform lines": uniform,
    "pairs of points": pairs,
    "rays of two centres": rays,
    "one centre": sphere,
    "parallel": parallel,
    "three axes": axes,
    "flattened directions": flattened,
    "half of the lines fake": half_fake,
    "half the same line": half_same,
    "two releases in one file": twice,
}


def nearest_error(recovery: l2p.Recovery, truth: Truth) -> Float[np.ndarray, " rows"]:
    """Distance of each recovered point from the nearest true point of its line; infinite on a fake."""
    error = np.full(len(recovery), np.inf)
    row = np.full(int(recovery.element.max()) + 1, -1)
    row[recovery.element] = np.arange(len(recovery))
    apart = np.linalg.norm(recovery.xyz[row[truth.element]] - truth.xyz, axis=1)
    np.minimum.at(error, row[truth.element], apart)
    return error


def attacked(path: str, most: int, inputs: Sequence[str], broken: list[str]) -> Iterator[Sequence[str]]:
    """Hide a map in each way and attack it; yield the rows of the table, and collect those that break the rule."""
    points, name = scene_at(path).xyz, Path(path).name
    scale = spacing(points)
    for way in inputs:
        rng = np.random.default_rng(0)
        hidden = INPUTS[way](rng.permutation(points)[:most], rng)
        recovery = l2p.recover(hidden.map)
        right = float((nearest_error(recovery, hidden.truth) <= scale).mean())
        claimed = float(recovery.confidence.mean(dtype=np.float64))
        stated = "yes" if recovery.calibrated else "no"
        kind = recovery.info["recognised"]["kind"]
        if recovery.calibrated and abs(right - claimed) > CLOSE:
            broken.append(f"{name}, {way}: {right:.3f} right, {claimed:.3f} stated")
        yield name, way, f"{len(hidden.map):,}", kind, f"{right:.2f}", f"{claimed:.2f}", stated


def main() -> None:
    """Hide each map in each way, attack it, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", help="maps, of which a random subset is hidden")
    parser.add_argument("--lines", type=int, default=4000, help="most points of a map to hide (default: 4000)")
    parser.add_argument("--inputs", nargs="+", choices=INPUTS, default=list(INPUTS), help="default: all")
    given = parser.parse_args()
    broken: list[str] = []
    rows = (row for path in given.maps for row in attacked(path, given.lines, given.inputs, broken))
    print_table(f"share right and mean confidence, {len(given.maps)} maps", HEADS, rows)
    print("\n".join([f"stated, and more than {CLOSE} off: {len(broken)}", *broken]))


if __name__ == "__main__":
    main()
