"""Time, memory and bytes on the wire of an attack whose lines are shared out over processes of this machine.

    python benchmarks/shards.py --lines 3000 --processes 1 2 4

One row for each number of processes, which are started by torchrun:

- seconds of the attack, and how many of them the tomography takes;
- the peak of resident memory of the largest process (VmHWM of Linux) in MiB, beyond that of `import torch` alone;
- bytes that go through the loopback interface meanwhile (/proc/net/dev), for each line and process, with all protocols;
  other programs that talk to themselves on this machine count, too;
- bytes of the tensors that a process hands over, for each line of the cloud: in the tomography, and in all;
- cells of the tomography's finest level for each line.

Processes that share cores share their time; their memory and what they say to each other do not depend on that.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import l2p
from l2p.attacks.settings import METHODS


def peak_mib() -> float:
    """The peak of this process's resident memory (VmHWM of Linux)."""
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 2**10 for line in status if line.startswith("VmHWM"))


def loopback_bytes() -> int:
    """Bytes that went through the loopback interface since the machine was started."""
    with open("/proc/net/dev") as interfaces:
        return next(int(line.split()[9]) for line in interfaces if line.strip().startswith("lo:"))


def work(given: argparse.Namespace) -> None:
    """Do the share of this process, and write down what it took."""
    import torch

    before = peak_mib()
    from l2p.attacks.run import assist, named_method, run
    from l2p.attacks.tomography import reconstruct as tomography
    from l2p.work.journal import Rounds
    from l2p.work.processes import joined

    torch.set_num_threads(1)
    took: Counter[str] = Counter()
    update = tomography._update

    def counted(level: tomography._Level, *words: object) -> torch.Tensor:
        took["cells"] = level.cells[-1].count
        return update(level, *words)  # type: ignore[arg-type]

    tomography._update = counted
    with joined("cpu") as (shards, device):

        class Clock:
            """A progress that looks at the clock and at what was sent."""

            @contextmanager
            def task(self, name: str, total: int) -> Iterator[Callable[[int], None]]:
                start, sent = time.perf_counter(), shards.sent
                yield lambda count: None
                took[f"{name} seconds"] += time.perf_counter() - start  # type: ignore[assignment]
                took[f"{name} sent"] += shards.sent - sent

        method = named_method(given.method)
        if shards.rank == 0:
            cloud = l2p.load(Path(given.folder) / "lines.npz", l2p.LineCloud)
            wire = loopback_bytes()
            run(cloud, method, device=device, progress=Clock(), rounds=Rounds(shards))
            took["wire"] = loopback_bytes() - wire
        else:
            assist(method, shards, device=device)
        facts = {**took, "sent": shards.sent, "mib": peak_mib() - before}
        (Path(given.folder) / f"{shards.rank}.json").write_text(json.dumps(facts))


def measured(lines: Path, processes: int, given: argparse.Namespace) -> list[dict[str, float]]:
    """What each process took."""
    for old in lines.parent.glob("*.json"):
        old.unlink()
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(processes), __file__]
    if processes == 1:
        command = [sys.executable, __file__]
    subprocess.run([*command, "--folder", str(lines.parent), "--method", given.method], check=True)
    return [json.loads((lines.parent / f"{rank}.json").read_text()) for rank in range(processes)]


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, nargs="+", default=[3000], help="numbers of lines (default: %(default)s)")
    parser.add_argument(
        "--processes", type=int, nargs="+", default=[1, 2, 4], help="numbers of processes (default: %(default)s)"
    )
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--method", choices=METHODS, default="learned", help="(default: %(default)s)")
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    """Print one row for each number of lines and processes."""
    given = arguments()
    if given.folder is not None:
        work(given)
        return
    names = ("lines", "processes", "seconds", "MiB", "wire B/line", "tomography B/line", "all B/line", "cells/line")
    print(f"{given.method}, {given.kind}\n| {' | '.join(names)} |\n|{' ---: |' * len(names)}")
    for count in given.lines:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "lines.npz"
            l2p.save(l2p.lift(l2p.simulate(given.kind, points=count, seed=0).xyz, seed=0), path)
            for processes in given.processes:
                print(row(count, measured(path, processes, given)), flush=True)


def row(count: int, found: list[dict[str, float]]) -> str:
    """A row of the table."""
    first = found[0]
    seconds = sum(value for name, value in first.items() if name.endswith("seconds"))
    cells = [
        f"{count:,}",
        str(len(found)),
        f"{seconds:.1f}, {first['tomography seconds']:.1f}",
        f"{max(each['mib'] for each in found):.0f}",
        f"{first['wire'] / count / len(found):,.0f}",
        f"{first['tomography sent'] / count:,.0f}",
        f"{max(each['sent'] for each in found) / count:,.0f}",
        f"{first['cells'] / count:.1f}",
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
