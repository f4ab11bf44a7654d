"""Scenes come in whole from every format, with what is known of their points; what is no scene is refused."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.io.line_files import save_lines
from l2p.io.scene_files import load_scene, load_truth, save_scene, save_truth
from l2p.maps.scene import Scene
from l2p.maps.truth import Truth
from l2p.schemes.hide import lift


def scene_of(count: int = 30) -> Scene:
    rng = np.random.default_rng(0)
    return Scene(rng.normal(size=(count, 3)), rng.integers(0, 256, size=(count, 3), dtype=np.uint8))


@pytest.mark.parametrize("text", [False, True])
def test_a_colmap_model_gives_all_that_pycolmap_knows(tmp_path, write_model, text):
    import pycolmap

    folder = write_model(tmp_path / "model", text=text)
    scene, model = load_scene(folder), pycolmap.Reconstruction(str(folder))
    assert scene.ids is not None
    assert scene.ids.tolist() == sorted(model.point3D_ids())
    assert scene.rgb is not None
    assert scene.error is not None
    assert scene.track_length is not None
    for row, key in enumerate(scene.ids):
        point = model.points3D[int(key)]
        np.testing.assert_array_equal(scene.xyz[row], point.xyz)
        np.testing.assert_array_equal(scene.rgb[row], point.color)
        assert scene.error[row] == np.float32(point.error)
        assert scene.track_length[row] == point.track.length() > 1
    centers = [image.projection_center() for _, image in sorted(model.images.items())]
    np.testing.assert_array_equal(scene.camera_centers, centers)


def test_ply_round_trip(tmp_path):
    scene = scene_of()
    save_scene(scene, tmp_path / "scene.ply")
    again = l2p.load(tmp_path / "scene.ply", Scene)
    np.testing.assert_array_equal(again.xyz, scene.xyz.astype(np.float32))
    np.testing.assert_array_equal(again.rgb, scene.rgb)


@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_ply_of_other_tools(tmp_path, order):
    from plyfile import PlyData, PlyElement

    kind = "<" if order == "ascii" else order
    vertex = np.array([(1, 2, 3, 9), (4, 5, 6, 8)], dtype=[*((name, kind + "f4") for name in "xyz"), ("quality", "u1")])
    element = PlyElement.describe(vertex, "vertex")
    PlyData([element], text=order == "ascii", byte_order=kind).write(str(tmp_path / "scene.ply"))
    scene = load_scene(tmp_path / "scene.ply")
    np.testing.assert_array_equal(scene.xyz, np.array([[1.0, 2, 3], [4, 5, 6]]), strict=True)
    assert scene.xyz.dtype.isnative
    assert scene.rgb is None


@pytest.mark.parametrize("track", ["track_len", "track_length"])
def test_npz_with_everything(tmp_path, track):
    arrays = {
        "xyz": np.ones((3, 3), dtype=np.float32),
        "rgb": np.full((3, 3), 7, dtype=np.uint8),
        "error": np.arange(3.0),
        track: np.arange(3),
        "ids": np.array([5, 3, 9], dtype=np.uint32),
        "camera_centers": np.zeros((2, 3), dtype=np.float32),
        "something": np.array(["else"]),
    }
    np.savez(tmp_path / "scene.npz", **arrays)  # type: ignore[arg-type]
    scene = load_scene(tmp_path / "scene.npz")
    assert scene.xyz.dtype == np.float64
    assert scene.error is not None
    assert scene.error.dtype == np.float32
    assert scene.track_length is not None
    assert scene.track_length.tolist() == [0, 1, 2]
    assert scene.ids is not None
    assert scene.ids.tolist() == [5, 3, 9]
    assert scene.camera_centers is not None
    assert scene.camera_centers.shape == (2, 3)


def test_the_real_scenes_are_readable(shared):
    for path in sorted(shared.glob("scenes/val/*.npz"))[:5]:
        scene = load_scene(path)
        assert len(scene) > 1000
        assert scene.rgb is not None


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"xyz": np.zeros((0, 3))}, "has no points; expected at least one"),
        ({"xyz": np.zeros((4, 2))}, r"xyz of shape \(4, 2\); expected \(any, 3\)"),
        ({"xyz": np.full((4, 3), "x")}, "xyz of type <U1; expected numbers"),
        ({"xyz": np.full((4, 3), None)}, "holds Python objects, which l2p never loads"),
        ({"xyz": np.array([[0, 0, 0], [0, np.nan, 0], [np.inf, 0, 0]])}, "2 of 3 points that are NaN, inf.* row 1"),
        ({"xyz": np.zeros((4, 3)), "rgb": np.zeros((4, 3))}, "rgb of type float64"),
        ({"xyz": np.zeros((4, 3)), "ids": np.arange(3)}, r"ids of shape \(3,\); expected \(4\)"),
        ({"points": np.zeros((4, 3))}, r"holds points; points needs directions beside it; .* xyz"),
        ({}, "holds nothing|damaged"),
    ],
)
def test_a_wrong_npz_is_named_and_explained(tmp_path, arrays, message):
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(InputError, match=f"bad.npz.*({message})"):
        load_scene(tmp_path / "bad.npz")


def test_what_is_no_scene(tmp_path):
    with pytest.raises(FileNotFoundError, match="missing does not exist"):
        load_scene(tmp_path / "missing")
    with pytest.raises(InputError, match=r"is a folder without points3D\.bin or points3D\.txt"):
        load_scene(tmp_path)
    save_lines(lift(scene_of().xyz, seed=0), tmp_path / "lines.npz")
    with pytest.raises(InputError, match=r"lines\.npz is a line cloud \(npz\); expected a scene"):
        load_scene(tmp_path / "lines.npz")
    save_lines(lift(scene_of().xyz, seed=0), tmp_path / "lines.ply")
    with pytest.raises(InputError, match=r"lines\.ply is a line cloud \(PLY\); expected a scene"):
        load_scene(tmp_path / "lines.ply")
    (tmp_path / "mesh.ply").write_text("ply\nformat ascii 1.0\nelement face 0\nproperty int a\nend_header\n")
    with pytest.raises(InputError, match=r"mesh\.ply has no vertices"):
        load_scene(tmp_path / "mesh.ply")


# A text that ends within a point, or after one, looks as if the other points had been filtered.
@pytest.mark.parametrize(("text", "share"), [(False, 0.0), (False, 0.5), (False, 0.97), (True, 0.0)])
def test_truncated_points_of_a_model_are_refused(tmp_path, write_model, capfd, text, share):
    folder = write_model(tmp_path / "model", text=text)
    file = folder / f"points3D.{'txt' if text else 'bin'}"
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match="model"):
        load_scene(folder)
    assert capfd.readouterr().err == ""


def test_truth_round_trip(tmp_path):
    xyz = scene_of().xyz
    for name, truth in {
        "full.npz": Truth(xyz, np.arange(30)[::-1], 0.5, np.arange(30) * 3, 2**63),
        "pairs.npz": Truth(xyz, np.arange(30), 0.5, element=np.arange(30) // 2),
        "bare.npz": Truth(xyz, np.arange(30), 2.0),
    }.items():
        save_truth(truth, tmp_path / name)
        again = l2p.load(tmp_path / name, Truth)
        np.testing.assert_array_equal(again.xyz, truth.xyz)
        np.testing.assert_array_equal(again.index, truth.index)
        assert (again.spacing, again.seed) == (truth.spacing, truth.seed)
        assert (again.ids is None) == (truth.ids is None)
        np.testing.assert_array_equal(again.element, truth.element)
        with np.load(tmp_path / name) as file:
            assert int(file["version"]) == (1 if name != "pairs.npz" else 2)
            assert ("element" in file) == (name == "pairs.npz")
    l2p.save(truth, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "bare.npz").read_bytes()


def test_what_is_no_truth(tmp_path):
    np.savez(tmp_path / "scene.npz", xyz=np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"scene\.npz is a scene \(npz\); expected a truth npz"):
        load_truth(tmp_path / "scene.npz")
    good = {"xyz": np.zeros((4, 3)), "index": np.arange(4), "spacing": np.array(1.0), "version": np.array(1)}
    for change, message in (
        ({"index": np.arange(3)}, r"index of shape \(3,\)"),
        ({"spacing": np.array(0.0)}, "spacing 0.0; expected a length above 0"),
        ({"spacing": np.array(np.nan)}, "spacing nan"),
        ({"version": np.array(7)}, "version 7"),
        ({"element": np.array([0, 1, -2, 3])}, "element -2"),
        ({"element": np.arange(3)}, r"element of shape \(3,\)"),
        ({"xyz": np.full((4, 3), np.nan)}, "4 of 4 points that are NaN"),
        ({"seed": np.array(0.5)}, "seed of type float64"),
    ):
        np.savez(tmp_path / "truth.npz", **(good | change))  # type: ignore[arg-type]
        with pytest.raises(InputError, match=f"truth.npz.*{message}"):
            load_truth(tmp_path / "truth.npz")


def test_a_reprojection_error_beyond_single_precision_is_infinite_without_a_warning(tmp_path, write_model):
    import pycolmap

    path = write_model(tmp_path / "model")
    model = pycolmap.Reconstruction(str(path))
    lost = min(model.point3D_ids())
    model.points3D[lost].error = 1e300
    model.write(str(path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(path)
    assert scene.error is not None and np.isinf(scene.error[0]) and np.isfinite(scene.error[1:]).all()
