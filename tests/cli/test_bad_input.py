"""Every kind of bad input: exit code 2, exactly one line on stderr that says what to do, nothing left behind."""

from __future__ import annotations

import errno
import importlib
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from l2p.cli.main import main
from l2p.schemes.hide import lift

POINTS = np.random.default_rng(0).normal(size=(60, 3))


#: The cheapest attack, where any will do.
TOMOGRAPHY = ("--method", "tomography", "--rounds", "0")


@pytest.fixture
def folder(tmp_path: Path, tiny_checkpoint: Path) -> Path:
    """A folder with a good scene, its lines, truth and recovery, a checkpoint, and every kind of bad file."""
    np.savez(tmp_path / "scene.npz", xyz=POINTS)
    words = ["lift", str(tmp_path / "scene.npz"), "-o", str(tmp_path / "lines.npz"), "--seed", "0"]
    assert main([*words, "--truth", str(tmp_path / "truth.npz")]) == 0
    recover = ["recover", str(tmp_path / "lines.npz"), "-o", str(tmp_path / "recovery.npz"), *TOMOGRAPHY]
    assert main(recover) == 0
    shutil.copy(tiny_checkpoint, tmp_path / "good.safetensors")
    (tmp_path / "cut.safetensors").write_bytes(tiny_checkpoint.read_bytes()[:200])
    (tmp_path / "foreign.safetensors").write_bytes((2).to_bytes(8, "little") + b"{}")
    _bad_lines(tmp_path)
    _bad_scenes(tmp_path)
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "lines.npz").read_bytes()[:900])
    (tmp_path / "folder").mkdir()
    return tmp_path


def _bad_lines(folder: Path) -> None:
    good = lift(POINTS, seed=0)
    arrays = {
        "direction": good.direction,
        "moment": good.moment,
        "scheme": np.array("uniform"),
        "version": np.array(1),
    }
    nan, zero, skew = np.array(good.moment), np.array(good.direction), np.array(good.moment)
    nan[4, 1], zero[5], skew[6] = np.nan, 0.0, good.direction[6]
    for name, change in {
        "nan": {"moment": nan},
        "infinite": {"moment": np.where(np.isnan(nan), np.inf, nan)},
        "zero": {"direction": zero},
        "skew": {"moment": skew},
        "lengths": {"moment": good.moment[:-1]},
        "none": {"direction": np.zeros((0, 3)), "moment": np.zeros((0, 3))},
        "newer": {"version": np.array(99)},
        "objects": {"moment": np.full((60, 3), None)},
    }.items():
        np.savez(folder / f"{name}.npz", **(arrays | change))  # type: ignore[arg-type]


def _bad_scenes(folder: Path) -> None:
    points = np.array(POINTS)
    points[[2, 8]] = np.nan
    np.savez(folder / "scene_nan.npz", xyz=points)
    np.savez(folder / "scene_none.npz", xyz=np.zeros((0, 3)))
    np.savez(folder / "scene_objects.npz", xyz=np.full((60, 3), None))
    np.savez(folder / "scene_same.npz", xyz=np.ones((60, 3)))
    np.savez(
        folder / "truth_other.npz",
        xyz=POINTS[:30],
        index=np.arange(30),
        spacing=np.array(1.0),
        version=np.array(1),
    )


def refused(folder: Path, capfd: pytest.CaptureFixture[str], *words: str) -> str:
    """Run a command that must fail, in ``folder``; give its sentence."""
    before = sorted(os.listdir(folder))
    contents = {name: (folder / name).read_bytes() for name in before if (folder / name).is_file()}
    capfd.readouterr()
    try:
        code = main(list(words))
    except SystemExit as error:
        code = error.code
    output = capfd.readouterr()
    assert code == 2
    # Once a file is read, the first line says what it was taken for.
    assert output.out == "" or re.fullmatch(r"lines\.npz: [^\n]*\n", output.out)
    assert output.err.startswith("l2p: error: ")
    assert output.err.count("\n") == 1
    assert sorted(os.listdir(folder)) == before
    assert all((folder / name).read_bytes() == content for name, content in contents.items())
    return output.err


@pytest.fixture(autouse=True)
def _inside(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("missing.npz", "missing.npz does not exist"),
        ("empty.npz", "empty.npz is empty"),
        ("cut.npz", "cut.npz is truncated or damaged; expected a complete npz file"),
        ("scene.npz", "scene.npz is a scene (npz); expected a line cloud"),
        ("truth.npz", "truth.npz is a truth (npz); expected a line cloud"),
        ("recovery.npz", "recovery.npz is a recovery (npz); expected a line cloud"),
        ("good.safetensors", "good.safetensors is a checkpoint (safetensors); expected a line cloud"),
        ("folder", "folder is a folder without points3D.bin"),
        ("objects.npz", "objects.npz holds Python objects, which l2p never loads"),
        ("nan.npz", "nan.npz: got 1 line(s) with a moment that is NaN, infinite or beyond 1e30, first at line 4; rem"),
        ("infinite.npz", "infinite.npz: got 1 line(s) with a moment that is NaN, infinite or beyond 1e30, first at"),
        ("zero.npz", "zero.npz: got 1 line(s) with a direction of length other than 1, first at line 5"),
        ("skew.npz", "skew.npz: got 1 line(s) with a moment that is not perpendicular to its direction, first at l"),
        ("lengths.npz", "lengths.npz has moment of shape (59, 3); expected (60, 3)"),
        ("none.npz", "none.npz has no lines; expected at least one"),
        ("newer.npz", "newer.npz has version 99; this l2p reads up to 1, so upgrade l2p"),
    ],
)
def test_bad_lines(folder, capfd, lines, message):
    assert message in refused(folder, capfd, "recover", lines, "-o", "out.npz")
    if "expected a line cloud" not in message:
        assert message in refused(folder, capfd, "info", lines)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ("missing.npz", "missing.npz does not exist"),
        ("empty.npz", "empty.npz is empty"),
        ("cut.npz", "cut.npz is truncated or damaged"),
        ("lines.npz", "lines.npz is a line cloud (npz); expected a scene"),
        ("good.safetensors", "good.safetensors is a checkpoint (safetensors); expected a scene"),
        ("folder", "folder is a folder without points3D.bin"),
        ("scene_nan.npz", "scene_nan.npz has 2 of 60 points that are NaN, infinite or beyond 1e30, first at row 2; re"),
        ("scene_none.npz", "scene_none.npz has no points"),
        ("scene_objects.npz", "scene_objects.npz holds Python objects"),
    ],
)
def test_bad_scenes(folder, capfd, scene, message):
    assert message in refused(folder, capfd, "lift", scene, "-o", "out.npz", "--truth", "out.truth.npz")


def test_a_scene_without_extent_has_no_truth(folder, capfd):
    words = ("lift", "scene_same.npz", "-o", "out.npz", "--truth", "out.truth.npz")
    assert "without extent" in refused(folder, capfd, *words)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--fraction", "0"], "fraction 0.0; expected a number in (0, 1]"),
        (["--fraction", "1.5"], "fraction 1.5; expected a number in (0, 1]"),
        (["--fraction", "nan"], "fraction nan"),
        (["--fraction", "many"], "argument --fraction: invalid float value: 'many'"),
        (["--scheme", "radial"], "invalid choice: 'radial'"),
        (["--seed", "-1"], "argument --seed: got -1; expected 0 to 2^63 - 1"),
        (["--rgb"], "scene.npz has no colours; leave out --rgb"),
        (["--descriptors"], "scene.npz has no descriptors; give a scene npz that has them, or a COLMAP model"),
        (["--descriptors", "lines.npz"], "got descriptors lines.npz for a scene without point ids"),
        (["--descriptors", "out.npz"], "got out.npz twice"),
        (["--truth", "out.npz"], "got out.npz twice"),
        (["--truth", "./scene.npz"], "got ./scene.npz twice"),
        (["--truth", "truth.npz"], "truth.npz exists; choose another path, or replace it (--force, overwrite=True)"),
        (["--truth", "nowhere/truth.npz"], "the folder of nowhere/truth.npz does not exist"),
        (["--bogus"], "unrecognized arguments: --bogus"),
    ],
)
def test_bad_lift_flags(folder, capfd, flags, message):
    assert message in refused(folder, capfd, "lift", "scene.npz", "-o", "out.npz", *flags)


def test_descriptors_of_scenes_with_ids(folder, capfd):
    np.savez(folder / "ids.npz", xyz=POINTS, ids=np.arange(60))
    for name, message in (
        ("missing.npz", "missing.npz does not exist; expected a file of descriptors"),
        ("folder", "folder is no regular file; expected an npz with point3D_id and descriptor, COLMAP's database.db"),
        ("good.safetensors", "good.safetensors is no file of descriptors; expected an npz"),
        ("cut.npz", "cut.npz is truncated or damaged"),
        ("lines.npz", "lines.npz has no point3D_id; expected an array of shape (any)"),
    ):
        assert message in refused(folder, capfd, "lift", "ids.npz", "-o", "out.npz", "--descriptors", name)


@pytest.mark.parametrize(
    ("output", "flag", "message"),
    [
        ("out.ply", "--descriptors", "out.ply cannot hold descriptors; write .npz, or leave them out"),
        ("out.obj", "--descriptors", "out.obj cannot hold descriptors; write .npz, or leave them out"),
        ("out.obj", "--rgb", "out.obj cannot hold colours; write .npz, or leave them out"),
    ],
)
def test_line_sets_that_cannot_hold_what_is_asked_for(folder, capfd, output, flag, message):
    assert message in refused(folder, capfd, "lift", "scene.npz", "-o", output, flag)


HEURISTIC = ("--method", "heuristic")


@pytest.mark.parametrize(
    ("output", "flags", "message"),
    [
        (
            "out.npz",
            ["--method", "magic"],
            "got method 'magic'; expected one of learned, tomography, heuristic, published, or",
        ),
        ("out.npz", ["--device", "cuda:77"], "got device 'cuda:77'; expected one of cpu"),
        ("out.npz", ["--device", "quantum"], "got device 'quantum'; expected one of cpu"),
        ("out.npz", ["--threads", "0"], "got --threads 0; expected at least 1"),
        ("out.npz", ["--rounds", "-1"], "-1 rounds; expected 0"),
        ("out.npz", [*HEURISTIC, "--fraction", "0"], "fraction 0.0; expected a number in (0, 1]"),
        ("out.npz", ["--fraction", "2"], "fraction 2.0; expected a number in (0, 1]"),
        (
            "out.npz",
            ["--scene-kind", "indoor"],
            "a scene kind for method 'learned'; expected it with",
        ),
        (
            "out.npz",
            ["--checkpoint", "good.safetensors", "--rounds", "3"],
            "got 3 rounds; expected 0 to 2",
        ),
        ("out.npz", [*HEURISTIC, "--checkpoint", "good.safetensors"], "a checkpoint for method 'heuristic'; expected"),
        ("out.npz", ["--checkpoint", "good.safetensors", "--json", "good.safetensors"], "got good.safetensors twice"),
        ("out.npz", ["--min-confidence", "2"], "--min-confidence 2.0; expected a number in [0, 1]"),
        (
            "out.npz",
            [*HEURISTIC, "--rounds", "0", "--min-confidence", "1"],
            "no point has confidence 1.0; the highest is",
        ),
        ("out.npz", ["--json", "out.npz"], "got out.npz twice"),
        ("out.npz", ["--json", "lines.npz"], "got lines.npz twice"),
        ("out.npz", ["--json", "truth.npz"], "truth.npz exists"),
        ("out.npz", ["--model", "folder"], "got --model or --truth with out.npz; expected a folder"),
        ("lines.npz", [], "got lines.npz twice"),
        ("recovery.npz", [], "recovery.npz exists; choose another path, or replace it (--force, overwrite=True)"),
        ("folder", ["--force"], ".csv, or a folder together with --model MODEL --truth TRUTH.npz"),
        ("out.pcd", [], "got -o out.pcd; expected .npz, .ply, .xyz, .txt, .csv, or a folder together with --model"),
        ("nowhere/out.npz", [], "the folder of nowhere/out.npz does not exist"),
        (
            "out",
            ["--model", "folder", "--truth", "truth.npz"],
            "folder is a folder without points3D.bin",
        ),
        (
            "folder/out",
            ["--model", "folder", "--truth", "truth.npz"],
            "folder is a folder without points3D.bin",
        ),
    ],
)
def test_bad_recover_flags(folder, capfd, output, flags, message):
    assert message in refused(folder, capfd, "recover", "lines.npz", "-o", output, *flags)


@pytest.mark.parametrize(
    ("checkpoint", "message"),
    [
        ("missing.safetensors", "missing.safetensors does not exist; expected a checkpoint file, *.safetensors"),
        ("folder", "folder is a folder; expected a checkpoint file"),
        ("empty.npz", "empty.npz is no safetensors file or is cut short"),
        ("lines.npz", "lines.npz is no safetensors file or is cut short"),
        ("cut.safetensors", "cut.safetensors is no safetensors file or is cut short"),
        ("foreign.safetensors", "foreign.safetensors is a safetensors file of another program; expected a checkpoint"),
    ],
)
def test_bad_checkpoints(folder, capfd, checkpoint, message):
    assert message in refused(folder, capfd, "recover", "lines.npz", "-o", "out.npz", "--checkpoint", checkpoint)
    if checkpoint in ("cut.safetensors", "foreign.safetensors"):
        assert message in refused(folder, capfd, "info", checkpoint)


def test_an_installation_without_weights_says_so(folder, capfd, monkeypatch):
    monkeypatch.setattr("l2p.attacks.learned.checkpoint.files", lambda package: folder)
    sentence = refused(folder, capfd, "recover", "lines.npz", "-o", "out.npz")
    assert "learned.safetensors is missing from this installation; install l2p again, give a checkpoint" in sentence


def test_an_existing_output_is_refused_before_the_work(folder, capfd, monkeypatch):
    def never(*words, **flags):
        raise AssertionError("the work has started")

    monkeypatch.setattr(importlib.import_module("l2p.attacks.run"), "run", never)
    refused(folder, capfd, "recover", "lines.npz", "-o", "recovery.npz")
    refused(folder, capfd, "recover", "lines.npz", "-o", "out.npz", "--json", "truth.npz")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["recovery.npz", "truth_other.npz"], "got 60 recovered and 30 true points"),
        (["recovery.npz", "scene.npz"], "scene.npz is a scene (npz); expected a truth npz"),
        (["lines.npz", "truth.npz"], "lines.npz is a line cloud (npz); expected a recovery npz"),
        (["good.safetensors", "truth.npz"], "good.safetensors is a checkpoint (safetensors); expected a recovery npz"),
        (["missing.npz", "truth.npz"], "missing.npz does not exist"),
        (["recovery.npz", "truth.npz", "--json", "scene.npz"], "scene.npz exists"),
        (["recovery.npz", "truth.npz", "--json", "truth.npz"], "got truth.npz twice"),
        (["recovery.npz"], "the following arguments are required: TRUTH.npz"),
    ],
)
def test_bad_evaluations(folder, capfd, words, message):
    assert message in refused(folder, capfd, "evaluate", *words)


def test_no_command_and_unknown_commands(folder, capfd):
    assert "invalid choice: 'fly'" in refused(folder, capfd, "fly")


def test_a_full_disk(folder, capfd, monkeypatch):
    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    for words in (
        ("lift", "scene.npz", "-o", "out.npz", "--truth", "out.truth.npz"),
        ("recover", "lines.npz", "-o", "out.npz", *TOMOGRAPHY, "--json", "stats.json"),
        ("recover", "lines.npz", "-o", "out.ply", *TOMOGRAPHY),
        ("evaluate", "recovery.npz", "truth.npz", "--json", "scores.json"),
    ):
        assert "no space left on device" in refused(folder, capfd, *words)


def test_permission_denied_is_a_sentence(folder, capfd, monkeypatch):
    def denied(path, *_):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr("l2p.show.tables.kind_of", denied)
    assert "l2p: error: lines.npz: permission denied" in refused(folder, capfd, "info", "lines.npz")


def test_open3d_that_does_not_load_names_its_packages(folder, capfd, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    sentence = refused(folder, capfd, "recover", "lines.npz", "-o", "out.npz", "--clean")
    assert "apt install libusb-1.0-0 libgl1 libegl1 libx11-6" in sentence
