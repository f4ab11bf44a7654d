"""Outputs are there whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from l2p.cli.main import main
from l2p.errors import InputError
from l2p.io.atomic import atomic_file, atomic_folder, check_file, check_folder
from l2p.io.recovery_files import load_recovery

NAMES = frozenset({"a.txt"})


def test_a_file_appears_only_when_it_is_complete(tmp_path):
    path = tmp_path / "out.bin"
    with atomic_file(path) as file:
        file.write(b"abc")
        file.flush()
        assert not path.exists()
    assert path.read_bytes() == b"abc"
    assert os.listdir(tmp_path) == ["out.bin"]


def half_a_file(path: Path, failure: type[BaseException]) -> None:
    with atomic_file(path, overwrite=True) as file:
        file.write(b"half")
        raise failure


def half_a_folder(path: Path, failure: type[BaseException]) -> None:
    with atomic_folder(path, overwrite=True, replaceable=NAMES) as folder:
        (folder / "a.txt").write_text("half")
        raise failure


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("write", [half_a_file, half_a_folder])
def test_a_failure_leaves_nothing_behind(tmp_path, write, failure):
    with pytest.raises(failure):
        write(tmp_path / "out", failure)
    assert os.listdir(tmp_path) == []


def test_a_failure_keeps_what_was_there(tmp_path):
    path, folder = tmp_path / "out.bin", tmp_path / "out"
    path.write_bytes(b"old")
    folder.mkdir()
    (folder / "a.txt").write_text("old")
    with pytest.raises(RuntimeError):
        half_a_file(path, RuntimeError)
    with pytest.raises(RuntimeError):
        half_a_folder(folder, RuntimeError)
    assert path.read_bytes() == b"old"
    assert (folder / "a.txt").read_text() == "old"
    assert sorted(os.listdir(tmp_path)) == ["out", "out.bin"]


def test_overwrite_replaces(tmp_path):
    path, folder = tmp_path / "out.bin", tmp_path / "out"
    path.write_bytes(b"old")
    folder.mkdir()
    (folder / "a.txt").write_text("old")
    with atomic_file(path, overwrite=True) as file:
        file.write(b"new")
    with atomic_folder(folder, overwrite=True, replaceable=NAMES) as new:
        (new / "b.txt").write_text("new")
    assert path.read_bytes() == b"new"
    assert os.listdir(folder) == ["b.txt"]
    assert sorted(os.listdir(tmp_path)) == ["out", "out.bin"]


def test_a_folder_with_foreign_files_is_never_replaced(tmp_path):
    folder = tmp_path / "home"
    folder.mkdir()
    (folder / "thesis.tex").write_text("precious")
    with pytest.raises(InputError, match=r"holds thesis\.tex, which l2p did not write there"):
        check_folder(folder, overwrite=True, replaceable=NAMES)
    with pytest.raises(InputError), atomic_folder(folder, overwrite=True, replaceable=NAMES):
        pass
    assert (folder / "thesis.tex").read_text() == "precious"


def test_an_old_folder_comes_back_when_the_new_one_cannot_be_put(tmp_path, monkeypatch):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "a.txt").write_text("old")
    replace, calls = os.replace, []

    def second_fails(source, target):
        calls.append(target)
        if len(calls) == 2:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        replace(source, target)

    monkeypatch.setattr(os, "replace", second_fails)
    with (
        pytest.raises(InputError, match="input/output error"),
        atomic_folder(folder, overwrite=True, replaceable=NAMES),
    ):
        pass
    assert (folder / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["out"]


def test_outputs_that_cannot_be_are_refused_at_once(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"file exists; choose another path, or replace it \(--force"):
        check_file(tmp_path / "file")
    with pytest.raises(InputError, match="folder is a folder; expected the name of a file"):
        check_file(tmp_path / "folder", overwrite=True)
    with pytest.raises(InputError, match=r"the folder of .*out\.npz does not exist"):
        check_file(tmp_path / "missing" / "out.npz")
    with pytest.raises(InputError, match="is not a regular file"):
        check_file("/dev/null", overwrite=True)
    with pytest.raises(InputError, match="file is a file; expected the name of a folder"):
        check_folder(tmp_path / "file", overwrite=True)
    with pytest.raises(InputError, match="folder exists; choose another path, or replace it"):
        check_folder(tmp_path / "folder")


def test_a_link_keeps_pointing_to_the_file_that_is_replaced(tmp_path):
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with atomic_file(tmp_path / "link", overwrite=True) as file:
        file.write(b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"


def test_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path, monkeypatch):
    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match=r"cannot write .*out: no space left on device"), atomic_file(tmp_path / "out"):
        pass
    with (
        pytest.raises(InputError, match=r"cannot write .*dir: no space left on device"),
        atomic_folder(tmp_path / "dir"),
    ):
        pass
    assert os.listdir(tmp_path) == []


def test_a_file_that_may_not_grow_is_one_sentence_and_leaves_nothing(tmp_path):
    """A real refusal of the system in the middle of the writing, not a simulated one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(InputError, match="file too large"), atomic_file(tmp_path / "out") as file:
            file.write(bytes(1 << 20))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert os.listdir(tmp_path) == []


def test_sigint_leaves_nothing_behind(tmp_path):
    program = textwrap.dedent(
        """
        import signal, sys, time
        from l2p.io.atomic import atomic_file
        # Jobs in the background of a shell start with SIGINT ignored.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with atomic_file(sys.argv[1]) as file:
            file.write(b"half")
            print("writing", flush=True)
            time.sleep(60)
        """
    )
    command = [sys.executable, "-c", program, str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert len(os.listdir(tmp_path)) == 1
        process.send_signal(signal.SIGINT)
        process.wait(timeout=20)
    assert os.listdir(tmp_path) == []


#: Does what the words say, and dies by SIGKILL at the n-th of the calls that touch the disk.
KILLED = """
import os, signal, sys
count = int(sys.argv[1])
def dying(function):
    def call(*arguments, **words):
        global count
        count -= 1
        if count == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **words)
    return call
os.replace, os.fsync, os.mkdir = map(dying, (os.replace, os.fsync, os.mkdir))
from l2p.cli.main import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.parametrize("step", [1, 2, 3, 4])
def test_a_kill_at_any_step_leaves_outputs_whole_or_absent(tmp_path, step):
    """Of recover with two outputs; the same command then does all of it, whatever lies beside."""
    np.savez(tmp_path / "scene.npz", xyz=np.random.default_rng(0).normal(size=(60, 3)))
    assert main(["lift", str(tmp_path / "scene.npz"), "-o", str(tmp_path / "lines.npz"), "--seed", "0"]) == 0
    words = ["recover", str(tmp_path / "lines.npz"), "-o", str(tmp_path / "out.npz"), "--method", "tomography"]
    words += ["--json", str(tmp_path / "stats.json"), "--rounds", "0"]
    done = subprocess.run([sys.executable, "-c", KILLED, str(step), *words], capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL
    there = {name: (tmp_path / name).exists() for name in ("out.npz", "stats.json")}
    assert not (there["stats.json"] and not there["out.npz"]), "figures of a recovery that is not there"
    if there["out.npz"]:
        assert len(load_recovery(tmp_path / "out.npz")) == 60
    assert main([*words, *(["--force"] if any(there.values()) else [])]) == 0
    assert len(load_recovery(tmp_path / "out.npz")) == json.loads((tmp_path / "stats.json").read_bytes())["lines"]
