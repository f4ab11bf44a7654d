"""Share of the points that come back where a map lies in coordinates of a country, in single precision.

    python benchmarks/coarse.py ../shared/scenes/val/church_interior.npz

The scene is moved to UTM coordinates, of which single precision keeps steps of centimetres to half a metre, hidden with
several seeds and attacked. Its points are moved within their steps before they are lifted (l2p/schemes/rounding.py), so
what comes back within a distance is bounded by that: the last column has the share of the points that are not moved
further.
"""

from __future__ import annotations

import argparse

import numpy as np
from harness import print_table

import l2p
from l2p.io.scene_files import load_scene
from l2p.schemes.rounding import lattice_step

#: East, north and height of a place in Germany, metres.
UTM = (5e5, 5.4e6, 100.0)
#: Distances, scene units (metres).
LIMITS = (0.1, 0.25, 0.5)
HEADS = ("coordinates", "steps x, y, z", "within", "share, mean", "least .. most", "not moved further")


def main() -> None:
    """Attack the scene as it is and in single precision, and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--seeds", type=int, default=6)
    given = parser.parse_args()
    points = load_scene(given.scene).xyz
    rows = []
    for name, xyz in (("as they are", points), ("UTM, float32", (points + UTM).astype(np.float32).astype(float))):
        step = lattice_step(xyz)
        moved = np.linalg.norm(step * np.random.default_rng(0).uniform(-0.5, 0.5, step.shape), axis=1)
        found = []
        for seed in range(given.seeds):
            hidden = l2p.hide(xyz, seed=seed)
            error = np.linalg.norm(l2p.recover(hidden.map).xyz - hidden.truth.xyz, axis=1)
            found.append([float((error <= limit).mean()) for limit in LIMITS])
        steps = ", ".join(f"{each:.2g}" for each in np.median(step, axis=0))
        for limit, shares in zip(LIMITS, zip(*found, strict=True), strict=True):
            span = f"{min(shares):.1%} .. {max(shares):.1%}"
            rows.append([name, steps, f"{limit:g}", f"{np.mean(shares):.1%}", span, f"{(moved <= limit).mean():.1%}"])
    print_table(f"{given.seeds} seeds", HEADS, rows)


if __name__ == "__main__":
    main()
