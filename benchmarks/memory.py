"""Memory of an attack on many simulated lines: what it takes, and whether it keeps to what it is allowed.

    python benchmarks/memory.py --lines 20000 200000

Every row is a process of its own, in which the attack runs with blocks as large as is fast, or within the least memory
that it accepts (`--least`). Its peak is that of resident memory (VmHWM of Linux) beyond what the process held when the
attack began. `promised` is what it accepts at least, from the number of lines; `held` is what a line takes, if all
beyond the constant part of that promise is due to the lines. The exit code is 1 if a peak is above what was allowed.
With `--limit GIB` the process also has a hard limit of so much address space beyond what it has then (RLIMIT_AS).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import l2p
from l2p.attacks.settings import METHODS
from l2p.work.memory import BASE, GIB, SMALLEST

CHILD = """
import json, resource, sys
import torch, scipy.spatial, l2p, l2p.attacks.run
path, method, memory, rounds, threads, limit = json.loads(sys.argv[1])
def status(name):
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) << 10 for line in file if line.startswith(name + ":"))
if threads:
    torch.set_num_threads(threads)
attack = l2p.attacks.run.named_method(method, rounds=rounds)
lines = l2p.LineCloud.load(path)
if memory == "least":
    memory = (l2p.work.memory.BASE + l2p.work.memory.SMALLEST + len(lines) * attack.line_bytes + 1) / 2**30
if limit:
    size = status("VmSize") + int(limit * 2**30)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
with open("/proc/self/clear_refs", "w") as file:
    file.write("5")
before = status("VmRSS")
result = l2p.attacks.run.run(lines, attack, memory=memory)
taken = status("VmHWM") - before
print(json.dumps({"taken": taken, "lines": len(lines), "line_bytes": attack.line_bytes, "memory": memory,
                  "seconds": result.info["seconds"], "threads": torch.get_num_threads()}))
"""


def measure(lines: Path, method: str, memory: float | str | None, given: argparse.Namespace) -> dict:
    """Bytes at the peak, seconds, and what was promised."""
    words = [str(lines), method, memory, given.rounds, given.threads, given.limit]
    command = [sys.executable, "-c", CHILD, json.dumps(words)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def row(method: str, found: dict) -> tuple[str, bool]:
    """A line of the table, and whether the attack kept to its memory."""
    promised = BASE + SMALLEST + found["lines"] * found["line_bytes"]
    held = (found["taken"] - BASE - SMALLEST) / found["lines"]
    allowed = found["memory"] * GIB if found["memory"] is not None else float("inf")
    cells = [
        method,
        f"{found['lines']:,}",
        "as large as is fast" if found["memory"] is None else f"{found['memory']:.2f}",
        f"{found['taken'] / GIB:.2f}",
        f"{promised / GIB:.2f}",
        f"{max(0, held):.0f}",
        f"{found['seconds']:.0f}",
    ]
    return f"| {' | '.join(cells)} |", found["taken"] <= allowed


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, nargs="+", default=[20_000, 200_000], help="(default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["tomography", "learned"], metavar="METHOD")
    parser.add_argument("--memory", type=float, nargs="*", default=[], metavar="GIB", help="allowed; also try these")
    parser.add_argument("--least", action="store_true", help="only with the least memory that is accepted")
    parser.add_argument("--rounds", type=int, help="rounds of refinement (default: the method's own)")
    parser.add_argument("--threads", type=int, default=0, help="CPU threads (default: what torch chooses)")
    parser.add_argument("--limit", type=float, default=0.0, metavar="GIB", help="hard limit of address space")
    return parser.parse_args()


def main() -> int:
    """Simulate and lift here, attack in a child, whose memory is the attack's alone."""
    given = arguments()
    allowed = ["least"] if given.least else [1e3, "least", *given.memory]
    print("| method | lines | allowed, GiB | peak, GiB | promised, GiB | bytes a line | seconds |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |", flush=True)
    kept = True
    with tempfile.TemporaryDirectory() as place:
        for count in given.lines:
            path = Path(place) / f"{count}.npz"
            l2p.save(l2p.lift(l2p.simulate(given.kind, points=count, seed=0).xyz, seed=0), path)
            for method in given.methods:
                for memory in allowed:
                    shown, within = row(method, measure(path, method, memory, given))
                    print(shown, flush=True)
                    kept &= within
    return int(not kept)


if __name__ == "__main__":
    sys.exit(main())
