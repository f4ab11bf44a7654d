"""A recovered COLMAP model: points moved, tracks and images consistent, the input untouched."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from l2p.errors import InputError
from l2p.io.colmap import save_recovered_model
from l2p.io.scene_files import load_scene


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


def recovered(folder: Path, count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Ids of some points in another order, and places for them."""
    rng = np.random.default_rng(0)
    ids = load_scene(folder).ids
    assert ids is not None
    return rng.permutation(ids)[:count], rng.normal(size=(count, 3))


@pytest.mark.parametrize("text", [False, True])
def test_points_move_and_every_track_stays_consistent(tmp_path, write_model, text):
    import pycolmap

    folder = write_model(tmp_path / "model", text=text)
    before = contents(folder)
    ids, xyz = recovered(folder)
    save_recovered_model(folder, ids, xyz, tmp_path / "out")
    model, source = pycolmap.Reconstruction(str(tmp_path / "out")), pycolmap.Reconstruction(str(folder))
    assert set(model.point3D_ids()) == set(ids.tolist())
    for key, place in zip(ids.tolist(), xyz, strict=True):
        np.testing.assert_array_equal(model.points3D[key].xyz, place)
        elements = {(element.image_id, element.point2D_idx) for element in model.points3D[key].track.elements}
        assert elements == {(e.image_id, e.point2D_idx) for e in source.points3D[key].track.elements}
        for image, keypoint in elements:
            assert model.images[image].points2D[keypoint].point3D_id == key
    seen = sum(point.has_point3D() for image in model.images.values() for point in image.points2D)
    assert seen == sum(point.track.length() for point in model.points3D.values())
    assert model.num_images() == source.num_images()
    assert all(len(image.points2D) == len(source.images[key].points2D) for key, image in model.images.items()), (
        "keypoints are kept, only what they refer to is gone"
    )
    assert contents(folder) == before
    assert set(contents(tmp_path / "out")) == set(before)


def test_errors_are_those_of_the_moved_points(tmp_path, write_model):
    import pycolmap

    folder = write_model(tmp_path / "model")
    source = pycolmap.Reconstruction(str(folder))
    ids, xyz = recovered(folder)
    xyz[0] = source.points3D[int(ids[0])].xyz
    xyz[1] = 1e3  # far out on one side: behind some of the cameras that see it
    save_recovered_model(folder, ids, xyz, tmp_path / "out")
    model = pycolmap.Reconstruction(str(tmp_path / "out"))
    assert model.points3D[int(ids[0])].error < 1e-6
    assert model.points3D[int(ids[1])].error == -1
    inside = model.points3D[int(ids[2])]
    pixel = [np.linalg.norm(_projection(model, e, inside.xyz) - _keypoint(model, e)) for e in inside.track.elements]
    assert inside.error == pytest.approx(np.mean(pixel), rel=1e-6)


def _projection(model, element, xyz):
    pixel = model.images[element.image_id].project_point(xyz)
    assert pixel is not None
    return pixel


def _keypoint(model, element):
    return model.images[element.image_id].points2D[element.point2D_idx].xy


def test_the_same_recovery_gives_the_same_bytes(tmp_path, write_model):
    folder = write_model(tmp_path / "model")
    ids, xyz = recovered(folder)
    save_recovered_model(folder, ids, xyz, tmp_path / "a")
    save_recovered_model(folder, ids, xyz, tmp_path / "b")
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_the_input_is_never_written_to(tmp_path, write_model):
    folder = write_model(tmp_path / "model")
    before = contents(folder)
    ids, xyz = recovered(folder)
    (tmp_path / "link").symlink_to(folder)
    for out in (folder, tmp_path / "link", tmp_path / "model" / ".." / "model", folder / "inside", tmp_path):
        with pytest.raises(InputError, match="share a folder; choose another output folder"):
            save_recovered_model(folder, ids, xyz, out, overwrite=True)
    assert contents(folder) == before
    assert sorted(os.listdir(tmp_path)) == ["link", "model"]


def test_only_a_model_is_replaced(tmp_path, write_model):
    folder = write_model(tmp_path / "model")
    ids, xyz = recovered(folder)
    save_recovered_model(folder, ids, xyz, tmp_path / "out")
    with pytest.raises(InputError, match="out exists; choose another path, or replace it"):
        save_recovered_model(folder, ids, xyz, tmp_path / "out")
    save_recovered_model(folder, ids[:5], xyz[:5], tmp_path / "out", overwrite=True)
    assert len(load_scene(tmp_path / "out")) == 5
    (tmp_path / "out" / "notes.md").write_text("mine")
    with pytest.raises(InputError, match=r"holds notes\.md"):
        save_recovered_model(folder, ids, xyz, tmp_path / "out", overwrite=True)


def test_wrong_ids_are_refused(tmp_path, write_model):
    folder = write_model(tmp_path / "model")
    ids, xyz = recovered(folder)
    with pytest.raises(InputError, match="20 ids and 19 points"):
        save_recovered_model(folder, ids, xyz[:19], tmp_path / "out")
    with pytest.raises(InputError, match="1 repeated point ids"):
        save_recovered_model(folder, np.append(ids[:-1], ids[0]), xyz, tmp_path / "out")
    with pytest.raises(InputError, match="lacks 1 of the 20 point ids, 99999 among them"):
        save_recovered_model(folder, np.append(ids[:-1], 99999), xyz, tmp_path / "out")
    assert os.listdir(tmp_path) == ["model"]


def test_a_model_that_was_not_written_in_full_leaves_nothing(tmp_path, write_model, monkeypatch):
    """COLMAP itself does not notice a full disk."""
    import pycolmap

    folder = write_model(tmp_path / "model")
    ids, xyz = recovered(folder)

    class Cut(pycolmap.Reconstruction):
        def write_binary(self, path):
            super().write_binary(path)
            file = Path(str(path)) / "points3D.bin"
            file.write_bytes(file.read_bytes()[:-10])

    with monkeypatch.context() as patch:
        patch.setattr(pycolmap, "Reconstruction", Cut)
        with pytest.raises(InputError, match=r"cannot write .*out: not all of the model was written"):
            save_recovered_model(folder, ids, xyz, tmp_path / "out")

    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match=r"cannot write .*out: no space left on device"):
        save_recovered_model(folder, ids, xyz, tmp_path / "out")
    assert os.listdir(tmp_path) == ["model"]
