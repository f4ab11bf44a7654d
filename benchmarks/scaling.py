"""Time, memory and accuracy of an attack against the number of lines, each size in a process of its own.

    python benchmarks/scaling.py --method tomography --lines 25000 200000 1000000

The scene is simulated and the same for all sizes but for the density of its points. Prints a table; errors are in
spacings of the largest size's own kind (median distance to the 50th neighbour of the cloud at hand) and in units of
the scene, which compare across sizes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys

import l2p
from l2p.attacks.settings import METHODS
from l2p.judging.accuracy import spacing
from l2p.judging.scores import evaluate
from l2p.schemes.hide import hide


def peak_gib() -> float:
    """The peak of this process's resident memory (VmHWM of Linux)."""
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 2**20 for line in status if line.startswith("VmHWM"))


def measure(lines: int, given: argparse.Namespace) -> dict[str, float]:
    """Attack one simulated scene here."""
    import torch

    torch.set_num_threads(given.threads)
    xyz = l2p.simulate(given.kind, points=lines, seed=0).xyz
    hidden = hide(xyz, 0, 1.0)
    cloud, index = hidden.map, hidden.truth.index
    result = l2p.recover(cloud, method=given.method)
    peak = peak_gib()  # before the scoring, which needs memory of its own
    scores = evaluate(result, xyz[index], spacing(xyz))
    return {
        "lines": len(cloud),
        "seconds": result.info["seconds"],
        "gib": peak,
        "median": scores.median,
        "spacings": scores.median_spacings,
        "within": scores.within_spacings["1"],
    }


def measured_apart(lines: int, given: argparse.Namespace) -> dict[str, float]:
    """The same in a fresh process, whose peak of memory is this attack's alone."""
    command = [sys.executable, __file__, "--lines", str(lines), "--kind", given.kind, "--here"]
    command += ["--method", given.method, "--threads", str(given.threads)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sizes = [25_000, 200_000, 1_000_000]
    parser.add_argument("--lines", type=int, nargs="+", default=sizes, help="numbers of lines (default: %(default)s)")
    parser.add_argument("--method", choices=METHODS, default="learned", help="(default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (default: %(default)s)")
    parser.add_argument("--here", action="store_true", help="measure one size in this process, print JSON")
    return parser.parse_args()


def main() -> None:
    """Print one row a size, as it comes."""
    given = arguments()
    if given.here:
        print(json.dumps(measure(given.lines[0], given)))
        return
    print(f"{given.method}, {given.kind}, {given.threads} thread(s)")
    print("| lines | seconds | ms a line | ratio to the first | peak GiB | median (scene) | spacings | within 1 |")
    print("|---:|---:|---:|---:|---:|---:|---:|---:|")
    first = None
    for lines in given.lines:
        row = measured_apart(lines, given)
        first = first or row["seconds"]
        cells = [
            f"{row['lines']}",
            f"{row['seconds']:.1f}",
            f"{1e3 * row['seconds'] / row['lines']:.2f}",
            f"{row['seconds'] / first:.1f}",
            f"{row['gib']:.2f}",
            f"{row['median']:.4f}",
            f"{row['spacings']:.3f}",
            f"{100 * row['within']:.1f} %",
        ]
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
