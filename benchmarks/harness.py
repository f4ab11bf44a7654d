"""Helpers of the benchmarks: line clouds, attacks on them in child processes, alternating comparisons, tables.

Each attack runs in its own process (``attacked.py``), so that its peak memory can be measured, and with the l2p of any
checkout. A peak is the largest resident memory (VmHWM of Linux) minus the resident memory when the attack began.
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
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from rich import box
from rich.console import Console
from rich.table import Table

import l2p
from l2p.programs.scenes import scene_at
from l2p.work.resident import measured_peak, resident_gib

ROOT = Path(__file__).resolve().parents[1]
CHILD = Path(__file__).with_name("attacked.py")
#: Most characters in a row of a table.
WIDTH = 220
#: Least probability that the interval of a ratio contains the true median.
SURE = 0.93

Found = TypeVar("Found")


@dataclass(frozen=True, eq=False)
class Cloud:
    """Line cloud, and the points behind its lines if they are known.

    Its file is ``path`` + ``.npz``, its plain arrays are in ``path`` + ``.arrays.npz``.
    """

    path: Path
    lines: l2p.LineCloud
    truth: Float[np.ndarray, "lines 3"] | None


@dataclass(frozen=True)
class Setting:
    """Setting of an attack: arguments of ``l2p.recover``, threads (0: torch's choice), whether by part, checkout.

    ``method`` may name attributes that the attack sees beside the lines, as in learned+rgb+descriptor.
    """

    method: str
    rounds: int | None = None
    memory: float | None = None
    threads: int = 0
    parts: bool = False
    checkout: Path = ROOT

    @property
    def sees(self) -> list[str]:
        """Attributes that the attack sees."""
        return self.method.split("+")[1:]


@dataclass(frozen=True, eq=False)
class Run:
    """Result of one attack: wall-clock and CPU seconds, GiB at the peak (NaN if unknown), seconds by part, points."""

    seconds: float
    cpu: float
    gib: float
    threads: int
    parts: dict[str, float]
    recovery: l2p.Recovery


@dataclass(eq=False)
class Taken:
    """Figures of repeated runs, in order, and one of the runs."""

    seconds: list[float]
    cpu: list[float]
    gib: list[float]
    run: Run = field(init=False)


def hidden(scene: l2p.Scene) -> tuple[l2p.LineCloud, Float[np.ndarray, "lines 3"]]:
    """Lift points, with a fixed seed; return the line cloud with all attributes, and the point behind each line."""
    hiding = l2p.hide(scene, seed=0, rgb=scene.rgb is not None, descriptor=scene.descriptor is not None)
    return hiding.map, hiding.truth.xyz


def simulated(kind: str, count: int, folder: Path) -> Cloud:
    """Lift a simulated scene of ``count`` points, with random bytes as descriptors: good for seconds, not errors."""
    scene = l2p.simulate(kind, points=count, seed=0)
    descriptor = np.random.default_rng(0).integers(0, 120, (count, 128), dtype=np.uint8)
    described = replace(scene, descriptor=descriptor, descriptor_kind="sift")
    return _saved(f"{kind}-{count}", folder, *hidden(described))


def from_file(path: str, folder: Path) -> Cloud:
    """Read a line cloud from a file, or lift the scene in it."""
    thing = l2p.load(path)
    return _saved(
        Path(path).stem,
        folder,
        *((thing, None) if isinstance(thing, l2p.LineCloud) else hidden(scene_at(path))),
    )


def _saved(name: str, folder: Path, lines: l2p.LineCloud, truth: np.ndarray | None) -> Cloud:
    cloud = Cloud(folder / name, lines, truth)
    arrays: dict[str, Any] = {"direction": lines.direction, "moment": lines.moment}
    arrays |= {each: getattr(lines, each) for each in lines.appearance.names}
    if lines.descriptor_kind is not None:
        arrays["descriptor_kind"] = np.array(lines.descriptor_kind)
    np.savez(f"{cloud.path}.arrays.npz", **arrays)
    l2p.save(lines, f"{cloud.path}.npz")
    return cloud


class Attacker:
    """Child process that attacks a cloud at each call of ``attack``, until the ``with`` block ends."""

    def __init__(self, cloud: Cloud, setting: Setting) -> None:
        words = {"method": setting.method.split("+")[0], "rounds": setting.rounds, "memory": setting.memory}
        words = {name: value for name, value in words.items() if value is not None}
        self.path, self.checkout = cloud.path, setting.checkout
        self.job = {"words": words, "threads": setting.threads, "parts": setting.parts, "path": str(cloud.path)}
        self.job["sees"] = setting.sees

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
        """Attack once, and measure the memory of the child from this process."""
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
        """Send a line to the child; return its answer."""
        assert self.child.stdin is not None and self.child.stdout is not None
        self.child.stdin.write(word + "\n")
        self.child.stdin.flush()
        answer = self.child.stdout.readline()
        if not answer:
            raise SystemExit(f"the attack ended with exit code {self.child.wait()}")
        return json.loads(answer)


def by_turns(works: Sequence[Callable[[], Found]], repeat: int) -> list[list[Found]]:
    """Call all works ``repeat`` times, in reverse order every second time, to cancel slow drift of the machine."""
    found: list[list[Found]] = [[] for _ in works]
    for turn in range(repeat):
        for number in sorted(range(len(works)), reverse=turn % 2 == 1):
            found[number].append(works[number]())
    return found


def measured(cloud: Cloud, settings: Sequence[Setting], processes: int, again: int = 0) -> list[Taken]:
    """Attack a cloud with each setting in turn, in ``processes`` processes each, and ``again`` times more in each.

    Memory is that of the first attack of a process. Seconds are those of the later ones, if there are any: the first
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
    """Median of the ratios of pairs, and an interval that contains the true one with probability ``SURE``.

    Its ends are order statistics (sign test): the least and the greatest ratio, if there are few pairs.
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
    """Print a table in Markdown; on stderr also each row as soon as it is measured."""
    table = Table(box=box.MARKDOWN)
    for number, head in enumerate(heads):
        table.add_column(head, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        print(*row, sep="\t", file=sys.stderr, flush=True)
        table.add_row(*row)
    print(title)
    Console(width=WIDTH).print(table)
