"""Several releases on the command line: ``l2p recover LINES1 LINES2`` and ``l2p audit --releases``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from l2p.cli.main import main
from l2p.io.recovery_files import load_recovery
from l2p.io.scene_files import load_truth

TOMOGRAPHY = ("--method", "tomography", "--rounds", 0)


def run(*words: object) -> int:
    return main([str(word) for word in words])


@pytest.fixture
def released(tmp_path: Path) -> list[Path]:
    """Two line clouds of one scene of 300 points, and the truth of the first."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, size=(300, 3)) * [4, 3, 2]
    xyz[np.arange(300), rng.integers(0, 3, 300)] = 1.5
    np.savez(tmp_path / "scene.npz", xyz=xyz)
    files = [tmp_path / name for name in ("lines1.npz", "lines2.npz", "truth1.npz")]
    for seed, path in enumerate(files[:2]):
        truth = ("--truth", files[2]) if seed == 0 else ()
        assert run("lift", tmp_path / "scene.npz", "-o", path, "--seed", seed, *truth) == 0
    return files


def test_releases_are_recovered_together_and_evaluated_as_the_first(tmp_path, released, capsys):
    first, second, truth = released
    out = tmp_path / "out.npz"
    assert run("recover", first, second, "-o", out, *TOMOGRAPHY) == 0
    assert "300 of 300 lines meet a line of the other release" in capsys.readouterr().out
    found = load_recovery(out)
    np.testing.assert_allclose(found.xyz, load_truth(truth).xyz, atol=1e-9)
    assert found.info["releases"] == [300, 300] and found.info["met"] == 300
    assert run("evaluate", out, truth, "--json", tmp_path / "scores.json") == 0


@pytest.mark.parametrize("flags", [("--processes", 2), ("--resume",)])
def test_flags_of_one_line_cloud_are_refused(tmp_path, released, capsys, flags):
    assert run("recover", *released[:2], "-o", tmp_path / "out.npz", *flags) == 2
    assert f"got {flags[0]} with 2 line clouds; expected it with one" in capsys.readouterr().err


def test_the_same_file_twice_is_refused(tmp_path, released, capsys):
    assert run("recover", released[0], released[0], "-o", tmp_path / "out.npz", *TOMOGRAPHY) == 2
    assert "300 equal lines" in capsys.readouterr().err
    assert not (tmp_path / "out.npz").exists()


def test_an_output_that_is_the_second_release_is_refused(tmp_path, released, capsys):
    assert run("recover", *released[:2], "-o", released[1], "--force") == 2
    assert "got" in capsys.readouterr().err and released[1].exists()


def test_an_audit_tells_what_two_releases_give_away(tmp_path, released, capsys):
    report = tmp_path / "report"
    words = ("audit", tmp_path / "scene.npz", "-o", report, "--fractions", 1, 0.5, *TOMOGRAPHY)
    assert run(*words, "--releases", 2) == 0
    warning = "A map must be lifted once and for ever. If it is published twice, with fresh directions"
    assert warning in capsys.readouterr().out
    figures = json.loads((report / "audit.json").read_text())
    again = figures["published_again"]
    assert again["releases"] == 2 and [trial["fraction"] for trial in again["trials"]] == [1, 0.5]
    assert again["trials"][0]["exact"] == 1 and again["trials"][0]["met"] == 300
    assert 0.3 < again["trials"][1]["exact"] < 0.75
    assert "--releases 2" in figures["command"]
    page = (report / "index.html").read_text()
    assert warning in page.replace("\n", " ") and "Published twice" in page


def test_an_audit_of_one_release_does_not_mention_others(tmp_path, released):
    report = tmp_path / "report"
    assert run("audit", tmp_path / "scene.npz", "-o", report, "--fractions", 1, *TOMOGRAPHY) == 0
    assert json.loads((report / "audit.json").read_text())["published_again"] is None
    assert "once and for ever" not in (report / "index.html").read_text()


@pytest.mark.parametrize(("scene", "releases"), [("scene.npz", 0), ("scene.npz", 10), ("lines1.npz", 2)])
def test_wrong_numbers_of_releases_are_refused(tmp_path, released, capsys, scene, releases):
    report = tmp_path / "report"
    assert run("audit", tmp_path / scene, "-o", report, "--releases", releases, *TOMOGRAPHY) == 2
    assert "releases" in capsys.readouterr().err and not report.exists()
