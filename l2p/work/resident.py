"""Resident memory of a process, now and at its peak, as Linux reports it in /proc/PID."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

PROC = Path("/proc")


def resident_gib(process: int | str = "self") -> float | None:
    """Resident memory of a process, GiB; None if the system does not report it or the process has ended."""
    return _entry(process, "VmRSS")


def peak_gib(process: int | str = "self") -> float | None:
    """Largest resident memory of a process, GiB, since its start or that of :func:`measured_peak`."""
    return _entry(process, "VmHWM")


@contextmanager
def measured_peak(process: int | str = "self") -> Iterator[Callable[[], float | None]]:
    """Yield a function that returns the largest resident memory (GiB) since the block began; None if unknown."""
    try:
        (PROC / str(process) / "clear_refs").write_text("5", encoding="ascii")  # resets the peak
    except OSError:
        yield lambda: None
    else:
        yield lambda: peak_gib(process)


def _entry(process: int | str, name: str) -> float | None:
    try:
        status = (PROC / str(process) / "status").read_text(encoding="ascii")
    except OSError:
        return None
    found = re.search(rf"^{name}:\s*(\d+) kB", status, re.MULTILINE)
    return int(found.group(1)) / 2**20 if found else None
