"""Time of the search for candidates, the points nearest to each line, against the number of lines, all in one process.

    python benchmarks/candidate_search.py --lines 12500 100000 800000

The scene is simulated, the same for all sizes but for the density of its points. As between rounds of the learned
attack, the estimates lie about one local scale beside the points, a share of them anywhere on their lines, and
distances count in units of the square root of the local scale. Up to ``--pairs`` lines the table also has the time of
all pairs, which must give the same distances, and that of a bare matrix product and top-k of the same shape.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from l2p.attacks.learned.features import nearest_estimates

import l2p
from l2p.geometry import nearest as search
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.nearest import TILE, Nearest, nearest_points_to_lines
from l2p.schemes.hide import hide


def estimates(kind: str, count: int, strays: float) -> tuple[Lines, torch.Tensor, torch.Tensor]:
    """Lines of a simulated scene, an estimate on each, and the units of distances to them."""
    rng = np.random.default_rng(0)
    xyz = l2p.simulate(kind, points=count, seed=0).xyz
    hidden = hide(xyz, 0, 1.0)
    cloud, index = hidden.map, hidden.truth.index
    frame = Frame.of(cloud)
    lines = frame.enter(cloud, torch.device("cpu"))
    points = frame.enter_points(xyz[index], torch.device("cpu"))
    true_beta = torch.linalg.vecdot(points, lines.direction)
    error = rng.normal(size=len(points)) * nearest_estimates(lines, true_beta).scale.numpy()
    astray = rng.random(len(points)) < strays
    error[astray] = 0.5 * rng.standard_cauchy(astray.sum())
    beta = true_beta + torch.as_tensor(error, dtype=points.dtype)
    return lines, lines.at(beta), nearest_estimates(lines, beta).scale.sqrt()


def timed(clock: Callable[[], float], run: Callable[[], Nearest | None]) -> tuple[float, Nearest | None]:
    """Seconds, and the answer."""
    begin = clock()
    answer = run()
    return clock() - begin, answer


def all_pairs(lines: Lines, points: torch.Tensor, k: int, unit: torch.Tensor) -> Nearest:
    """The same search without the tree."""
    many, search.MANY = search.MANY, len(points) + 1
    try:
        return nearest_points_to_lines(lines, points, k, scale=unit)
    finally:
        search.MANY = many


def bare(count: int, k: int) -> None:
    """One matrix product of rank 4 a tile, and ``torch.topk``."""
    left, right = torch.randn(count, 4), torch.randn(4, count)
    for part in left.split(max(1, TILE // count)):
        torch.topk(part @ right, k, dim=1, largest=False)


def measure(given: argparse.Namespace, count: int, before: dict[int, float]) -> str:
    """One row of the table."""
    lines, points, unit = estimates(given.kind, count, given.strays)
    clock = time.process_time if given.cpu else time.perf_counter

    def search() -> Nearest:
        return nearest_points_to_lines(lines, points, given.k, scale=unit)

    runs = [timed(clock, search) for _ in range(given.runs)]
    seconds, found = statistics.median(took for took, _ in runs), runs[0][1]
    before[count] = seconds
    eighth = f"{seconds / before[count // 8]:.1f}" if count // 8 in before else ""
    cells = [str(count), f"{seconds:.2f}", f"{1e6 * seconds / count:.1f}", eighth, "", "", ""]
    if count <= given.pairs:
        pairs, expected = timed(clock, lambda: all_pairs(lines, points, given.k, unit))
        product, _ = timed(clock, lambda: bare(count, given.k))
        assert found is not None and expected is not None
        apart = float((found.distance - expected.distance).abs().max() / expected.distance.mean())
        cells[4:] = [f"{pairs / seconds:.1f}", f"{seconds / product:.2f}", f"{apart:.0e}"]
    return "| " + " | ".join(cells) + " |"


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sizes = [12_500, 20_000, 50_000, 100_000, 400_000, 800_000]
    parser.add_argument("--lines", type=int, nargs="+", default=sizes, help="numbers of lines (default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--k", type=int, default=64, help="points of each line (default: %(default)s)")
    parser.add_argument("--strays", type=float, default=0.05, help="share of estimates gone astray (%(default)s)")
    parser.add_argument("--pairs", type=int, default=20_000, help="most lines for all pairs (default: %(default)s)")
    parser.add_argument("--runs", type=int, default=3, help="of which the median counts (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (default: %(default)s)")
    parser.add_argument("--cpu", action="store_true", help="CPU seconds of one thread: for a machine that is busy")
    given = parser.parse_args()
    if given.cpu:
        given.threads = 1
    return given


def main() -> None:
    """Print one row a size, as it comes."""
    given = arguments()
    torch.set_num_threads(given.threads)
    nearest_points_to_lines(*estimates(given.kind, 5_000, given.strays)[:2], given.k)  # warm up
    print(f"{given.kind}, k = {given.k}, {given.threads} thread(s), {'CPU' if given.cpu else 'wall-clock'} time")
    print(
        "| lines | seconds | us a line | ratio to 1/8 of the lines | all pairs / this | this / product and top-k | "
        "largest difference |"
    )
    print("|---:|---:|---:|---:|---:|---:|---:|")
    before: dict[int, float] = {}
    for count in given.lines:
        print(measure(given, count, before), flush=True)


if __name__ == "__main__":
    main()
