"""Where the time and the memory of `l2p recover` go, by the number of lines; each size in a process of its own.

    python benchmarks/profile_recover.py --lines 1000 5000 20000 100000 200000

Seconds of each stage, from the start of the process to the written recovery: start-up (the interpreter and all
imports), reading and writing, and the stages of the attack, which are what its progress bars show. All rounds of a
stage are added up; `surroundings` is what no bar shows: local scales and surfaces of the estimates, the frame. The
peak of resident memory (VmHWM of Linux) is in GiB beyond that of `import torch` alone.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import l2p
from l2p.attacks.settings import METHODS

CHILD = """
import collections, contextlib, json, sys, time
begun, lines, method, threads = float(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4])
memory = json.loads(sys.argv[5])
import torch
def peak():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 2**20 for line in status if line.startswith("VmHWM"))
before = peak()
import l2p, l2p.checkpoint, l2p.cli
seconds = collections.Counter({"start-up": time.time() - begun})
class Clock:
    @contextlib.contextmanager
    def task(self, name, total):
        start = time.perf_counter()
        yield lambda count: None
        seconds[name] += time.perf_counter() - start
@contextlib.contextmanager
def stage(name):
    start = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - start
if threads:
    torch.set_num_threads(threads)
with stage("read and write"):
    cloud = l2p.LineCloud.load(lines)
known = set(seconds)
start = time.perf_counter()
result = l2p.recover(cloud, method=method, memory=memory, progress=Clock())
attack = time.perf_counter() - start
seconds["surroundings"] = attack - sum(value for name, value in seconds.items() if name not in known)
with stage("read and write"):
    result.save(lines + ".out.npz")
print(json.dumps({"seconds": seconds, "gib": peak() - before, "lines": len(cloud), "threads": torch.get_num_threads()}))
"""


def measure(count: int, given: argparse.Namespace) -> dict:
    """Seconds of the stages and GiB at the peak of one run."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "lines.npz"
        l2p.save(l2p.lift(l2p.simulate(given.kind, points=count, seed=0).xyz, seed=0), path)
        words = [str(path), given.method, str(given.threads), json.dumps(given.memory)]
        command = [sys.executable, "-c", CHILD, str(time.time()), *words]
        return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sizes = [1_000, 5_000, 20_000, 100_000, 200_000]
    parser.add_argument("--lines", type=int, nargs="+", default=sizes, help="numbers of lines (default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--method", choices=METHODS, default="learned", help="(default: %(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="CPU threads (default: what torch chooses)")
    parser.add_argument("--memory", type=float, metavar="GIB", help="for the attack (default: a share of what is free)")
    return parser.parse_args()


def main() -> None:
    """Measure one size after the other, then print a table with a column a size."""
    given = arguments()
    runs = [measure(count, given) for count in given.lines]
    print(f"{given.method}, {given.kind}, {runs[0]['threads']} thread(s)\n")
    totals = [sum(run["seconds"].values()) for run in runs]
    rows = {name: [f"{run['seconds'][name]:.1f}" for run in runs] for name in runs[0]["seconds"]}
    rows["all"] = [f"{total:.1f}" for total in totals]
    rows["ms a line"] = [f"{1e3 * total / run['lines']:.2f}" for total, run in zip(totals, runs, strict=True)]
    rows["peak, GiB"] = [f"{run['gib']:.2f}" for run in runs]
    print(f"| seconds | {' | '.join(f'{count:,} lines' for count in given.lines)} |")
    print("| --- |" + " ---: |" * len(runs))
    for name, cells in rows.items():
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
