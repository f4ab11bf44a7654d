"""Memory and time of an attack on many simulated lines, in a process of its own.

    python benchmarks/memory.py --lines 100000 --method heuristic

Prints the peak of resident memory beyond that of `import torch` alone (VmHWM of Linux), and exits with 1 if it is over
the limit.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import l2p
from l2p.methods import METHODS

CHILD = """
import json, sys
import torch
def peak():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 2**20 for line in status if line.startswith("VmHWM"))
before = peak()
import l2p
if int(sys.argv[3]):
    torch.set_num_threads(int(sys.argv[3]))
result = l2p.recover(l2p.LineCloud.load(sys.argv[1]), method=sys.argv[2])
print(json.dumps({"torch": before, "peak": peak(), "seconds": result.info["seconds"], "lines": len(result),
                  "threads": torch.get_num_threads()}))
"""


def measure(lines: Path, method: str, threads: int) -> dict:
    """GiB after `import torch`, GiB at the peak, seconds."""
    command = [sys.executable, "-c", CHILD, str(lines), method, str(threads)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, default=100_000, help="number of lines (default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--method", choices=METHODS, default="heuristic", help="(default: %(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="CPU threads (default: what torch chooses)")
    parser.add_argument("--limit", type=float, default=2.0, help="GiB beyond torch (default: %(default)s)")
    return parser.parse_args()


def main() -> int:
    """Simulate and lift here, attack in a child, whose memory is the attack's alone."""
    given = arguments()
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "lines.npz"
        l2p.lift(l2p.simulate(given.kind, points=given.lines, seed=0).xyz, seed=0).save(path)
        found = measure(path, given.method, given.threads)
    beyond = found["peak"] - found["torch"]
    print(
        f"{given.method}, {found['lines']} lines, {found['threads']} thread(s): {found['seconds']:.0f} s, peak "
        f"{beyond:.2f} GiB beyond torch's own {found['torch']:.2f} GiB (limit {given.limit:g} GiB)"
    )
    return int(beyond > given.limit)


if __name__ == "__main__":
    sys.exit(main())
