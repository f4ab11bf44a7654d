"""Runs in several processes, and runs that end before they are done."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("hydra", reason="the evaluation program needs the extra train: pip install 'l2p[train]'")

from hydra import compose, initialize_config_dir
from test_eval import TINY, rows_of, run

import eval.capacity
from eval.cells import Store, cells_of
from eval.eval_config import CONFIGS, Settings, settings_of
from eval.evaluation import plan
from eval.parallel import Failure, outcomes
from l2p.errors import InputError
from l2p.programs.scenes import scenes_of

ROOT = Path(__file__).parents[2]
#: A user's method that notes every call: a file with the process, named by the line cloud. After some calls it hangs,
#: and may interrupt the run first.
PLUGIN = """
import hashlib, os, signal, time
from pathlib import Path
import numpy as np

here = Path(__file__).parent

def attack(lines, after, interrupt=False):
    calls = here / "calls"
    count = len(list(calls.iterdir()))
    cloud = hashlib.sha256(lines.moment.tobytes()).hexdigest()[:12]
    (calls / f"{cloud}-{time.monotonic_ns()}").write_text(str(os.getpid()))
    if count >= after:
        if (here / "hang").exists():
            (here / f"hung-{os.getpid()}").touch()
            if interrupt:
                os.kill(os.getppid(), signal.SIGINT)
            time.sleep(100)
    return lines.at(np.zeros(len(lines)))
"""
#: A job is what its name says.
JOBS = """
import os, signal
from l2p.errors import InputError

def work(job):
    if job == "wrong":
        raise InputError("got a wrong job; expected another")
    if job == "broken":
        raise ZeroDivisionError("1 / 0")
    if job == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
"""
#: Columns in which two runs may differ; the sources may be edited between them.
OTHER = ("seconds", "peak_gib", "made", "commit", "code")
SEEDS = "seeds=[0,1,2,3,4,5]"


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eval.evaluation.draw_figures", lambda rows, knowing: [])


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the user's module ``hanging``, which hangs as long as the file ``hang`` is there."""
    folder = tmp_path / "plugin"
    (folder / "calls").mkdir(parents=True)
    (folder / "hanging.py").write_text(PLUGIN)
    (folder / "hang").touch()
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return folder


@pytest.fixture
def default_interrupt() -> Iterator[None]:
    """Ctrl-C as in a terminal: jobs in the background of a shell start with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def method(after: int, interrupt: bool = False) -> str:
    return f"methods=[{{name: call, path: 'hanging:attack', arguments: {{after: {after}, interrupt: {interrupt}}}}}]"


def wait_for(happened: Callable[[], bool], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.05)


def alive(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def calls(plugin: Path) -> list[str]:
    """The line clouds of all calls so far."""
    return sorted(path.name.partition("-")[0] for path in (plugin / "calls").iterdir())


def test_processes_give_the_figures_of_one(tmp_path: Path) -> None:
    methods = "methods=[{name: heuristic, rounds: 1}, {name: tomography}]"
    run(tmp_path / "one", methods)
    assert run(tmp_path / "two", methods, "processes=2") == 0
    one, two = (
        [{key: value for key, value in row.items() if key not in OTHER} for row in rows_of(path)]
        for path in (tmp_path / "one", tmp_path / "two")
    )
    assert one == two


def test_nothing_is_computed_twice_after_a_kill(tmp_path: Path, plugin: Path) -> None:
    arguments = [*TINY[:1], "fractions=[1.0]", "threads=1", SEEDS, method(after=3)]
    command = [sys.executable, "-m", "eval", *arguments, f"run={tmp_path / 'run'}", "processes=2"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        wait_for(lambda: len(list(plugin.glob("hung-*"))) == 2)
        process.kill()
    workers = {int(path.read_text()) for path in (plugin / "calls").iterdir()}
    wait_for(lambda: not any(alive(pid) for pid in workers), 10)
    done = {path: path.stat().st_mtime_ns for path in (tmp_path / "run" / "predictions").iterdir()}
    before = calls(plugin)
    # What a kill in the middle of writing leaves behind.
    (tmp_path / "run" / "predictions" / ".l2p-0123456789abcdef.tmp").write_bytes(b"half")

    (plugin / "hang").unlink()
    assert run(tmp_path / "run", "fractions=[1.0]", SEEDS, method(after=3)) == 0
    assert len(rows_of(tmp_path / "run")) == 6
    kept = {path: path.stat().st_mtime_ns for path in done if path.suffix == ".npz"}
    assert len(kept) >= 3 and kept == {path: done[path] for path in kept}
    again = [cloud for cloud in set(before) if calls(plugin).count(cloud) > 1]
    assert len(set(calls(plugin))) == 6 and len(again) == 2, "only the two that were cut off"
    assert not list((tmp_path / "run").rglob("*.tmp"))


@pytest.mark.usefixtures("default_interrupt")
def test_ctrl_c_ends_the_processes(tmp_path: Path, plugin: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "run", "fractions=[1.0]", SEEDS, method(after=2, interrupt=True), "processes=2")
    assert not multiprocessing.active_children()
    assert not list((tmp_path / "run").rglob("*.tmp"))
    assert len(list((tmp_path / "run" / "predictions").glob("*.npz"))) >= 1


@pytest.mark.parametrize("processes", [1, 2])
def test_every_job_has_its_outcome(processes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "jobs_of_a_test.py").write_text(JOBS)
    monkeypatch.syspath_prepend(tmp_path)
    work = importlib.import_module("jobs_of_a_test").work
    jobs = ["good", "wrong", "broken", "good again", "killed", "good at last"]
    jobs = jobs if processes > 1 else [job for job in jobs if job != "killed"]
    found = dict(outcomes(work, jobs, processes, 1))
    assert [job for job in jobs if found[job] is None] == ["good", "good again", "good at last"]
    assert found["wrong"] == Failure("got a wrong job; expected another")
    broken = found["broken"]
    assert broken is not None and broken.sentence == "ZeroDivisionError: 1 / 0" and "in work" in broken.place
    if processes > 1:
        killed = found["killed"]
        assert killed is not None and "exit code -9, perhaps for want of memory; try fewer processes" in killed.sentence
    assert not multiprocessing.active_children()


def test_two_runs_do_not_predict_in_one_folder(tmp_path: Path) -> None:
    tmp_path.joinpath("run").mkdir()
    with Store(tmp_path / "run").locked():
        with pytest.raises(InputError, match=r"another run is at work in .*run; wait for it"):
            run(tmp_path / "run", "methods=[{name: loo}]")
        assert run(tmp_path / "run", "methods=[{name: loo}]", "steps=[score]") == 0
    assert run(tmp_path / "run", "methods=[{name: loo}]") == 0


def settings(*overrides: str) -> Settings:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return settings_of(compose("eval", list(overrides)))


@pytest.mark.parametrize(
    ("given", "free", "expected"),
    [
        ("processes=null threads=null", 100, (8, 1)),
        ("processes=null threads=3", 100, (2, 3)),
        ("processes=null threads=16", 100, (1, 16)),
        ("processes=null threads=1", 2.0, (3, 1)),
        ("processes=null threads=null", 0.1, (1, 8)),
        ("processes=4 threads=null", 0.1, (4, 2)),
        ("processes=4 threads=3", 0.1, (4, 3)),
    ],
)
def test_processes_follow_cores_and_free_memory(
    given: str, free: float, expected: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(eval.capacity, "free_gib", lambda: free)
    monkeypatch.setattr("eval.evaluation.cores", lambda: 8)
    chosen = settings("scenes=[sim:room:2000:0]", "fractions=[1.0,0.5]", "seeds=[0,1,2]", *given.split())
    assert plan(chosen, cells_of(chosen, scenes_of(chosen.scenes, {}))) == expected


def test_cells_fit_beside_each_other_whatever_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(eval.capacity, "free_gib", lambda: 5.0)
    sizes = [500, 100_000, 500, 50_000, 500]
    count = eval.capacity.fitting(sizes, most=9)
    needed = [eval.capacity.estimate_gib(size) for size in sorted(sizes, reverse=True)]
    assert sum(needed[:count]) <= 5 < sum(needed[: count + 1])
    assert eval.capacity.fitting(sizes, most=1) == 1 == eval.capacity.fitting([], most=4)
