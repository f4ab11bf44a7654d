"""What the learned attack costs over tomography, which it begins with: paired runs on the same line clouds.

    python benchmarks/learned_against_tomography.py --lines 5000 20000

The two attack a simulated scene in turn, several times; seconds are medians, the ratio is the median of the pairs'
ratios, which does not suffer from a machine whose speed drifts. Start-up is left out, a first pair is not counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

import l2p
from l2p.attacks.run import named_method, run
from l2p.judging.accuracy import spacing
from l2p.judging.scores import evaluate
from l2p.schemes.hide import hide


def measured(lines: int, given: argparse.Namespace) -> str:
    """The row of a size."""
    xyz = l2p.simulate(given.kind, points=lines, seed=0).xyz
    hidden = hide(xyz, 0, 1.0)
    cloud, index = hidden.map, hidden.truth.index
    methods = (named_method("tomography"), named_method("learned", rounds=given.rounds))
    seconds: list[Sequence[float]] = []
    medians: list[float] = []
    for _ in range(given.pairs + 1):
        found = [run(cloud, method) for method in methods]
        seconds.append([recovery.info["seconds"] for recovery in found])
        medians = [evaluate(recovery, xyz[index], spacing(xyz)).median_spacings for recovery in found]
    counted = np.array(seconds[1:])
    tomography, learned = np.median(counted, axis=0)
    ratio = np.median(counted[:, 1] / counted[:, 0])
    return f"| {lines:,} | {tomography:.1f} | {learned:.1f} | {ratio:.1f} | {medians[0]:.3f} | {medians[1]:.3f} |"


def main() -> None:
    """Print one row a size, as it comes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, nargs="+", default=[5_000, 20_000], help="(default: %(default)s)")
    parser.add_argument("--rounds", type=int, help="of the learned attack (default: all of the checkpoint)")
    parser.add_argument("--pairs", type=int, default=3, help="runs of each that are counted (default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    given = parser.parse_args()
    print("| lines | tomography, s | learned, s | ratio | median error (spacings) | of learned |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: |")
    for lines in given.lines:
        print(measured(lines, given), flush=True)


if __name__ == "__main__":
    main()
