"""Attack one line cloud in this process, and report seconds: the child process of ``harness.py``.

It uses public names of l2p only, so that it runs with the l2p of any checkout on PYTHONPATH. It reads a job as JSON,
then attacks once per line of stdin. Between attacks, its parent measures its memory.
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import scipy.spatial
import torch

import l2p

#: Libraries that every attack loads, imported here so that their memory is not counted as the attack's.
LIBRARIES = (torch, scipy.spatial)


class Clock:
    """Progress that adds up the seconds of each task by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def task(self, name: str, total: int) -> Iterator[Callable[[int], None]]:
        """Open a task; its steps are not counted."""
        began = time.perf_counter()
        yield lambda count: None
        self.seconds[name] += time.perf_counter() - began


def read(job: dict[str, Any], clock: Clock) -> l2p.LineCloud:
    """Read the lines from plain arrays, which work with every checkout; for seconds by part, from a file of l2p."""
    if job["parts"]:
        with clock.task("read and write", total=0):
            lines = l2p.load(job["path"] + ".npz", l2p.LineCloud)
        return lines.without({"rgb", "descriptor"} - set(job["sees"])) if hasattr(lines, "without") else lines
    with np.load(job["path"] + ".arrays.npz") as arrays:
        # Older checkouts take no descriptors.
        names = [*job["sees"], *(["descriptor_kind"] if "descriptor" in job["sees"] else [])]
        seen = {name: arrays[name] for name in names}
        if "descriptor_kind" in seen:
            seen["descriptor_kind"] = str(seen["descriptor_kind"])
        return l2p.LineCloud(arrays["direction"], arrays["moment"], **seen)


def attack(lines: l2p.LineCloud, job: dict[str, Any], clock: Clock) -> l2p.Recovery:
    """Attack once, and report wall-clock and CPU seconds."""
    words = {**job["words"], **({"progress": clock} if job["parts"] else {})}
    outside = sum(clock.seconds.values())
    began, cpu_began = time.perf_counter(), time.process_time()
    found = l2p.recover(lines, **words)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu_began
    clock.seconds["surroundings"] = seconds - (sum(clock.seconds.values()) - outside)
    answer(seconds=seconds, cpu=cpu, threads=torch.get_num_threads())
    return found


def save(found: l2p.Recovery, job: dict[str, Any], clock: Clock) -> None:
    """Write the points, and report the seconds of all parts."""
    np.savez(job["path"] + ".found.npz", xyz=found.xyz, confidence=found.confidence, beta=found.beta)
    if job["parts"]:
        with clock.task("read and write", total=0):
            l2p.save(found, job["path"] + ".recovered.npz", overwrite=True)
    answer(parts=clock.seconds)


def answer(**facts: Any) -> None:
    """Send facts to the parent."""
    print(json.dumps(facts), flush=True)


def main() -> None:
    """Serve one job until stdin ends."""
    job, clock = json.loads(sys.stdin.readline()), Clock()
    clock.seconds["start-up"] = time.time() - job["began"]
    if job["threads"]:
        torch.set_num_threads(job["threads"])
    lines = read(job, clock)
    answer(l2p=l2p.__file__)
    while sys.stdin.readline():
        found = attack(lines, job, clock)
        sys.stdin.readline()
        save(found, job, clock)
        del found


if __name__ == "__main__":
    main()
