"""Resident memory: the peak of a block is its own, in this process and in another."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from l2p.work.resident import PROC, measured_peak, peak_gib, resident_gib

pytestmark = pytest.mark.skipif(not (PROC / "self" / "clear_refs").exists(), reason="needs /proc/self/clear_refs")


def test_the_peak_of_a_block_is_its_own() -> None:
    np.ones(2**28, dtype=np.uint8).sum()
    with measured_peak() as peak:
        before = peak()
        np.ones(2**27, dtype=np.uint8).sum()
        after = peak()
    assert before is not None and after is not None
    assert after - before == pytest.approx(1 / 8, abs=0.03)


def test_the_peak_of_another_process_is_seen_from_here() -> None:
    code = "held = bytes([1]) * 2**28; print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        now, peak = resident_gib(child.pid), peak_gib(child.pid)
        child.communicate(b"\n")
    assert now is not None and peak is not None
    assert peak >= now > 1 / 4


def test_a_process_that_has_ended_has_no_memory() -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert resident_gib(child.pid) is None
    with measured_peak(child.pid) as peak:
        assert peak() is None
