"""Line clouds, attacks on them in child processes, comparisons by turns, and tables: what the benchmarks share.

An attack runs in a process of its own (``attacked.py``), so that its peak of memory is its own, and with the l2p of any
checkout. Peaks are those of resident memory (VmHWM of Linux) beyond what the process held when the attack began.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from rich import box
from rich.console import Console
from rich.table import Table

import l2p
from l2p.work.resident import measured_peak, resident_gib

ROOT = Path(__file__).resolve().parents[1]
CHILD = Path(__file__).with_name("attacked.py")
#: Characters in a row of a table at most.
WIDTH = 220
#: Least probability that the interval of a ratio holds the true median.
SURE = 0.93

Found = TypeVar("Found")


@dataclass(frozen=True, eq=False)
class Cloud:
    """A line cloud, and the points behind its lines if they are known.

    ``path`` with ``.npz`` after it is its file, with ``.arrays.npz`` its numbers as plain arrays.
    """

    path: Path
    lines: l2p.LineCloud
    truth: Float[np.ndarray, "lines 3"] | None


@dataclass(frozen=True)
class Setting:
    """How an attack runs: words of ``l2p.recover``, threads (0: torch chooses), seconds by part or not, whose l2p."""

    method: str
    rounds: int | None = None
    memory: float | None = None
    threads: int = 0
    parts: bool = False
    checkout: Path = ROOT


@dataclass(frozen=True, eq=False)
class Run:
    """One attack: wall-clock and CPU seconds, GiB at the peak (NaN if unknown), seconds by part, the points."""

    seconds: float
    cpu: float
    gib: float
    threads: int
    parts: dict[str, float]
    recovery: l2p.Recovery


@dataclass(eq=False)
class Taken:
    """Figures of repeated runs, in the order of the turns, and one of the runs."""

    seconds: list[float]
    cpu: list[float]
    gib: list[float]
    run: Run = field(init=False)


def hidden(xyz: Float[np.ndarray, "points 3"]) -> tuple[l2p.LineCloud, Float[np.ndarray, "lines 3"]]:
    """The line cloud of some points, and the point behind each line; the same each time."""
    lines, index = l2p.lift_indexed(xyz, seed=0)
    return lines, xyz[index]


def simulated(kind: str, count: int, folder: Path) -> Cloud:
    """The cloud of a simulated scene with so many points."""
    return _saved(f"{kind}-{count}", folder, *hidden(l2p.simulate(kind, points=count, seed=0).xyz))


def from_file(path: str, folder: Path) -> Cloud:
    """The line cloud of a file, or that of the scene in it."""
    thing = l2p.load(path)
    return _saved(Path(path).stem, folder, *((thing, None) if isinstance(thing, l2p.LineCloud) else hidden(thing.xyz)))


def _saved(name: str, folder: Path, lines: l2p.LineCloud, truth: np.ndarray | None) -> Cloud:
    cloud = Cloud(folder / name, lines, truth)
    np.savez(f"{cloud.path}.arrays.npz", direction=lines.direction, moment=lines.moment)
    l2p.save(lines, f"{cloud.path}.npz")
    return cloud


class Attacker:
    """A child process that attacks a cloud as often as it is asked to, until the ``with`` block ends."""

    def __init__(self, cloud: Cloud, setting: Setting) -> None:
        words = {"method": setting.method, "rounds": setting.rounds, "memory": setting.memory}
        words = {name: value for name, value in words.items() if value is not None}
        self.path, self.checkout = cloud.path, setting.checkout
        self.job = {"words": words, "threads": setting.threads, "parts": setting.parts, "path": str(cloud.path)}

    def __enter__(self) -> Attacker:
        environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, "PYTHONPATH": str(self.checkout)}
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        began = time.time()
        self.child = subprocess.Popen([sys.executable, str(CHILD)], env=environment, **pipes)
        loaded = self._asked(json.dumps({**self.job, "began": began}))["l2p"]
        if not Path(loaded).is_relative_to(self.checkout):
            self.child.kill()
            raise SystemExit(f"the child loaded {loaded}; expected the l2p of {self.checkout}")
        return self

    def __exit__(self, *_: object) -> None:
        self.child.communicate()

    def attack(self) -> Run:
        """Attack once, and look at the memory of the child from here."""
        before = resident_gib(self.child.pid)
        with measured_peak(self.child.pid) as peak:
            facts = self._asked()
            most = peak()
        facts |= self._asked()
        with np.load(f"{self.path}.found.npz") as arrays:
            recovery = l2p.Recovery(arrays["xyz"], arrays["confidence"], arrays["beta"])
        gib = float("nan") if before is None or most is None else most - before
        return Run(**facts, gib=gib, recovery=recovery)

    def _asked(self, word: str = "") -> dict[str, Any]:
        """Send a line to the child; returns its answer."""
        assert self.child.stdin is not None and self.child.stdout is not None
        self.child.stdin.write(word + "\n")
        self.child.stdin.flush()
        answer = self.child.stdout.readline()
        if not answer:
            raise SystemExit(f"the attack ended with exit code {self.child.wait()}")
        return json.loads(answer)


def by_turns(works: Sequence[Callable[[], Found]], repeat: int) -> list[list[Found]]:
    """Do all works so many times; every second time backwards, so that a slow drift of the machine cancels."""
    found: list[list[Found]] = [[] for _ in works]
    for turn in range(repeat):
        for number in sorted(range(len(works)), reverse=turn % 2 == 1):
            found[number].append(works[number]())
    return found


def measured(cloud: Cloud, settings: Sequence[Setting], processes: int, again: int = 0) -> list[Taken]:
    """Attack a cloud in each way by turns, in so many processes each, and ``again`` in each of these.

    Memory is that of the first attack of a process, seconds are those of the later ones, if there are any: the first
    one also starts threads and loads files.
    """
    taken = [Taken([], [], []) for _ in settings]
    for _ in range(processes):
        with ExitStack() as stack:
            attackers = [stack.enter_context(Attacker(cloud, setting)) for setting in settings]
            found = by_turns([attacker.attack for attacker in attackers], 1 + again)
        for each, runs in zip(taken, found, strict=True):
            counted = runs[1:] or runs
            each.seconds.extend(run.seconds for run in counted)
            each.cpu.extend(run.cpu for run in counted)
            each.gib.append(runs[0].gib)
            each.run = runs[0]
    return taken


def ratio(own: Iterable[float], other: Iterable[float]) -> str:
    """The median of the ratios of pairs, and an interval that holds the true one with probability ``SURE``.

    Its ends are order statistics (sign test): of few pairs the least and the greatest.
    """
    pairs = sorted(mine / theirs for mine, theirs in zip(own, other, strict=True))
    count, outside = len(pairs), 0
    while outside < (count - 1) // 2:
        beyond = 2 * sum(math.comb(count, number) for number in range(outside + 2)) / 2**count
        if beyond > 1 - SURE:
            break
        outside += 1
    interval = f" ({pairs[outside]:.3f}..{pairs[-1 - outside]:.3f})" if count > 1 else ""
    return f"{np.median(pairs):.3f}{interval}"


def print_table(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table that can be pasted into a page (Markdown); on stderr also each row when it is there."""
    table = Table(box=box.MARKDOWN)
    for number, head in enumerate(heads):
        table.add_column(head, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        print(*row, sep="\t", file=sys.stderr, flush=True)
        table.add_row(*row)
    print(title)
    Console(width=WIDTH).print(table)
