"""A report to share is a function of the figures alone: other points, paths and machines make the same files."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy import SEES, telling_scene

import l2p
from l2p.auditing import audit as audit_module
from l2p.auditing.exposed_parts import parts_of
from l2p.auditing.report import figures_of, report_page, save_report
from l2p.auditing.sharing import holding
from l2p.auditing.tradeoff import ReleaseInputs
from l2p.cli.main import main
from l2p.cli.map_names import map_name
from l2p.simulator import simulate_model

SECRET = "kellerraum-77"


@pytest.fixture(scope="module")
def found() -> l2p.Audit:
    return l2p.audit(telling_scene(300), [1, 0.4], method=SEES, name="map")


def elsewhere(audit: l2p.Audit) -> l2p.Audit:
    """The same figures of a map whose points, lines, colours, cameras and up are all others."""
    rng = np.random.default_rng(8)
    trials = []
    for trial in audit.trials:
        assert trial.truth is not None
        count = len(trial)
        places = rng.normal(size=(count, 3)) * 1e3
        recovery = replace(trial.recovery, xyz=rng.normal(size=(count, 3)), beta=rng.normal(size=count))
        recovery = replace(recovery, info={**recovery.info, "device": "cuda:7", "host": SECRET})
        trials.append(
            replace(
                trial,
                lines=l2p.lift(places, seed=1),
                recovery=recovery,
                truth=replace(trial.truth, xyz=places),
                rgb=rng.integers(0, 256, (count, 3), dtype=np.uint8),
            )
        )
    return replace(audit, trials=tuple(trials), camera_centers=rng.normal(size=(4, 3)), up=np.array([1.0, 0, 0]))


def files_of(audit: l2p.Audit, release: ReleaseInputs = ReleaseInputs()) -> tuple[bytes, str]:
    return report_page(audit, release=release, share=True), json.dumps(figures_of(audit, release=release, share=True))


def test_a_shared_report_does_not_depend_on_a_point_a_path_or_a_machine(found, monkeypatch):
    plain = files_of(found)
    monkeypatch.setattr(
        audit_module, "machine", lambda: {"processor": SECRET, "cores": 3, "memory_gib": 1, "system": "x"}
    )
    release = ReleaseInputs(scene=f"/{SECRET}/model", drop=("--drop-ids", SECRET), unlocalized=f"no {SECRET}")
    assert files_of(elsewhere(found), release) == plain
    assert files_of(replace(found, name="other")) != plain, "its name is told, as it was chosen"


def test_a_report_that_is_not_shared_does_depend_on_them(found):
    assert report_page(elsewhere(found)) != report_page(found)
    assert figures_of(elsewhere(found)) != figures_of(found)


def test_no_coordinate_is_in_a_shared_page_in_any_form(found):
    page = report_page(found, share=True)
    whole = report_page(found)
    assert "treat it like the map" in whole.decode() and "no point of the map" in page.decode()
    assert b"view-data" in whole and b"view-data" not in page and b"<canvas" not in page
    blobs = [base64.b64decode(text) for text in re.findall(rb"base64,([A-Za-z0-9+/=]+)", page)]
    assert not any(len(blob) >= 12 * len(found.trials[-1]) for blob in blobs)
    numbers = {f"{value:.4g}" for trial in found.trials for value in trial.truth.xyz.ravel()}  # type: ignore[union-attr]
    told = set(re.findall(r"-?\d+\.\d{3,}", re.sub(rb"<svg.*?</svg>", b"", page, flags=re.DOTALL).decode()))
    assert not numbers & told


def test_parts_are_boxes_of_the_map_that_hold_their_points(found):
    parts = parts_of(found)
    trial = found.trials[0]
    assert trial.truth is not None and sum(part.points for part in parts) == len(trial)
    right = np.linalg.norm(trial.recovery.xyz - trial.truth.xyz, axis=1) <= found.spacing
    for part in parts:
        inside = np.all((trial.truth.xyz >= part.low) & (trial.truth.xyz <= part.high), axis=1)
        assert inside.sum() == part.points and right[inside].mean() == pytest.approx(part.within)
    assert [part.within for part in parts] == sorted((part.within for part in parts), reverse=True)
    assert parts_of(replace(found, trials=(replace(trial, truth=None),))) == []


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """A model whose folder, images and files of points to leave out have telling names."""
    folder = tmp_path_factory.mktemp("shared") / SECRET / "sparse" / "0"
    simulated = simulate_model("room", 300, 2)
    simulated.save_colmap(folder)
    assert simulated.scene.ids is not None
    (folder.parent / f"ids-{SECRET}.txt").write_text(" ".join(str(each) for each in simulated.scene.ids[:40]))
    return folder


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_the_command_writes_no_path_no_image_and_no_machine(model, tmp_path, monkeypatch, capsys):
    place: dict[str, Any] = {"processor": "Cray-9", "cores": 3, "memory_gib": 1, "system": SECRET}
    monkeypatch.setattr(audit_module, "machine", lambda: place)
    report = tmp_path / SECRET / "report"
    report.parent.mkdir()
    words = ("audit", model, "-o", report, "--method", "tomography", "--fractions", 1, "--queries", 2)
    words += ("--drop-ids", model.parent / f"ids-{SECRET}.txt", "--region-box", -98765.5, -9, -9, 99, 99, 99)
    assert run(*words, "--share", "--json", tmp_path / "copy.json") == 0
    assert "no point of the map" in capsys.readouterr().out
    texts = [(report / name).read_text() for name in ("index.html", "audit.json")] + [
        (tmp_path / "copy.json").read_text()
    ]
    texts += [base64.b64decode(text).decode() for text in re.findall(r"csv;base64,([A-Za-z0-9+/=]+)", texts[0])]
    for text in texts:
        for secret in (SECRET, "Cray-9", str(tmp_path), "98765", "frame0", "jpg", "sparse"):
            assert secret not in text
    assert len(texts) == 4 or pytest.importorskip("poselib") is None
    command = json.loads(texts[1])["command"]
    assert command.startswith("l2p audit MODEL -o REPORT_DIR --share --fractions 1 --drop-ids FILE --region-box X0 Y0")
    words = ("audit", model, "-o", report, "--method", "tomography", "--fractions", 0.2, "--queries", 0, "--force")
    assert run(*words) == 0
    assert "This page holds the points of your map: treat it like the map" in capsys.readouterr().out
    assert f"<h1>Privacy audit of {SECRET}</h1>" in (report / "index.html").read_text()
    assert run(*words, "--share", "--name", "the depot") == 0
    assert "<h1>Privacy audit of the depot</h1>" in (report / "index.html").read_text()


def test_a_report_of_lines_says_what_it_holds(found, tmp_path):
    lines = l2p.audit(found.trials[0].lines, method="tomography", name="map")
    assert holding(lines, False).startswith("This page holds the lines, and the points that were recovered from them")
    save_report(lines, tmp_path / "report", share=True)
    assert "<canvas" not in (tmp_path / "report" / "index.html").read_text()


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("/a/office/sparse/0", "office"),
        ("/a/office/colmap/sparse/0/", "office"),
        ("/a/office/sparse/0/points3D.bin", "office"),
        ("/a/scans/church.v2.npz", "church.v2"),
        ("/a/scans/0.npz", "0"),
        ("/sparse/0", "0"),
        ("/", "map"),
    ],
)
def test_a_map_is_named_by_its_folder(path, name):
    assert map_name(path) == name


def test_a_relative_path_is_named_by_where_it_is(tmp_path, monkeypatch):
    (tmp_path / "office" / "sparse" / "0").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "office" / "sparse")
    assert map_name("0") == map_name(".") == map_name("../sparse/0") == "office"
