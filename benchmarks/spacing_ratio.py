"""Measure how the spacing of a map depends on the fraction of its points, the basis of `l2p recover --fraction`.

    python benchmarks/spacing_ratio.py ../shared/scenes/train

Spacing is the median distance to the 50th neighbour. Prints, for each fraction, the mean and the standard deviation
over the scenes of the logarithm of (spacing of the map / spacing of the fraction), the dimension that follows from
each, and the mean and deviation of (ratio assumed by l2p / measured ratio). The result is the dimension 1.9 of
:func:`l2p.attacks.learned.learned.spacing_ratio`.
"""

from __future__ import annotations

import argparse

import numpy as np
from harness import print_table

from l2p.attacks.learned.learned import spacing_ratio
from l2p.judging.accuracy import spacing
from l2p.programs.scenes import scene_at, scenes_of

SHARES = (0.5, 0.25, 0.1, 0.05)
HEADS = ("fraction of the points", "scenes", "log ratio", "deviation", "dimension", "assumed / measured", "deviation")
#: Most points of a scene, to save time, and least points of a fraction, to have 50 neighbours.
MOST, LEAST = 40_000, 100


def main() -> None:
    """Thin each scene once to each fraction, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="scenes, or folders of them")
    given = parser.parse_args()
    logs: dict[float, list[float]] = {share: [] for share in SHARES}
    for scene in scenes_of(tuple(given.scenes), {}):
        points = scene_at(scene.source).xyz
        if len(points) > MOST:
            continue
        order, whole = np.random.default_rng(0).permutation(len(points)), spacing(points)
        for share in SHARES:
            some = points[order[: round(share * len(points))]]
            if len(some) >= LEAST:
                logs[share].append(float(np.log(whole / spacing(some))))
    rows = []
    for share, found in logs.items():
        ratio = np.array(found)
        ahead = np.log(spacing_ratio(share)) - ratio
        figures = ratio.mean(), ratio.std(), np.log(share) / ratio.mean(), np.exp(ahead.mean()), ahead.std()
        rows.append([f"{share:.0%}", str(len(ratio)), *(f"{figure:.3f}" for figure in figures)])
    print_table(f"{len(logs[SHARES[0]])} scenes", HEADS, rows)


if __name__ == "__main__":
    main()
