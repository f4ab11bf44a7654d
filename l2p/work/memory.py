"""The memory limit of an attack, and the size of blocks that fits it.

An attack holds a fixed number of bytes per line, and works through blocks of lines, each with its own temporaries. The
limit less the bytes of the lines is the *room* of these blocks (:class:`l2p.work.work.Work`). It sets the size of the
blocks and never changes the result.
"""

from __future__ import annotations

import math
import numbers
import os
import re
from pathlib import Path

from l2p.errors import InputError

GIB = 1 << 30
#: Fraction of the free memory that an attack may take by default; the rest is for other processes.
SHARE = 0.8
#: Bytes of an attack besides its lines: libraries that it loads, the coarse grid, fragmentation.
BASE = 96 << 20
#: Least room in bytes; tiles, which have a fixed size, fit in it.
SMALLEST = 64 << 20
#: Linux files: free memory, memory of this process, its control groups; then limit and usage of these (version 2, 1).
MEMINFO, STATM, CGROUPS = Path("/proc/meminfo"), Path("/proc/self/statm"), Path("/proc/self/cgroup")
_LIMITS = {
    "": (Path("/sys/fs/cgroup"), "memory.max", "memory.current"),
    "memory": (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes"),
}


def fitting(most: int, each: float, room: int | None) -> int:
    """Items of ``each`` bytes per block: ``most``, which is fastest, or fewer if the room is smaller."""
    return most if room is None else max(1, min(most, int(room / max(each, 1))))


def allotted(memory: float | None, lines: int, line_bytes: float) -> int | None:
    """Compute the room of the blocks, in bytes; None if the free memory is unknown.

    Parameters
    ----------
    memory : float, optional
        GiB that the attack may take; ``SHARE`` of the free memory by default.
    lines : int
    line_bytes : float
        Bytes that the attack holds per line.

    Raises
    ------
    InputError
        If the lines do not fit, or ``memory`` is not a positive number.
    """
    if memory is None:
        free = free_bytes()
        if free is None:
            return None
        most, given = SHARE * free, f"{SHARE:.0%} of the free memory, {SHARE * free / GIB:.2f} GiB,"
    elif isinstance(memory, numbers.Real) and 0 < memory < float("inf"):
        most, given = memory * GIB, f"{memory:g} GiB of memory"
    else:
        raise InputError(f"got a memory of {memory} GiB; expected a number above 0")
    held = BASE + lines * line_bytes
    if most < held + SMALLEST:
        needed = math.ceil((held + SMALLEST) / GIB * 100) / 100
        cure = "free some of it, or allow as much (--memory, memory=)" if memory is None else "allow more"
        raise InputError(
            f"got {given} for {lines} lines; expected at least {needed:.2f} GiB for this method: {cure}, choose "
            "another method, or take fewer lines"
        )
    return int(most - held)


def free_bytes() -> int | None:
    """Bytes that this process may still take: the least of machine, containers and own limit; None if unknown."""
    known = [free for free in (_free_in_machine(), _free_in_containers(), _free_address_space()) if free is not None]
    return max(0, min(known)) if known else None


def _free_in_machine() -> int | None:
    found = re.search(r"^MemAvailable:\s*(\d+) kB", _text(MEMINFO), re.MULTILINE)
    if found:
        return int(found.group(1)) << 10
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return None


def _free_in_containers() -> int | None:
    """Least free bytes among the control groups around this process; None without a limit."""
    free = []
    for line in _text(CGROUPS).splitlines():
        _, kind, path = [*line.split(":", 2), "", ""][:3]
        if kind not in _LIMITS:
            continue
        root, limit, usage = _LIMITS[kind]
        own = root / path.lstrip("/")
        # In a container, the path may be that of the host, of which only the root is visible inside.
        for group in {root, own, *(parent for parent in own.parents if parent.is_relative_to(root))}:
            most, taken = _text(group / limit).strip(), _text(group / usage).strip()
            if most.isdecimal() and taken.isdecimal():
                free.append(int(most) - int(taken) + _reclaimable(group))
    return min(free, default=None)


def _reclaimable(group: Path) -> int:
    """Bytes of cached files in the usage of a control group; the kernel frees them when memory is short."""
    found = re.search(r"^(?:total_)?inactive_file (\d+)", _text(group / "memory.stat"), re.MULTILINE)
    return int(found.group(1)) if found else 0


def _free_address_space() -> int | None:
    try:
        import resource
    except ImportError:  # not on Unix
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    taken = _text(STATM).split()
    if limit == resource.RLIM_INFINITY or not taken:
        return None
    return limit - int(taken[0]) * resource.getpagesize()


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="ascii")
    except (OSError, ValueError):
        return ""
