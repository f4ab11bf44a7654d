"""``l2p localize``: its table and files, and one sentence and exit code 2 for every bad input."""

from __future__ import annotations

import csv
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from l2p.cli.main import main
from l2p.io.colmap import read_model

#: Little work.
FEW = ("--queries", "3", "--fractions", "1", "0.5")


@pytest.fixture(autouse=True)
def folder(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the model ``room`` to work in."""
    shutil.copytree(room, tmp_path / "room")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(capfd: pytest.CaptureFixture[str], *words: str) -> str:
    """Run ``l2p localize``, which must fail and leave everything as it is; give its sentence."""
    before = sorted(os.listdir())
    capfd.readouterr()
    try:
        code = main(["localize", *words])
    except SystemExit as error:
        code = error.code
    output = capfd.readouterr()
    assert code == 2 and output.out == ""
    assert output.err.startswith("l2p: error: ") and output.err.count("\n") == 1
    assert sorted(os.listdir()) == before
    return output.err


def heads(text: str) -> str:
    """The heads of a table, whose words stand below each other where they are long."""
    rows = [line.strip("┃").split("┃") for line in text.splitlines() if line.startswith("┃")]
    return ", ".join(" ".join(" ".join(cell).split()) for cell in zip(*rows, strict=True))


def test_table_names_releases_and_their_errors(capfd):
    assert main(["localize", "room", *FEW, "--wrong", "0", "0.3"]) == 0
    text = capfd.readouterr().out
    assert "median errors of 3 queries" in text
    assert "position (% of extent), rotation (deg), within 0.1 %, within 0.5 %, within 1 %, s / query" in heads(text)
    assert text.count("uniform") == text.count("points") == 4
    assert "50 %" in text and "30 %" in text


def test_files_hold_the_figures_and_every_query(capfd):
    words = ["localize", "room", *FEW, "--json", "figures.json", "--csv", "queries.csv", "--metric"]
    assert main(words) == 0
    figures = json.loads(Path("figures.json").read_text())
    assert figures["name"] == "room" and figures["metric"] and len(figures["trials"]) == 4
    rows = list(csv.DictReader(Path("queries.csv").read_text().splitlines()))
    assert len(rows) == 4 * 3
    for trial in figures["trials"]:
        own = [row for row in rows if (row["scheme"], float(row["fraction"])) == (trial["scheme"], trial["fraction"])]
        assert trial["median_position"] == pytest.approx(np.median([float(row["position"]) for row in own]))
        assert trial["median_rotation"] == pytest.approx(np.median([float(row["rotation"]) for row in own]))
    assert "position (m), rotation (deg), within 0.25 m, 2 deg, within 0.5 m, 5 deg" in heads(capfd.readouterr().out)
    assert main([*words, "--force"]) == 0


def plain(text: str) -> dict[str, Any]:
    """Figures without times."""
    figures = json.loads(text)
    for trial in figures["trials"]:
        del trial["seconds"]
    return figures


def test_json_on_stdout_is_all_that_is_printed_and_the_same_for_a_seed(capfd):
    texts = []
    for seed in ("1", "1", "2"):
        assert main(["localize", "room", *FEW, "--seed", seed, "--json", "-"]) == 0
        texts.append(plain(capfd.readouterr().out))
    assert texts[0] == texts[1] != texts[2]


def test_schemes_gravity_and_queries_are_passed_on(capfd):
    words = ["--scheme", "uniform", "--gravity", "0", "0", "-1", "--fractions", "1", "--queries", "2", "--json", "-"]
    assert main(["localize", "room", *words]) == 0
    figures = json.loads(capfd.readouterr().out)
    assert figures["gravity_known"] and figures["queries"] == 2
    assert [trial["scheme"] for trial in figures["trials"]] == ["uniform"]


# Bad flags


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--fractions", "0"], "got fraction 0.0; expected a number in (0, 1], a share of the points"),
        (["--fractions", "1", "2"], "got fraction 2.0; expected"),
        (["--fractions", "nan"], "got fraction nan; expected"),
        (["--fractions", "half"], "invalid float value: 'half'"),
        (["--wrong", "1"], "got 1 as a share of wrong matches; expected a number in [0, 1)"),
        (["--wrong", "-0.5"], "got -0.5 as a share of wrong matches"),
        (["--wrong", "nan"], "got nan as a share of wrong matches"),
        (["--scheme", "radial"], "invalid choice: 'radial'"),
        (["--matches", "luck"], "invalid choice: 'luck'"),
        (["--queries", "0"], "got 0 queries; expected at least 1"),
        (["--gravity", "0", "0", "0"], "expected the direction of gravity in the map, three numbers"),
        (["--gravity", "0", "1"], "expected 3 arguments"),
        (["--seed", "-1"], "argument --seed: got -1; expected 0 to 2^63 - 1"),
        (["--csv", "nowhere/out.csv"], "the folder of nowhere/out.csv does not exist"),
        (["--json", "a.json", "--csv", "a.json"], "got a.json twice"),
        (["--csv", "room"], "room"),
        (["--matches", "descriptors"], "room has no features of its images in its folder or two above; expected"),
        (["--matches", "descriptors", "--features", "missing.h5"], "missing.h5 does not exist; expected COLMAP's"),
        (["--matches", "descriptors", "--features", "room"], "room has no features of images; expected COLMAP's"),
        (["--features", "missing.h5"], "got features missing.h5 for matches by tracks; expected them with matches by"),
    ],
)
def test_bad_flags(capfd, flags, message):
    assert message in refused(capfd, "room", *flags)


def test_outputs_that_exist_are_refused_before_the_work(capfd, monkeypatch):
    def never(*words, **flags):
        raise AssertionError("the work has started")

    monkeypatch.setattr("l2p.utility.releases.localize", never)
    for flag in ("--json", "--csv"):
        Path("there").write_text("kept")
        assert "there exists; choose another path, or replace it" in refused(capfd, "room", flag, "there")
        assert Path("there").read_text() == "kept"


# Bad models


def test_things_that_are_no_model(capfd):
    np.savez("scene.npz", xyz=np.random.default_rng(0).normal(size=(50, 3)))
    Path("empty").mkdir()
    Path("text.txt").write_text("nothing")
    assert "scene.npz is no COLMAP model; expected one, since its images are what is localized" in refused(
        capfd, "scene.npz"
    )
    assert "empty is a folder without points3D.bin or points3D.txt" in refused(capfd, "empty")
    assert "missing does not exist" in refused(capfd, "missing")
    assert "text.txt" in refused(capfd, "text.txt")


def written(change: Any) -> None:
    model = read_model("room")
    change(model)
    model.write_binary("room")


def seen_by(images: int) -> Any:
    """All points, with observations in so many images only."""

    def change(model: Any) -> None:
        points = [point.xyz for point in model.points3D.values()]
        for key in sorted(model.point3D_ids()):
            model.delete_point3D(key)
        for number, xyz in enumerate(points):
            track = [pycolmap.TrackElement(image, number) for image in range(1, 1 + images) if number < 40]
            model.add_point3D(xyz, pycolmap.Track(track), np.zeros(3, dtype=np.uint8))

    return change


def one_place(model: Any) -> None:
    for frame in model.frames.values():
        frame.rig_from_world = pycolmap.Rigid3d(frame.rig_from_world.rotation, np.zeros(3))


def broken_camera(model: Any) -> None:
    camera = model.cameras[1]
    camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
    camera.params = [600.0, 800.0, 600.0, float("nan")]


def no_points(model: Any) -> None:
    for key in sorted(model.point3D_ids()):
        model.delete_point3D(key)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (seen_by(0), "got a model with 0 image(s) of known pose that see points; expected at least 3"),
        (seen_by(1), "got a model with 1 image(s) of known pose that see points; expected at least 3"),
        (seen_by(2), "got a model with 2 image(s) of known pose that see points; expected at least 3"),
        (one_place, "got a model whose cameras are all at one place; expected cameras that moved"),
        (broken_camera, "which pycolmap cannot undistort; check its parameters"),
        (no_points, "room has no points"),
    ],
)
def test_models_without_queries(capfd, change, message):
    written(change)
    assert message in refused(capfd, "room")


def test_models_without_images(capfd):
    """Points alone, as exporters of point clouds write them."""
    model = pycolmap.Reconstruction()
    for xyz in np.random.default_rng(0).normal(size=(30, 3)):
        model.add_point3D(xyz, pycolmap.Track(), np.zeros(3, dtype=np.uint8))
    Path("points").mkdir()
    model.write_binary("points")
    assert "got a model with 0 image(s) of known pose that see points" in refused(capfd, "points")


# Bad features


def test_means_of_descriptors_are_no_features(capfd):
    np.savez("descriptors.npz", point3D_id=np.arange(9), descriptor=np.zeros((9, 128), dtype=np.uint8))
    words = ("room", "--matches", "descriptors", "--features", "descriptors.npz")
    assert "descriptors.npz has no features of images; expected COLMAP's database.db or hloc's" in refused(
        capfd, *words
    )


def test_features_of_other_images(capfd):
    h5py = pytest.importorskip("h5py")
    with h5py.File("feats-disk.h5", "w") as file:
        group = file.create_group("other.jpg")
        group.create_dataset("keypoints", data=np.zeros((5, 2), dtype="f4"))
        group.create_dataset("descriptors", data=np.zeros((8, 5), dtype="f4"))
    words = ("room", "--matches", "descriptors", "--features", "feats-disk.h5")
    assert "feats-disk.h5 lacks the image frame00000.jpg; give the file that the model is from" in refused(
        capfd, *words
    )


def test_poselib_that_is_not_installed_is_named(capfd, monkeypatch):
    monkeypatch.setitem(sys.modules, "poselib", None)
    assert "needs the package poselib; install it: pip install 'l2p[utility]'" in refused(capfd, "room")
