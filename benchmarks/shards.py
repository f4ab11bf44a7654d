"""Measure an attack whose lines are divided among ranks on this machine: seconds, memory, network traffic.

    python benchmarks/shards.py --lines 3000 --processes 1 2 4
    python benchmarks/shards.py --lines 3000 --methods tomography --rounds 0

Each row is a run of ``l2p recover --processes``, with one thread per rank. Memory is the largest peak of a rank minus
the memory of such a process when its attack begins. Traffic is bytes through the loopback interface (/proc/net/dev) per
line and rank, in all protocols, including those of other programs. The second command runs the tomography alone, which
docs/scaling.md needs to predict the traffic of a city. Ranks that share cores take longer; memory and traffic do not
depend on that.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from harness import Attacker, Cloud, Setting, print_table, simulated

from l2p.attacks.settings import METHODS
from l2p.work.resident import PROC, peak_gib, resident_gib

#: Seconds between two readings of the peaks of running processes.
POLL = 0.02
HEADS = ("method", "lines", "processes", "seconds", "MiB at the largest", "on the wire, B/line/process")


class Shared(NamedTuple):
    """Seconds of the attack, GiB at the peak of the largest rank, bytes through the loopback interface."""

    seconds: float
    gib: float
    wire: int


def loopback_bytes() -> int:
    """Bytes through the loopback interface since the machine was started."""
    interfaces = (PROC / "net" / "dev").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[9]) for line in interfaces if line.strip().startswith("lo:"))


def family(process: int) -> list[int]:
    """List a process and its children."""
    try:
        children = (PROC / str(process) / "task" / str(process) / "children").read_text(encoding="ascii").split()
    except OSError:
        children = []
    return [process, *map(int, children)]


def idle_gib(cloud: Cloud) -> float:
    """Resident memory of a process that has loaded its libraries and the lines."""
    with Attacker(cloud, Setting("tomography")) as attacker:
        return resident_gib(attacker.child.pid) or 0.0


def shared(cloud: Cloud, method: str, processes: int, rounds: int | None) -> Shared:
    """Run ``l2p recover`` on ``processes`` ranks, and read the peaks of all until it ends."""
    out, facts = f"{cloud.path}.out.npz", Path(f"{cloud.path}.json")
    words = ["recover", f"{cloud.path}.npz", "-o", out, "--json", facts, "--force", "--method", method, "--threads", 1]
    words += ["--processes", processes, *(() if rounds is None else ("--rounds", rounds))]
    wire, peaks = loopback_bytes(), dict[int, float]()
    with subprocess.Popen([sys.executable, "-m", "l2p", *map(str, words)], stdout=subprocess.DEVNULL) as running:
        while running.poll() is None:
            peaks.update((process, gib) for process in family(running.pid) if (gib := peak_gib(process)) is not None)
            time.sleep(POLL)
    if running.returncode:
        raise SystemExit(f"l2p recover ended with exit code {running.returncode}")
    return Shared(json.loads(facts.read_text())["seconds"], max(peaks.values()), loopback_bytes() - wire)


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, nargs="+", default=[3000], help="numbers of lines (default: %(default)s)")
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2, 4], help="numbers (default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["learned"], metavar="METHOD")
    parser.add_argument("--rounds", type=int, help="rounds of refinement (default: the method's own)")
    return parser.parse_args()


def rows(given: argparse.Namespace, folder: Path) -> Iterator[list[str]]:
    """Yield a row for each number of lines, method and number of ranks."""
    for count in given.lines:
        cloud = simulated(given.kind, count, folder)
        idle = idle_gib(cloud)
        for method, processes in itertools.product(given.methods, given.processes):
            took = shared(cloud, method, processes, given.rounds)
            mib, wire = 1024 * (took.gib - idle), took.wire / count / processes
            yield [method, f"{count:,}", str(processes), f"{took.seconds:.1f}", f"{mib:.0f}", f"{wire:,.0f}"]


def main() -> None:
    """Print the table."""
    given = arguments()
    with tempfile.TemporaryDirectory() as folder:
        print_table(given.kind, HEADS, rows(given, Path(folder)))


if __name__ == "__main__":
    main()
