"""Measure the two slowest kernels: an EM update of the tomography, and a round of the learned attack.

    python benchmarks/kernels.py update --lines 30000
    python benchmarks/kernels.py round --lines 6000 --threads 2

``update`` compares the rate of an update with the limit of the machine, in visits per second. A visit is one sample of
a line in one cell, read once (forward projection) and added to once (back projection). The bare kernel reads and adds
the same samples in one block, without normalising: the memory rate in plain torch. docs/open-problems.md has the rates;
rejected variants are in ``benchmarks/voxel_visits.py`` at 70b056c. The title has the number of cells, which
docs/scaling.md needs per line.

``round`` compares blocks of lines side by side, each on one thread, with torch's own threads in each operation:
milliseconds per line for features, network and peaks, without the search for candidates. Each way runs in its own
process, with waiting threads that spin (active) or sleep (passive, the setting of the command line).
docs/performance.md has the table. Both report the fastest of several repetitions.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable
from unittest import mock

import torch
from harness import hidden, print_table

import l2p
from l2p.attacks.learned.checkpoint import load, shipped
from l2p.attacks.learned.learned import weighted_peak
from l2p.attacks.tomography import reconstruct as tomography
from l2p.geometry.frame import Frame
from l2p.work.shards import BLOCK
from l2p.work.threads import over_blocks
from train.clouds import CloudSource, lifted

#: Ways to run a round: whether torch has one thread, and whether blocks run side by side.
WAYS = {"one thread": (True, True), "torch's threads": (False, False), "blocks side by side": (False, True)}
POLICIES = ("ACTIVE", "PASSIVE")


def best(work: Callable[[], object], repeat: int) -> float:
    """Seconds of the fastest of ``repeat`` runs, after one to warm up."""
    seconds = []
    for _ in range(repeat + 1):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return min(seconds[1:])


def last_update(kind: str, lines: int) -> mock.Mock:
    """Return a mock whose last call is the last EM update of a reconstruction, at the finest level."""
    cloud, _ = hidden(l2p.Scene(l2p.simulate(kind, points=lines, seed=0).xyz))
    with mock.patch.object(tomography, "_update", wraps=tomography._update) as update:
        tomography.reconstruct(Frame.of(cloud).enter(cloud))
    return update


def show_update(given: argparse.Namespace) -> None:
    """Print rates of the update and of its parts, and ratios to the bare kernel."""
    torch.set_num_threads(given.threads)
    words = last_update(given.kind, given.lines).call_args.args
    level, density = words[:2]
    cell, padded = level.cell.flatten(), torch.cat([density, density.new_zeros(1)])
    kernels: dict[str, Callable[[], object]] = {
        "bare gather and scatter": lambda: torch.zeros_like(padded).index_add_(0, cell, padded.index_select(0, cell)),
        "projection and back projection": lambda: tomography._back_projection(level, density),
        "whole update with the prior": lambda: tomography._update(*words),
    }
    rates = {name: level.cell.numel() / 1e6 / best(work, given.repeat) for name, work in kernels.items()}
    bare = next(iter(rates.values()))
    title = f"{given.lines:,} lines, {cell.numel():,} samples in {len(density):,} cells, {given.threads} thread(s)"
    rows = [[name, f"{rate:.0f}", f"{rate / bare:.2f}"] for name, rate in rates.items()]
    print_table(title, ["kernel", "million visits/s", "over the bare kernel"], rows)


def round_ms(way: str, given: argparse.Namespace) -> float:
    """Milliseconds per line of one round in this process."""
    alone, side_by_side = WAYS[way]
    attack = load(shipped())
    state = lifted(CloudSource(f"sim:{given.kind}:{given.lines}:0", 1.0, 0), attack).state()
    candidates = attack.candidates(state)
    count = len(candidates)

    def judged(block: slice, room: int | None = None) -> torch.Tensor:
        rows = torch.arange(block.start, block.stop)
        return weighted_peak(attack.network(attack.edges(state, rows, candidates[rows])), attack.config)

    def whole() -> None:
        if side_by_side:
            list(over_blocks(judged, count, BLOCK))
        else:
            list(map(judged, (slice(begin, min(begin + BLOCK, count)) for begin in range(0, count, BLOCK))))

    torch.set_num_threads(1 if alone else given.threads)
    return 1e3 * best(whole, given.repeat) / count


def show_round(given: argparse.Namespace) -> None:
    """Print milliseconds per line of each way, each in a new process: torch reads the wait policy when it loads."""
    rows = []
    for way in WAYS:
        command = [sys.executable, __file__, *sys.argv[1:], "--way", way]
        runs = [
            subprocess.run(command, check=True, stdout=subprocess.PIPE, env={**os.environ, "OMP_WAIT_POLICY": policy})
            for policy in POLICIES
        ]
        rows.append([way, *(f"{float(run.stdout):.3f}" for run in runs)])
    print_table(f"{given.lines:,} lines, {given.threads} threads, ms/line", ["", *map(str.lower, POLICIES)], rows)


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kernel", choices=("update", "round"), help="what to measure")
    parser.add_argument("--lines", type=int, default=30_000, help="simulated lines (default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    parser.add_argument("--repeat", type=int, default=5, help="runs, the best counts (default: %(default)s)")
    parser.add_argument("--way", choices=WAYS, help="print the milliseconds of one way of a round, in this process")
    return parser.parse_args()


@torch.inference_mode()
def main() -> None:
    """Measure the given kernel."""
    given = arguments()
    if given.way:
        print(round_ms(given.way, given))
    elif given.kernel == "round":
        show_round(given)
    else:
        show_update(given)


if __name__ == "__main__":
    main()
