"""Runs that are ended and go on, and processes that die: through the command line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import l2p
from l2p.cli.main import main
from l2p.io.state_files import StateFile, state_path
from l2p.work.journal import Saved

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def lines(tmp_path: Path, scene_points: np.ndarray) -> Path:
    path = tmp_path / "lines.npz"
    l2p.save(l2p.lift(scene_points, seed=0), path)
    return path


@pytest.fixture
def others(tmp_path: Path, scene_points: np.ndarray) -> Path:
    path = tmp_path / "others.npz"
    l2p.save(l2p.lift(scene_points, seed=1), path)
    return path


def run(*words: object) -> int:
    return main([str(word) for word in words])


def end_after(rounds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C once the state after so many rounds is kept."""
    keep = StateFile.save

    def kept(self: StateFile, state: Saved) -> None:
        keep(self, state)
        if state.rounds == rounds:
            monkeypatch.setattr(StateFile, "save", keep)
            raise KeyboardInterrupt

    monkeypatch.setattr(StateFile, "save", kept)


# Going on


@pytest.mark.parametrize(
    ("method", "rounds"), [("learned", 1), ("tomography", 1), ("tomography", 2), ("heuristic", 1), ("heuristic", 3)]
)
def test_a_resumed_run_ends_with_the_same_bytes(
    tmp_path: Path,
    lines: Path,
    tiny_checkpoint: Path,
    method: str,
    rounds: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["recover", lines, "--method", method, *(["--checkpoint", tiny_checkpoint] if method == "learned" else [])]
    whole, ended = tmp_path / "whole.npz", tmp_path / "ended.npz"
    assert run(*words, "-o", whole) == 0
    end_after(rounds, monkeypatch)
    assert run(*words, "-o", ended) == 130
    state = tmp_path / "ended.npz.state"
    said = capsys.readouterr().err
    assert said == f"l2p: interrupted; start again with --resume to go on from the finished rounds in {state}\n"
    assert state.exists() and not ended.exists()
    calls = []
    monkeypatch.setattr(StateFile, "save", lambda self, saved: calls.append(saved.rounds))
    assert run(*words, "-o", ended, "--resume") == 0
    assert rounds not in calls, "it is not done again"
    assert ended.read_bytes() == whole.read_bytes()
    assert not state.exists()


def test_a_run_that_was_never_begun_begins(tmp_path: Path, lines: Path) -> None:
    out = tmp_path / "out.npz"
    assert run("recover", lines, "-o", out, "--method", "tomography", "--resume") == 0
    assert out.exists() and not state_path(out).exists()


def test_an_output_that_fails_leaves_the_rounds(
    tmp_path: Path, lines: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.npz"
    words = ["recover", lines, "-o", out, "--method", "tomography"]
    said = refused(capsys, *words, "--min-confidence", 1)
    assert "lower --min-confidence; " in said and said.endswith("out.npz.state has the rounds: add --resume\n")
    assert state_path(out).exists() and not out.exists()
    assert run(*words, "--min-confidence", 0.1, "--resume") == 0


# States that cannot be used


@pytest.fixture
def ended(tmp_path: Path, lines: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The output of a run of the heuristic that was ended after its first round."""
    end_after(1, monkeypatch)
    assert run("recover", lines, "-o", tmp_path / "out.npz", "--method", "heuristic") == 130
    return tmp_path / "out.npz"


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    capsys.readouterr()
    assert run(*words) == 2
    said = capsys.readouterr()
    assert not said.out and said.err.startswith("l2p: error: ") and said.err.count("\n") == 1
    return said.err


def test_a_state_is_not_replaced_without_being_asked(
    lines: Path, ended: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["recover", lines, "-o", ended, "--method", "heuristic"]
    before = state_path(ended).read_bytes()
    assert "add --resume to go on from them, or --force to begin again" in refused(capsys, *words)
    assert state_path(ended).read_bytes() == before
    assert run(*words, "--force") == 0 and not state_path(ended).exists()


@pytest.mark.parametrize(
    ("words", "other"),
    [
        (["--method", "tomography"], "method"),
        (["--method", "heuristic", "--rounds", 2], "rounds"),
        (["--method", "heuristic", "--scene-kind", "outdoor"], "coarse, fine, scene_kind"),
    ],
)
def test_the_state_of_another_run_is_refused(
    lines: Path, ended: Path, words: list[object], other: str, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(capsys, "recover", lines, "-o", ended, "--resume", *words)
    assert f"out.npz.state is of a run with other {other}; give those of that run" in said
    assert state_path(ended).exists()


def test_the_state_of_other_lines_is_refused(others: Path, ended: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, "recover", others, "-o", ended, "--resume", "--method", "heuristic")
    assert "is of a run with other lines" in said


def test_the_state_of_another_checkpoint_is_refused(
    tmp_path: Path,
    lines: Path,
    tiny_checkpoint: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from l2p.attacks.learned import checkpoint

    whole = checkpoint.read(tiny_checkpoint)
    with np.errstate(all="ignore"):
        next(iter(whole.network.parameters())).data.add_(0.1)
    other = tmp_path / tiny_checkpoint.name
    checkpoint.save(other, whole)
    words = ["recover", lines, "-o", tmp_path / "out.npz"]
    end_after(1, monkeypatch)
    assert run(*words, "--checkpoint", tiny_checkpoint) == 130
    said = refused(capsys, *words, "--checkpoint", other, "--resume")
    assert "is of a run with other digest; give" in said


@pytest.mark.parametrize("damage", ["cut", "parts", "about", "rounds", "nan", "version"])
def test_a_damaged_state_is_refused(lines: Path, ended: Path, damage: str, capsys: pytest.CaptureFixture[str]) -> None:
    state = state_path(ended)
    with np.load(state) as file:
        arrays = dict(file)
    arrays |= {
        "parts": {"part_beta": arrays["part_beta"][:-1]},
        "about": {"about": np.array("{")},
        "rounds": {"rounds": np.array(0)},
        "nan": {"part_beta": np.full_like(arrays["part_beta"], np.nan)},
        "version": {"version": np.array(99)},
    }.get(damage, {})
    with state.open("wb") as file:
        np.savez(file, **arrays)
    if damage == "cut":
        state.write_bytes(state.read_bytes()[:200])
    said = refused(capsys, "recover", lines, "-o", ended, "--resume", "--method", "heuristic")
    assert "state" in said and ("damaged" in said or "version 99" in said)


def test_a_state_is_no_input_and_no_other_output(
    tmp_path: Path, lines: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.npz"
    words = ["recover", lines, "-o", out, "--force"]
    assert "out.npz.state twice" in refused(capsys, *words, "--json", state_path(out))
    state_path(out).mkdir()
    assert "out.npz.state is a folder" in refused(capsys, *words)


# Processes


@pytest.mark.parametrize(
    ("words", "environment", "message"),
    [
        (["--processes", 0], {}, "got --processes 0; expected at least 1"),
        (["--processes", 5000], {}, "got --processes 5000; expected at least 1, at most 1024"),
        (["--device", "mps"], {"WORLD_SIZE": "2"}, "got device 'mps' for several processes; expected cpu, or cuda"),
        ([], {"WORLD_SIZE": "2"}, "the processes did not find each other"),
    ],
)
def test_processes_that_cannot_work_are_refused(
    tmp_path: Path,
    lines: Path,
    words: list[object],
    environment: dict[str, str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert message in refused(capsys, "recover", lines, "-o", tmp_path / "out.npz", *words)
    assert not (tmp_path / "out.npz").exists()


def started(launcher: list[str], words: list[object]) -> subprocess.Popen[str]:
    """Two processes of this machine."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    environment.pop("WORLD_SIZE", None)
    command = [sys.executable, "-m", *launcher, "recover", *map(str, words)]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


TORCHRUN = ["torch.distributed.run", "--nproc-per-node", "2", "-m", "l2p"]


def of_rank(launcher: int, rank: int) -> int:
    """The process of that rank among the children of a launcher."""
    for child in Path(f"/proc/{launcher}/task/{launcher}/children").read_text().split():
        if f"RANK={rank}".encode() in Path(f"/proc/{child}/environ").read_bytes().split(b"\0"):
            return int(child)
    raise ProcessLookupError


def killed(launcher: list[str], words: list[object], out: Path) -> str:
    """What is said when the second of two processes is killed after the first round."""
    with started(launcher, words) as running:
        until = time.monotonic() + 120
        while not state_path(out).exists() and running.poll() is None and time.monotonic() < until:
            time.sleep(0.01)
        os.kill(of_rank(running.pid, 1), signal.SIGKILL)
        answer, said = running.communicate(timeout=60)
    assert running.returncode == 1 and not answer
    assert not out.exists() and state_path(out).exists() and not list(out.parent.glob(".l2p-*"))
    return said


def test_a_killed_process_ends_all_with_one_sentence_and_the_run_goes_on(tmp_path: Path, lines: Path) -> None:
    """Ended under one launcher, it goes on under the other, to the bytes of one process."""
    out, whole = tmp_path / "out.npz", tmp_path / "whole.npz"
    said = killed(["l2p"], [lines, "-o", out, "--processes", 2], out)
    assert said == (
        "l2p: error: process 1 of 2 was ended by SIGKILL; start again with --resume to go on from the last finished "
        "round\n"
    )
    with started(TORCHRUN, [lines, "-o", out, "--resume"]) as running:
        answer, said = running.communicate(timeout=120)
    assert running.returncode == 0, said
    assert answer.count(f"{out}: 400 points") == 1, "one process speaks"
    assert run("recover", lines, "-o", whole) == 0
    assert out.read_bytes() == whole.read_bytes()
    assert not state_path(out).exists()


def test_under_torchrun_one_sentence_is_said_before_its_own_report(tmp_path: Path, lines: Path) -> None:
    out = tmp_path / "out.npz"
    said = killed(TORCHRUN, [lines, "-o", out], out).splitlines()
    (ours,) = [line for line in said if line.startswith("l2p: ")]
    assert "start again with --resume" in ours
    assert sum(line.startswith("Traceback") for line in said) == 1, "that of torchrun itself"
