"""What beside a COLMAP model would undo its hiding: every such file is named, and nothing else."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

import l2p
from l2p.io.leaks import leaks_beside

POINTS = np.random.default_rng(0).normal(size=(30, 3))


def made(path: Path, content: bytes = b"x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


@pytest.fixture
def model(tmp_path) -> Path:
    """The files of a model in project/sparse/0; their content is not looked at."""
    folder = tmp_path / "project" / "sparse" / "0"
    for name in ("cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin", "project.ini"):
        made(folder / name)
    return folder


def names(folder: Path) -> list[str]:
    return [path for path, _ in leaks_beside(folder)]


def test_a_model_gives_itself_away(model):
    assert leaks_beside(model) == [("points3D.bin", "the points"), ("images.bin", "where images see the points")]


def test_stale_copies_of_a_model_are_named(model):
    for name in ("points3D.txt", "points3D.ply", "images.txt"):
        made(model / name)
    assert names(model) == ["points3D.bin", "points3D.ply", "points3D.txt", "images.bin", "images.txt"]


@pytest.mark.parametrize("above", ["", "..", "../.."])
@pytest.mark.parametrize(
    ("name", "gives"),
    [
        ("database.db", "features of the images"),
        ("feats-superpoint-n4096-r1024.h5", "features of the images"),
        ("model.nvm", "points and features"),
        ("fused.ply", "a point cloud"),
        ("images/a.jpg", "pictures of the place"),
        ("images/left/a.jpg", "pictures of the place"),
        ("thumbs/a.jpg", "pictures of the place"),
        ("stereo/depth_maps/a.bin", "depth maps"),
    ],
)
def test_what_lies_beside_or_above_is_named(model, above, name, gives):
    made(Path(os.path.normpath(model / above / name)))
    first = name.split("/")[0] + ("/" if "/" in name else "")
    assert leaks_beside(model)[2:] == [(os.path.join(above, first), gives)]
    assert leaks_beside(os.path.relpath(model)) == leaks_beside(model), "however the model is named"


def test_the_folder_above_counts_and_no_further_one_but_that_of_sparse(tmp_path):
    made(tmp_path / "a" / "b" / "points3D.txt")
    made(tmp_path / "database.db")
    assert names(tmp_path / "a" / "b") == ["points3D.txt"]
    made(tmp_path / "a" / "database.db")
    assert names(tmp_path / "a" / "b") == ["points3D.txt", "../database.db"]


def test_line_clouds_and_recoveries_are_no_leaks_but_truths_and_scenes_are(model):
    hidden = l2p.hide(POINTS, seed=0)
    l2p.save(hidden.map, model / "lines.npz")
    l2p.save(hidden.map, model / "lines.ply")
    l2p.save(l2p.recover(hidden.map, "tomography"), model / "recovered.npz")
    made(model / "other.npz")
    assert names(model) == ["points3D.bin", "images.bin"]
    l2p.save(l2p.Truth(POINTS, np.arange(30), 1.0), model / "truth.npz")
    np.savez(model / "scene.npz", xyz=POINTS)
    np.savez(model / "descriptors.npz", point3D_id=np.arange(30), descriptor=np.ones((30, 2)))
    l2p.save(l2p.Scene(POINTS), model / "scene.ply")
    assert names(model)[2:] == ["descriptors.npz", "scene.ply", "scene.npz", "truth.npz"]


def test_many_files_of_a_kind_are_counted(model):
    for number in range(9):
        made(model / f"{number}.h5")
    assert names(model)[2:] == ["0.h5", "1.h5", "2.h5", "6 more *.h5"]


def test_empty_folders_are_no_leaks(model):
    for name in ("images", "thumbs", "stereo"):
        (model / name).mkdir()
    assert len(names(model)) == 2
