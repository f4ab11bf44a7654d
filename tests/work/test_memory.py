"""Memory: what is free, what an attack may take of it, and that the answer does not show how much that was."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import l2p
from l2p.attacks.attack import Attack, Elements, Estimate, locate
from l2p.attacks.named import named_attack
from l2p.attacks.run import run
from l2p.attacks.settings import METHODS
from l2p.cli.main import main
from l2p.errors import InputError
from l2p.work import memory
from l2p.work.memory import BASE, GIB, SMALLEST, allotted, fitting, free_bytes
from l2p.work.work import Work

NOWHERE = Path("/nowhere")


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with 8 GiB free and no containers; files of its containers can be put into the folder."""
    (tmp_path / "meminfo").write_text("MemTotal: 9999999 kB\nMemAvailable:    8388608 kB\n")
    (tmp_path / "cgroup").write_text("")
    monkeypatch.setattr(memory, "MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(memory, "STATM", NOWHERE)
    limits = {"": ("memory.max", "memory.current"), "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes")}
    monkeypatch.setattr(memory, "_LIMITS", {kind: (tmp_path / "fs", *names) for kind, names in limits.items()})
    return tmp_path


def group(folder: Path, version: int, limit: str, usage: int, inactive: int = 0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    names = ("memory.max", "memory.current") if version == 2 else ("memory.limit_in_bytes", "memory.usage_in_bytes")
    for name, value in zip(names, (limit, usage), strict=True):
        (folder / name).write_text(f"{value}\n")
    (folder / "memory.stat").write_text(f"cache 5\n{'total_' if version == 1 else ''}inactive_file {inactive}\n")


# What is free


def test_memory_of_the_machine_is_free(machine: Path) -> None:
    assert free_bytes() == 8 * GIB


@pytest.mark.parametrize(("version", "entry"), [(2, "0::/a/b"), (1, "9:cpu:/\n4:memory:/a/b")])
def test_the_tightest_container_around_counts(machine: Path, version: int, entry: str) -> None:
    (machine / "cgroup").write_text(entry + "\n")
    group(machine / "fs" / "a" / "b", version, "max" if version == 2 else str(2**63 - 4096), 1 * GIB)
    assert free_bytes() == 8 * GIB
    group(machine / "fs" / "a", version, str(3 * GIB), 1 * GIB)
    assert free_bytes() == 2 * GIB
    group(machine / "fs", version, str(3 * GIB), 2 * GIB, inactive=GIB // 2)
    assert free_bytes() == 1.5 * GIB, "cached files are given up"


def test_a_container_that_sees_only_itself(machine: Path) -> None:
    (machine / "cgroup").write_text("0::/of/the/host\n")
    group(machine / "fs", 2, str(2 * GIB), GIB)
    assert free_bytes() == GIB


def test_where_nothing_is_known_nothing_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_free_in_machine", "_free_in_containers", "_free_address_space"):
        monkeypatch.setattr(memory, name, lambda: None)
    assert free_bytes() is None and allotted(None, 10**9, 1e4) is None


# What blocks may take


def test_blocks_are_as_large_as_is_fast_or_as_fits() -> None:
    assert fitting(100, 10, None) == 100
    assert fitting(100, 10, 500) == 50 and fitting(20, 10, 500) == 20 and fitting(100, 1e9, 500) == 1


def test_what_lines_do_not_take_is_for_blocks(machine: Path) -> None:
    least = BASE + SMALLEST + 1000 * 50
    assert allotted((least + 7) / GIB, 1000, 50) == SMALLEST + 7
    assert allotted(None, 1000, 50) == int(0.8 * 8 * GIB) - BASE - 1000 * 50
    with pytest.raises(InputError, match=r"got 0.15 GiB of memory for 1000 lines; expected at least 0.16 GiB"):
        allotted(0.15, 1000, 50)
    with pytest.raises(InputError, match=r"got 80% of the free memory, 6.40 GiB, for 1000000 lines; .* 9.47 GiB"):
        allotted(None, 10**6, 10_000)


@pytest.mark.parametrize("given", [0.0, -1.0, float("nan"), float("inf")])
def test_memory_is_a_number_above_0(given: float, scene_points: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"got a memory of .* GiB; expected a number above 0"):
        l2p.recover(l2p.lift(scene_points, seed=0), memory=given)


# The attack


@pytest.fixture(params=[1, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize("method", [name for name in METHODS if name != "published"])  # not for uniform lines
def test_the_answer_does_not_depend_on_the_memory(
    method: str, on_walls, tiny_checkpoint: Path, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the last bit, with blocks far smaller than any that are accepted; so many lines that a tree is searched."""
    lines = l2p.lift(on_walls(4200), seed=0)
    attack = named_attack(method, rounds=1, checkpoint=tiny_checkpoint if method == "learned" else None)
    whole = run(lines, attack, memory=100)
    sizes = []
    monkeypatch.setattr("l2p.attacks.run.allotted", lambda *_: sizes.append(1 << 18) or sizes[-1])
    parts = run(lines, attack, memory=1)
    assert sizes
    for name in ("beta", "confidence", "neighbors", "affinity"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name), err_msg=name)


def test_descriptors_take_memory_too(scene_points: np.ndarray) -> None:
    def least(descriptor: np.ndarray | None = None) -> float:
        with pytest.raises(InputError, match="expected at least") as refused:
            l2p.recover(l2p.lift(scene_points, seed=0, descriptor=descriptor), method="tomography", memory=0.01)
        return float(str(refused.value).split("at least ")[1].split()[0])

    some = np.zeros((len(scene_points), 20_000), dtype=np.float32)
    assert least(some) - least() == pytest.approx(20 * some.size / GIB, abs=0.02)


def test_a_method_of_ones_own_is_not_bounded(scene_points: np.ndarray) -> None:
    class Own(Attack):
        def finish(self, state: Elements, work: Work) -> Estimate:
            return locate(named_attack("tomography", rounds=0), state, work)

    assert len(run(l2p.lift(scene_points, seed=0), Own(), memory=1e-9)) == len(scene_points)


@pytest.mark.parametrize("command", ["recover", "audit"])
def test_too_little_memory_is_one_sentence_at_the_door(
    command: str, tmp_path: Path, scene_points: np.ndarray, capfd: pytest.CaptureFixture[str]
) -> None:
    l2p.save(l2p.lift(scene_points, seed=0), tmp_path / "lines.npz")
    out = tmp_path / ("out.npz" if command == "recover" else "report")
    words = [command, str(tmp_path / "lines.npz"), "-o", str(out), "--method", "tomography"]
    assert main([*words, "--memory", "0.1"]) == 2
    said = capfd.readouterr().err
    assert said.startswith(
        "l2p: error: got 0.1 GiB of memory for 400 lines; expected at least 0.16 GiB for this method"
    )
    assert said.count("\n") == 1 and not out.exists()
    assert main([*words, "--memory", "0.2"]) == 0 and out.exists()


LIMITED = """
import json, resource, sys
import numpy as np, torch, scipy.spatial
import l2p, l2p.attacks.run
lines = l2p.lift(l2p.simulate("room", points=int(sys.argv[1]), seed=0).xyz, seed=0)
status = open("/proc/self/statm").read().split()
size = int(status[0]) * resource.getpagesize() + (int(sys.argv[2]) << 30)
resource.setrlimit(resource.RLIMIT_AS, (size, size))
result = l2p.recover(lines, method="tomography", rounds=1)
print(json.dumps([len(result), bool(np.isfinite(result.xyz).all()), result.info["seconds"]]))
"""


def test_200000_lines_fit_into_4_gib() -> None:
    """Under a hard limit on the address space, which the attack finds out about; about a minute on one idle core."""
    if not memory.STATM.exists():
        pytest.skip("needs /proc of Linux")
    command = [sys.executable, "-c", LIMITED, "200000", "4"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 0, done.stderr[-500:]
    assert json.loads(done.stdout)[:2] == [200_000, True]


def test_lines_that_do_not_fit_are_refused_and_not_tried() -> None:
    if not memory.STATM.exists():
        pytest.skip("needs /proc of Linux")
    command = [sys.executable, "-c", LIMITED, "200000", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert "InputError: got 80% of the free memory, 0.80 GiB, for 200000 lines" in done.stderr
