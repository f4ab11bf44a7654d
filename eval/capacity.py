"""Memory: the peak of a cell, free memory, and how many cells fit side by side."""

from __future__ import annotations

import os
from collections.abc import Iterable

from l2p.work.memory import free_bytes

#: GiB per process with torch loaded, and GiB per line of its cell: more than any method of l2p needs (``line_bytes``:
#: 5 to 9 KiB).
PROCESS_GIB = 0.5
LINE_GIB = 20 / 2**20


def estimate_gib(lines: float) -> float:
    """Upper estimate of the memory of a cell with this many lines, GiB."""
    return PROCESS_GIB + LINE_GIB * lines


def fitting(lines: Iterable[float], most: int) -> int:
    """Number of cells of these sizes (lines) that fit side by side, in any order: at least 1, at most ``most``."""
    free = free_gib()
    count = 0
    for size in sorted(lines, reverse=True)[:most]:
        free -= estimate_gib(size)
        if free < 0:
            break
        count += 1
    return max(1, count)


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_gib() -> float:
    """Memory that this process may still take, GiB; infinite if unknown."""
    free = free_bytes()
    return float("inf") if free is None else free / 2**30
