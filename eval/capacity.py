"""Memory: what a cell took, what is free, and how many cells fit side by side."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from l2p.work.memory import free_bytes

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
#: Memory of a process with torch loaded, and what each line of its cell adds: above what every method of l2p takes
#: (``line_bytes``: 5 to 9 KiB).
PROCESS_GIB = 0.5
LINE_GIB = 20 / 2**20


def estimate_gib(lines: float) -> float:
    """An upper estimate of what a cell with that many lines takes."""
    return PROCESS_GIB + LINE_GIB * lines


def fitting(lines: Iterable[float], most: int) -> int:
    """How many cells of these sizes (in lines) fit side by side whatever their order: at least 1, at most ``most``."""
    free = free_gib()
    count = 0
    for size in sorted(lines, reverse=True)[:most]:
        free -= estimate_gib(size)
        if free < 0:
            break
        count += 1
    return max(1, count)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_gib() -> float:
    """Memory that is free or can be freed, in a container what it may still take; without end if nothing is known."""
    free = free_bytes()
    return float("inf") if free is None else free / 2**30


@contextmanager
def measured_peak() -> Iterator[Callable[[], float | None]]:
    """Gives a function for the largest resident memory of this process since the block began; None if nobody knows."""
    try:
        CLEAR.write_text("5", encoding="ascii")  # Linux forgets the peak so far
    except OSError:
        yield lambda: None
    else:
        yield lambda: _entry(STATUS, "VmHWM")


def _entry(path: Path, name: str) -> float | None:
    try:
        found = re.search(rf"^{name}:\s*(\d+) kB", path.read_text(encoding="ascii"), re.MULTILINE)
    except OSError:
        return None
    return int(found.group(1)) / 2**20 if found else None
