"""How the spacing of a map depends on the share of its points: what `l2p recover --density` rests on.

    python benchmarks/spacing_ratio.py ../shared/scenes/train

A spacing is the median distance to the 50th neighbour. Prints, for each share, the mean and the standard deviation over
the scenes of the logarithm of (spacing of the map / spacing of the share), the dimension that follows from each
(:func:`l2p.attacks.learned.learned.spacing_ratio`), and the mean and deviation of (what l2p says / what holds).
"""

from __future__ import annotations

import argparse

import numpy as np

import l2p
from l2p.attacks.learned.learned import spacing_ratio
from l2p.judging.accuracy import spacing
from l2p.programs.scenes import scenes_of

SHARES = (0.5, 0.25, 0.1, 0.05)
#: Scenes larger than this take too long, and shares smaller than this have no 50 neighbours.
MOST, LEAST = 40_000, 100


def main() -> None:
    """Thin each scene once to each share."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="scenes, or folders of them")
    given = parser.parse_args()
    logs: dict[float, list[float]] = {share: [] for share in SHARES}
    for scene in scenes_of(tuple(given.scenes), {}):
        points = l2p.load(scene.source, l2p.Scene).xyz
        if len(points) > MOST:
            continue
        order, whole = np.random.default_rng(0).permutation(len(points)), spacing(points)
        for share in SHARES:
            some = points[order[: round(share * len(points))]]
            if len(some) >= LEAST:
                logs[share].append(float(np.log(whole / spacing(some))))
    print("| share of the points | scenes | log ratio | deviation | dimension | said / true | deviation |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for share, found in logs.items():
        ratio = np.array(found)
        said = np.log(spacing_ratio(share))
        ahead = np.exp(said - ratio)
        dimension = np.log(share) / ratio.mean()
        print(
            f"| {share:.0%} | {len(ratio)} | {ratio.mean():.3f} | {ratio.std():.3f} | {dimension:.2f} | "
            f"{np.exp(np.log(ahead).mean()):.3f} | {np.log(ahead).std():.3f} |"
        )


if __name__ == "__main__":
    main()
