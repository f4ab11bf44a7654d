"""Measure how much an attack depends on frame, scale, order and direction of the lines: it should not.

    python benchmarks/invariance.py ../shared/scenes/val/room_chair.npz

Each scene is lifted once. Its line cloud is attacked unchanged and after every change; the points are transformed back.
Prints, for each change, the share of points within 0.1 spacing of the unchanged run's, that share among the more
confident half of the lines, and the ratios of the median errors and of the shares within 1 spacing: docs/experiments.md
has them. The last change, rounding to single precision, gives other lines and serves as a comparison.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from harness import hidden, print_table

import l2p
from l2p.attacks.settings import METHODS
from l2p.judging.accuracy import errors, spacing
from l2p.maps.lines import LineCloud
from l2p.work.progress import terminal_progress

HEADS = ("scene", "change", "within 0.1 spacing", "of the confident half", "median, ratio", "within 1, ratio")


class Change(NamedTuple):
    """Changed line cloud, and the transformation of its points back."""

    lines: LineCloud
    back: Callable[[np.ndarray], np.ndarray]


def flipped(lines: LineCloud, rng: np.random.Generator) -> Change:
    """Reverse half of the directions."""
    sign = rng.choice([-1.0, 1.0], size=(len(lines), 1))
    return Change(LineCloud(sign * lines.direction, sign * lines.moment), lambda xyz: xyz)


def shuffled(lines: LineCloud, rng: np.random.Generator) -> Change:
    """Put the lines in another order."""
    order = rng.permutation(len(lines))
    return Change(LineCloud(lines.direction[order], lines.moment[order]), lambda xyz: xyz[np.argsort(order)])


def scaled(lines: LineCloud, rng: np.random.Generator) -> Change:
    """Change the unit, and shift the lines far from the origin."""
    shift = 1e3 * rng.normal(size=3)
    moved = LineCloud.through(1000.0 * lines.origin + shift, lines.direction)
    return Change(moved, lambda xyz: (xyz - shift) / 1000.0)


def turned(lines: LineCloud, rng: np.random.Generator) -> Change:
    """Rotate the lines at random."""
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    return Change(LineCloud.through(lines.origin @ turn.T, lines.direction @ turn.T), lambda xyz: xyz @ turn)


def rounded(lines: LineCloud, rng: np.random.Generator) -> Change:
    """Round to single precision: not the same lines."""
    direction, moment = (part.astype(np.float32).astype(np.float64) for part in (lines.direction, lines.moment))
    return Change(LineCloud(direction, moment), lambda xyz: xyz)


CHANGES = {
    "flipped": flipped,
    "shuffled": shuffled,
    "scaled and moved": scaled,
    "turned": turned,
    "in single precision": rounded,
}


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="scenes: files, or folders of COLMAP models")
    parser.add_argument("--method", choices=METHODS, default="learned", help="(default: %(default)s)")
    return parser.parse_args()


def rows(name: str, method: str) -> Iterator[list[str]]:
    """Yield a row for each change of a scene."""
    scene = l2p.load(name, l2p.Scene)
    lines, truth = hidden(l2p.Scene(scene.xyz))
    unit, first = spacing(scene.xyz), l2p.recover(lines, method=method, progress=terminal_progress())
    sure = first.confidence >= np.median(first.confidence)
    error = errors(first.xyz, truth) / unit
    for title, change in CHANGES.items():
        changed = change(lines, np.random.default_rng(0))
        again = changed.back(l2p.recover(changed.lines, method=method, progress=terminal_progress()).xyz)
        same, other = errors(again, first.xyz) / unit < 0.1, errors(again, truth) / unit
        shares = [f"{same.mean():.2%}", f"{same[sure].mean():.2%}"]
        ratios = np.median(other) / np.median(error), (other <= 1).mean() / (error <= 1).mean()
        yield [Path(name).stem, title, *shares, *(f"{ratio:.4f}" for ratio in ratios)]


def main() -> None:
    """Print a row for each scene and change."""
    given = arguments()
    print_table(given.method, HEADS, [row for name in given.scenes for row in rows(name, given.method)])


if __name__ == "__main__":
    main()
