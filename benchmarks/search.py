"""Measure the search for candidates (the points nearest to each line) by the number of lines.

    python benchmarks/search.py --lines 12500 100000 800000

As between rounds of the learned attack, the estimates are about one local scale away from the points of a simulated
scene, a share of them anywhere on their lines, and distances are in units of the square root of the local scale. Up to
``--pairs`` lines the table also has the ratio to all pairs, which must give the same distances, and to a bare matrix
product and top-k of the same shape. docs/performance.md has the output: 8 times the lines should take at most 11 times
the time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import TypeVar
from unittest import mock

import numpy as np
import torch
from harness import hidden, print_table

import l2p
from l2p.attacks.learned.nodes import NodesConfig, neighborhood
from l2p.geometry import nearest
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame

#: Half width of the distribution of stray estimates, in units of the frame.
STRAY = 0.5
HEADS = (
    *("lines", "seconds", "us/line", "over 1/8 of the lines", "all pairs over this", "this over product and top-k"),
    "largest difference",
)
Found = TypeVar("Found")


def estimates(kind: str, count: int, strays: float) -> tuple[Lines, torch.Tensor, torch.Tensor]:
    """Simulate lines of a scene, an estimate on each, and the units of distances to the estimates."""
    rng = np.random.default_rng(0)
    cloud, truth = hidden(l2p.Scene(l2p.simulate(kind, points=count, seed=0).xyz))
    frame = Frame.of(cloud)
    lines = frame.enter(cloud, torch.device("cpu"))
    true_beta = torch.linalg.vecdot(frame.enter_points(truth, torch.device("cpu")), lines.direction)
    error = rng.normal(size=count) * neighborhood(lines, true_beta, NodesConfig()).scale.numpy()
    astray = rng.random(count) < strays
    error[astray] = STRAY * rng.standard_cauchy(astray.sum())
    beta = true_beta + torch.as_tensor(error, dtype=true_beta.dtype)
    return lines, lines.at(beta), neighborhood(lines, beta, NodesConfig()).scale.sqrt()


def bare(count: int, k: int) -> None:
    """Compute one matrix product of rank 4 per tile, and ``torch.topk``."""
    left, right = torch.randn(count, 4), torch.randn(4, count)
    for part in left.split(max(1, nearest.TILE // count)):
        torch.topk(part @ right, k, dim=1, largest=False)


def timed(work: Callable[[], Found], repeat: int, cpu: bool) -> tuple[float, Found]:
    """Return the median of the seconds, and one result."""
    clock = time.process_time if cpu else time.perf_counter
    runs = []
    for _ in range(repeat):
        began = clock()
        answer = work()
        runs.append((clock() - began, answer))
    return float(np.median([seconds for seconds, _ in runs])), runs[0][1]


def row(given: argparse.Namespace, count: int, before: dict[int, float]) -> list[str]:
    """Measure one row of the table."""
    lines, points, unit = estimates(given.kind, count, given.strays)

    def search() -> nearest.Nearest:
        return nearest.nearest_points_to_lines(lines, points, given.k, scale=unit)

    seconds, found = timed(search, given.repeat, given.cpu)
    before[count] = seconds
    growth = f"{seconds / before[count // 8]:.1f}" if count // 8 in before else ""
    cells = [f"{count:,}", f"{seconds:.2f}", f"{1e6 * seconds / count:.1f}", growth]
    if count > given.pairs:
        return [*cells, "", "", ""]
    with mock.patch.object(nearest, "MANY", count + 1):  # no tree
        pairs, expected = timed(search, 1, given.cpu)
    product, _ = timed(lambda: bare(count, given.k), 1, given.cpu)
    apart = float((found.distance - expected.distance).abs().max() / expected.distance.mean())
    return [*cells, f"{pairs / seconds:.1f}", f"{seconds / product:.2f}", f"{apart:.0e}"]


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sizes = [12_500, 20_000, 100_000, 800_000]
    parser.add_argument("--lines", type=int, nargs="+", default=sizes, help="numbers of lines (default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--k", type=int, default=64, help="points of each line (default: %(default)s)")
    parser.add_argument("--strays", type=float, default=0.05, help="share of stray estimates (default: %(default)s)")
    parser.add_argument("--pairs", type=int, default=20_000, help="most lines for all pairs (default: %(default)s)")
    parser.add_argument("--repeat", type=int, default=3, help="runs; the median counts (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (default: %(default)s)")
    parser.add_argument("--cpu", action="store_true", help="CPU seconds of one thread: for a busy machine")
    given = parser.parse_args()
    given.threads = 1 if given.cpu else given.threads
    return given


def main() -> None:
    """Print one row per size."""
    given, before = arguments(), dict[int, float]()
    torch.set_num_threads(given.threads)
    nearest.nearest_points_to_lines(*estimates(given.kind, 5_000, given.strays)[:2], given.k)  # warm up
    rows = [row(given, count, before) for count in given.lines]
    kind = "CPU" if given.cpu else "wall-clock"
    print_table(f"{given.kind}, k = {given.k}, {given.threads} thread(s), {kind} seconds", HEADS, rows)


if __name__ == "__main__":
    main()
