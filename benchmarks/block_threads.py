"""One round of the learned attack on two cores: torch's own threads in each operation, or blocks of lines side by side.

    python benchmarks/block_threads.py --lines 6000

Each way runs in a process of its own, with threads that spin while they wait and with threads that sleep
(``OMP_WAIT_POLICY``, which the command line sets to PASSIVE). Prints milliseconds a line of a round, the best of some
repetitions: edges, network and peaks; the search for candidates is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time

import torch
from l2p.attacks.learned.features import edges

import l2p
from l2p.attacks.learned.checkpoint import load, shipped
from l2p.attacks.learned.learned import find_candidates, first_nodes, weighted_peak
from l2p.attacks.tomography.reconstruct import reconstruct
from l2p.geometry.frame import Frame
from l2p.work.threads import over_blocks

#: Ways to run a round: title, threads of torch, and whether blocks run side by side.
WAYS = {"one thread": (1, True), "torch's threads": (0, False), "blocks side by side": (0, True)}


@torch.inference_mode()
def measure(way: str, given: argparse.Namespace) -> float:
    """Milliseconds a line of one round here."""
    threads, blocks = WAYS[way]
    method = load(shipped())
    cloud = l2p.lift(l2p.simulate("room", points=given.lines, seed=0).xyz, seed=0)
    lines = Frame.of(cloud).enter(cloud)
    posterior = reconstruct(lines)
    nodes = first_nodes(lines, posterior)
    candidates = find_candidates(lines, nodes, method.config)

    def judged(block: slice) -> torch.Tensor:
        rows = torch.arange(block.start, block.stop)
        return weighted_peak(method.network(edges(lines, nodes, posterior, rows, candidates[rows])), method.config)

    torch.set_num_threads(threads or given.threads)
    best, size, count = float("inf"), method.config.batch, len(candidates)
    for _ in range(given.repetitions):
        begin = time.perf_counter()
        if blocks:
            list(over_blocks(judged, count, size))
        else:
            for start in range(0, count, size):
                judged(slice(start, min(start + size, count)))
        best = min(best, time.perf_counter() - begin)
    return 1e3 * best / count


def measured_apart(way: str, policy: str, given: argparse.Namespace) -> float:
    """The same in a fresh process, since the policy is read when torch loads."""
    command = [sys.executable, __file__, "--way", way, "--lines", str(given.lines), "--threads", str(given.threads)]
    command += ["--repetitions", str(given.repetitions)]
    environment = {**os.environ, "OMP_WAIT_POLICY": policy}
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, env=environment).stdout)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, default=6000, help="number of lines (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="threads (default: %(default)s)")
    parser.add_argument("--repetitions", type=int, default=3, help="the best one counts (default: %(default)s)")
    parser.add_argument("--way", choices=WAYS, help="measure one way in this process, print JSON")
    return parser.parse_args()


def main() -> None:
    """Print a row for each way."""
    given = arguments()
    if given.way:
        print(json.dumps(measure(given.way, given)))
        return
    print(f"| {given.threads} threads, ms a line | active | passive |\n| --- | ---: | ---: |")
    for way in WAYS:
        active, passive = (measured_apart(way, policy, given) for policy in ("ACTIVE", "PASSIVE"))
        print(f"| {way} | {active:.3f} | {passive:.3f} |", flush=True)


if __name__ == "__main__":
    main()
