"""Whatever bytes come in, a reader gives a result or one sentence, never another error."""

from __future__ import annotations

import contextlib
import sqlite3
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from l2p.errors import InputError, InputWarning
from l2p.io.colmap import scene_of_model
from l2p.io.descriptors import with_descriptors
from l2p.io.id_files import load_ids
from l2p.io.line_files import load_lines, save_lines
from l2p.io.recovery_files import load_recovery, save_recovery
from l2p.io.scene_files import load_scene, load_truth, save_scene, save_truth
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene
from l2p.maps.truth import Truth
from l2p.schemes.hide import lift

READERS: tuple[Callable[[Path], Any], ...] = (load_lines, load_scene, load_truth, load_recovery, load_ids)
POINTS = np.random.default_rng(0).normal(size=(5, 3))


#: Maps of other programs.
OTHERS = {
    "bundle.out": "# Bundle file v0.3\n1 1\n500 0 0\n1 0 0\n0 1 0\n0 0 1\n1 2 3\n4 5 6\n255 0 9\n1 0 7 1 2\n",
    "a.nvm": "NVM_V3\n\n1\na.jpg 500 1 0 0 0 1 2 3 0 0\n\n1\n4 5 6 255 0 9 1 0 7 1 2\n\n0\n",
    "opensfm": '[{"points": {"3": {"coordinates": [1, 2, 3], "color": [1, 2, 3]}}, '
    '"shots": {"a": {"rotation": [0, 1, 0], "translation": [1, 2, 3]}}}]',
    "openmvg": '{"sfm_data_version": "0.3", "structure": [{"key": 3, "value": {"X": [1, 2, 3], "observations": [0]}}]}',
    "points3D": "# 3D point list\n7 0.5 1 2 255 0 9 0.75 1 0 2 3\n8 0.5 1 3 255 0 9 0.75\n",
    "mesh": "v 1 2 3 0.5 0.5 1\nv 1 2 4 0.5 0.5 1\nf 1 2 2\n",
}


def _seeds() -> dict[str, bytes]:
    """A small valid file of every format."""
    lines = lift(POINTS, seed=0, rgb=np.zeros((5, 3), dtype=np.uint8))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for ending in ("npz", "ply", "obj"):
            save_lines(lines, root / f"lines.{ending}")
        save_scene(Scene(POINTS), root / "scene.ply")
        save_truth(Truth(POINTS, np.arange(5), 1.0), root / "truth.npz")
        save_recovery(Recovery(POINTS, np.ones(5, dtype=np.float32), np.zeros(5)), root / "recovery.npz")
        (root / "lines.txt").write_text("# x y z dx dy dz\n1 2 3 0 0 1\n4;5;6;1;0;0\n")
        (root / "ids.txt").write_text("# points\n17, 3 42\n")
        np.save(root / "ids.npy", np.arange(5))
        np.savez(root / "ids.npz", point3D_id=np.arange(5))
        (root / "ascii.ply").write_text(
            "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
            "element edge 1\nproperty list uchar int other\nproperty int vertex1\nproperty int vertex2\nend_header\n"
            "0 0 0\n1 1 1\n1 7 0 1\n"
        )
        for name, text in OTHERS.items():
            (root / name).write_text(text)
        return {file.name: file.read_bytes() for file in root.iterdir()}


SEEDS = _seeds()


def _read(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        path.write_bytes(content)
        for reader in READERS:
            with contextlib.suppress(InputError), warnings.catch_warnings():
                warnings.simplefilter("ignore", InputWarning)
                reader(path)


@st.composite
def mutated(draw: st.DrawFn) -> bytes:
    """A valid file with some bytes changed, a piece cut out or doubled, or the end missing."""
    content = bytearray(SEEDS[draw(st.sampled_from(sorted(SEEDS)))])
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(content) - 1)))
        piece = draw(st.integers(1, 40))
        change = draw(st.sampled_from(["set", "cut", "double", "end"]))
        if change == "set":
            content[at : at + 1] = bytes([draw(st.integers(0, 255))])
        elif change == "cut":
            del content[at : at + piece]
        elif change == "double":
            content[at:at] = content[at : at + piece]
        else:
            del content[at:]
    return bytes(content)


@given(st.binary(max_size=300) | st.text(alphabet="vl 0123456789.-/e,;#\n", max_size=200).map(str.encode))
@settings(deadline=None, max_examples=150)
def test_random_bytes(content):
    _read(content)


@given(
    st.sampled_from([b"PK\x03\x04", b"PK\x05\x06", b"\x93NUMPY\x01\x00", b"ply\n", b"ply\nformat ascii 1.0\n"]),
    st.binary(max_size=200),
)
@settings(deadline=None, max_examples=100)
def test_random_bytes_after_a_true_beginning(beginning, content):
    _read(beginning + content)


@given(mutated())
@settings(deadline=None, max_examples=400)
def test_mutated_files(content):
    _read(content)


@pytest.mark.parametrize("ending", ["db", "h5"])
@given(st.data())
@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_mutated_features(features, ending, data):
    model, scene, files = features
    content = bytearray(files[ending])
    for _ in range(data.draw(st.integers(1, 6))):
        # Most of a file are descriptors; what is damaged most is the rest.
        at = data.draw(st.integers(0, len(content) - 1) | st.integers(0, 4096))
        content[at] = data.draw(st.integers(0, 255))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        path.write_bytes(bytes(content[: data.draw(st.just(len(content)) | st.integers(16, len(content)))]))
        with contextlib.suppress(InputError):
            with_descriptors(scene, path, model)


@pytest.fixture(scope="module")
def features(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Scene, dict[str, bytes]]:
    """A model of 8 points, its scene, and a database and features of hloc."""
    import h5py
    import pycolmap

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D, options.num_frames_per_rig = 8, 2
    model = pycolmap.synthesize_dataset(options)
    folder = tmp_path_factory.mktemp("features")
    with sqlite3.connect(folder / "db") as database, h5py.File(folder / "h5", "w") as file:
        for table in ("keypoints", "descriptors"):
            database.execute(
                f"CREATE TABLE {table} (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)"
            )
        database.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE)")
        for number, image in model.images.items():
            xy = np.array([keypoint.xy for keypoint in image.points2D], dtype=np.float32)
            descriptor = np.full((len(xy), 128), number, dtype=np.uint8)
            database.execute("INSERT INTO images VALUES (?, ?)", (number, image.name))
            for table, value in (("keypoints", xy), ("descriptors", descriptor)):
                row = (number, *value.shape, value.tobytes())
                database.execute(f"INSERT INTO {table} VALUES (?, ?, ?, ?)", row)
            file[f"{image.name}/keypoints"], file[f"{image.name}/descriptors"] = xy, descriptor.T / 255
    database.close()
    return model, scene_of_model(model), {ending: (folder / ending).read_bytes() for ending in ("db", "h5")}


@pytest.mark.parametrize("text", [False, True])
@given(st.sampled_from(["points3D", "images", "cameras", "rigs", "frames"]), st.data())
@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_mutated_models(write_model, text, table, data):
    with tempfile.TemporaryDirectory() as folder:
        model = write_model(Path(folder) / "model", points=8, text=text)
        file = model / f"{table}.{'txt' if text else 'bin'}"
        content = bytearray(file.read_bytes())
        for _ in range(data.draw(st.integers(1, 3))):
            at = data.draw(st.integers(0, len(content) - 1))
            content[at] = data.draw(st.integers(0, 255))
        file.write_bytes(bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))]))
        with contextlib.suppress(InputError), warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            load_scene(model)
