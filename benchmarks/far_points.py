"""Share of the near points that come back, and what is stated of near and far ones, where a map has far points.

    python benchmarks/far_points.py SCENE.npz --method learned

Each row is the scene with other points added: a share of all on a sphere of so many scene sizes, at distances of all
orders, one point, or a second copy of the scene (all of it, or a quarter).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

import l2p
from l2p.io.scene_files import load_scene
from l2p.judging.accuracy import spacing

Points = Float[np.ndarray, "points 3"]


def added(points: Points, seed: int) -> Iterator[tuple[str, Points]]:
    """Name the points to add to a scene, and return them."""
    rng, middle = np.random.default_rng(seed), np.median(points, axis=0)
    size = 2 * float(np.median(np.linalg.norm(points - middle, axis=1)))

    def away(count: int, distance: float | np.ndarray) -> Points:
        direction = rng.normal(size=(count, 3))
        return middle + size * distance * direction / np.linalg.norm(direction, axis=1, keepdims=True)

    count = len(points)
    yield "none", points[:0]
    yield "1 in 10 at 50 sizes", away(count // 9, 50)
    yield "1 in 10 at 1e4", away(count // 9, 1e4)
    yield "1 in 100 at 1e3", away(count // 99, 1e3)
    yield "one at 1e14", away(1, 1e14)
    yield "1 in 10 from 3 to 1e6", away(count // 9, 10 ** rng.uniform(0.5, 6, size=(count // 9, 1)))
    yield "a second room at 1e4", points[:, [1, 0, 2]] + away(1, 1e4)
    yield "a quarter of it at 1e4", points[rng.permutation(count)[: count // 4]] + away(1, 1e4)


def main() -> None:
    """Print a row for each kind of far points."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--method", default="learned")
    parser.add_argument("--seed", type=int, default=5)
    arguments = parser.parse_args()
    points = load_scene(arguments.scene).xyz
    print(f"{'added':24} {'near: right':>12} {'stated':>7} {'far: right':>11} {'stated':>7}  lines of each part")
    for name, far in added(points, arguments.seed):
        whole = np.concatenate([points, far])
        hidden = l2p.hide(whole, seed=1)
        recovery = l2p.recover(hidden.map, method=arguments.method)
        right = np.linalg.norm(recovery.xyz - hidden.truth.xyz, axis=1) <= spacing(whole)
        near = hidden.truth.index < len(points)
        shares = [
            f"{column[rows].mean():.3f}" if rows.any() else "-"
            for rows in (near, ~near)
            for column in (right, recovery.confidence)
        ]
        parts = [part["lines"] for part in recovery.info.get("parts", [])]
        print(f"{name:24} {shares[0]:>12} {shares[1]:>7} {shares[2]:>11} {shares[3]:>7}  {parts or ''}", flush=True)


if __name__ == "__main__":
    main()
