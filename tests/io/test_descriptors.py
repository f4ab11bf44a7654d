"""Descriptors are means over tracks, from any of their files, and features of another model are refused."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.io.colmap import read_model
from l2p.io.descriptors import file_beside, load_described, with_descriptors
from l2p.io.scene_files import load_scene

#: The tables of COLMAP that matter here.
TABLES = """
CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY, {type} rows INTEGER, cols INTEGER, data BLOB);
"""


@dataclass
class Images:
    """Features of the images of a model, by name: places and descriptors of the keypoints."""

    model: Any
    xy: dict[str, np.ndarray] = field(default_factory=dict)
    descriptor: dict[str, np.ndarray] = field(default_factory=dict)

    def means(self, points: Sequence[int]) -> np.ndarray:
        """Mean over the track of each point, in double precision."""
        tracks = ([self._one(e) for e in self.model.points3D[key].track.elements] for key in points)
        return np.array([np.mean(track, axis=0) for track in tracks])

    def _one(self, element: Any) -> np.ndarray:
        return self.descriptor[self.model.images[element.image_id].name][element.point2D_idx].astype(np.float64)


def half_up(mean: np.ndarray) -> np.ndarray:
    return np.floor(mean + 0.5).astype(np.uint8)


def features_of(model: Any, make: Callable[[np.random.Generator, int], np.ndarray]) -> Images:
    images, rng = Images(model), np.random.default_rng(3)
    for image in model.images.values():
        images.xy[image.name] = np.array([keypoint.xy for keypoint in image.points2D])
        images.descriptor[image.name] = make(rng, len(image.points2D))
    return images


def sift(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(0, 256, (count, 128), dtype=np.uint8)


def unit(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.normal(size=(count, 256)) + 0.5
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16)


@pytest.fixture
def model(tmp_path: Path, write_model: Callable[..., Path]) -> Path:
    """``project/sparse/0`` with images in subfolders, as COLMAP and hloc have them."""
    (tmp_path / "project" / "sparse").mkdir(parents=True)
    folder = write_model(tmp_path / "project" / "sparse" / "0")
    reconstruction = read_model(folder)
    for number, image in enumerate(reconstruction.images.values()):
        image.name = f"mapping/night {number % 2}/{number}.jpg"
    reconstruction.write_binary(str(folder))
    return folder


@pytest.fixture
def images(model: Path) -> Images:
    return features_of(read_model(model), sift)


def write_database(path: Path, images: Images, kind: int | None = 0, names: Sequence[str] | None = None) -> Path:
    """Write a database with other image ids than the model; ``kind`` None writes that of COLMAP 3."""
    with sqlite3.connect(path) as database:
        database.executescript(TABLES.format(type="" if kind is None else "type INTEGER,"))
        for number, name in enumerate(sorted(images.xy if names is None else names)):
            database.execute("INSERT INTO images VALUES (?, ?)", (1000 - number, name))
            # As COLMAP does: place, and shape of the keypoint.
            keypoint = np.concatenate([images.xy[name], np.ones((len(images.xy[name]), 4))], axis=1)
            row = (1000 - number, len(keypoint), 6, keypoint.astype("<f4").tobytes())
            database.execute("INSERT INTO keypoints VALUES (?, ?, ?, ?)", row)
            data = images.descriptor[name]
            value = (1000 - number, *(() if kind is None else (kind,)), len(data), data[:1].nbytes, data.tobytes())
            database.execute(f"INSERT INTO descriptors VALUES ({', '.join('?' * len(value))})", value)
    database.close()
    return path


def write_hloc(path: Path, images: Images, shift: float = -0.5, dtype: str = "f4") -> Path:
    """Write features as hloc does: keypoints before it adds 0.5, descriptors in columns."""
    with h5py.File(path, "w") as file:
        for name, xy in images.xy.items():
            group = file.create_group(name)
            group.create_dataset("keypoints", data=(xy + shift).astype(dtype))
            group.create_dataset("descriptors", data=images.descriptor[name].T)
            group.create_dataset("scores", data=np.ones(len(xy), dtype="f2"))
            group.create_dataset("image_size", data=np.array([640, 480]))
    return path


def described(model: Path, path: Path) -> Any:
    return load_described(model, path)[0]


def read(model: Path) -> Any:
    """The scene of a model; of type Any, as its attributes are all there."""
    return load_scene(model)


# Means over tracks


@pytest.mark.parametrize("kind", [None, -1, 0])
def test_a_database_gives_the_mean_of_each_track(model, images, kind):
    scene = described(model, write_database(model / "any.name", images, kind))
    assert scene.descriptor is not None and scene.descriptor.dtype == np.uint8 and scene.descriptor_kind == "sift"
    np.testing.assert_array_equal(scene.descriptor, half_up(images.means(scene.ids.tolist())))
    np.testing.assert_array_equal(scene.rgb, read(model).rgb)


def test_a_database_that_colmap_wrote_is_read_and_not_touched(tmp_path):
    """pycolmap writes it in a process of its own: its database and sqlite3 in one process can crash at the end."""
    program = """
import sys, pycolmap
pycolmap.set_random_seed(1)
options = pycolmap.SyntheticDatasetOptions()
options.num_points3D, options.num_frames_per_rig = 30, 3
with pycolmap.Database.open(sys.argv[1] + "/database.db") as database:
    pycolmap.synthesize_dataset(options, database).write_text(sys.argv[1])
    import numpy
    numpy.savez(sys.argv[1] + "/read.npz", **{
        image.name: database.read_descriptors(image.image_id).data for image in database.read_all_images()
    })
"""
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=True)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    scene, source = described(tmp_path, tmp_path / "database.db"), load_described(tmp_path)[1]
    assert source == tmp_path / "database.db" and scene.descriptor_kind == "sift"
    with np.load(tmp_path / "read.npz") as stored:
        images = Images(read_model(tmp_path), descriptor={name: stored[name] for name in stored})
    np.testing.assert_array_equal(scene.descriptor, half_up(images.means(scene.ids.tolist())))
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_learned_descriptors_of_colmap_are_floats_as_bytes(model, number):
    images = features_of(read_model(model), lambda rng, count: unit(rng, count).astype(np.float32))
    scene = described(model, write_database(model / "database.db", images, number))
    assert scene.descriptor.dtype == np.float32 and scene.descriptor.shape[1] == 256
    assert scene.descriptor_kind == ["aliked-n16rot", "aliked-n32", "loma-b", "loma-b128"][number - 1]
    mean = images.means(scene.ids.tolist())
    np.testing.assert_allclose(scene.descriptor, mean / np.linalg.norm(mean, axis=1, keepdims=True), atol=2e-3)


@pytest.mark.parametrize(
    ("name", "kind"), [("feats-superpoint-n4096-r1024", "superpoint"), ("my feats-disk", "unknown")]
)
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_features_of_hloc_give_unit_means(model, name, kind, dtype):
    images = features_of(read_model(model), unit)
    scene = described(model, write_hloc(model / f"{name}.h5", images, dtype=dtype))
    assert scene.descriptor.dtype == np.float32 and scene.descriptor_kind == kind
    mean = images.means(scene.ids.tolist())
    np.testing.assert_allclose(scene.descriptor, mean / np.linalg.norm(mean, axis=1, keepdims=True), atol=1e-3)
    assert np.abs(np.linalg.norm(scene.descriptor, axis=1) - 1).max() < 1e-2


def test_the_word_in_a_file_name_is_published_only_if_it_is_a_kind(model):
    images = features_of(read_model(model), unit)
    assert described(model, write_hloc(model / "feats-acmeheadquarters.h5", images)).descriptor_kind == "unknown"


def test_other_lengths_are_not_changed(model):
    images = features_of(read_model(model), lambda rng, count: rng.normal(size=(count, 5)).astype("f4"))
    scene = described(model, write_hloc(model / "feats.h5", images))
    np.testing.assert_allclose(scene.descriptor, images.means(scene.ids.tolist()), atol=5e-3)


def test_a_point_twice_in_an_image_counts_both(model, images):
    reconstruction = images.model
    key = next(iter(reconstruction.point3D_ids()))
    image = reconstruction.images[reconstruction.points3D[key].track.elements[0].image_id]
    free = next(i for i, keypoint in enumerate(image.points2D) if not keypoint.has_point3D())
    import pycolmap

    reconstruction.add_observation(key, pycolmap.TrackElement(image.image_id, free))
    scene: Any = with_descriptors(read(model), write_database(model / "d.db", images), reconstruction)
    np.testing.assert_array_equal(scene.descriptor, half_up(images.means(scene.ids.tolist())))


def test_images_that_the_file_lacks_do_not_matter_while_each_point_has_one(model, images):
    name = sorted(images.xy)[0]
    scene = described(model, write_database(model / "d.db", images, names=sorted(images.xy)[1:]))
    unseen = images.model.images[next(i for i, image in images.model.images.items() if image.name == name)]
    touched = {keypoint.point3D_id for keypoint in unseen.points2D if keypoint.has_point3D()}
    same = ~np.isin(scene.ids, sorted(touched))
    np.testing.assert_array_equal(scene.descriptor[same], half_up(images.means(scene.ids.tolist()))[same])
    assert 0 < same.sum() < len(scene)


# Keypoints that the model has dropped, so that they are found by place


def more_keypoints(images: Images, rng: np.random.Generator) -> Images:
    """The same features among others, in another order: what a model with dropped keypoints was made from."""
    full = Images(images.model)
    for name, xy in images.xy.items():
        order = rng.permutation(len(xy) + 9)
        other = rng.uniform(0, 500, (9, 2))
        full.xy[name] = np.concatenate([xy, other])[order]
        full.descriptor[name] = np.concatenate([images.descriptor[name], images.descriptor[name][:9]])[order]
    return full


@pytest.mark.parametrize("shift", [0.0, -0.5])
def test_dropped_keypoints_are_found_by_place(model, images, rng, shift):
    full = more_keypoints(images, rng)
    expected = half_up(images.means(read(model).ids.tolist()))
    np.testing.assert_array_equal(described(model, write_hloc(model / "a.h5", full, shift)).descriptor, expected)
    if shift == 0:
        np.testing.assert_array_equal(described(model, write_database(model / "d.db", full)).descriptor, expected)


def test_half_precision_of_hloc_is_found_by_place(model, images, rng):
    """hloc adds 0.5 in the precision of the file, where it may round."""
    for image in images.model.images.values():
        for keypoint, xy in zip(image.points2D, images.xy[image.name], strict=True):
            half = (xy - 0.5).astype(np.float16)
            keypoint.xy = (half + np.float16(0.5)).astype(np.float64)
        images.xy[image.name] = images.xy[image.name] - 0.5
    full = more_keypoints(images, rng)
    write_hloc(model / "a.h5", full, shift=0.0, dtype="f2")
    scene: Any = with_descriptors(read(model), model / "a.h5", images.model)
    mean = half_up(images.means(scene.ids.tolist()))
    # Keypoints that half precision moves to one place do not count.
    assert (scene.descriptor == mean).all(axis=1).mean() > 0.5


def test_one_of_two_keypoints_at_one_place_counts_only_if_nothing_else_does(model, images, rng):
    """SIFT has a keypoint for each orientation: where the model has dropped some, nobody knows which it kept."""
    full = more_keypoints(images, rng)
    chosen = sorted(images.xy)[:2]
    for name in chosen:
        full.xy[name] = np.concatenate([full.xy[name], images.xy[name]])
        full.descriptor[name] = np.concatenate([full.descriptor[name], 255 - images.descriptor[name]])
    scene = described(model, write_database(model / "d.db", full))
    for key, row in zip(scene.ids.tolist(), scene.descriptor, strict=True):
        track = [
            (images.model.images[e.image_id].name, e.point2D_idx) for e in images.model.points3D[key].track.elements
        ]
        sure = [images.descriptor[name][at].astype(float) for name, at in track if name not in chosen]
        if sure:
            np.testing.assert_array_equal(row, half_up(np.mean(sure, axis=0)))


# Features of another model


def test_undistorted_models_keep_their_indices(model, images):
    for name, xy in images.xy.items():
        images.xy[name] = 1.5 * xy * (1 + 1e-4 * np.linalg.norm(xy - 300, axis=1, keepdims=True)) + 10
    scene = described(model, write_database(model / "d.db", images))
    np.testing.assert_array_equal(scene.descriptor, half_up(images.means(scene.ids.tolist())))


@pytest.mark.parametrize("more", [0, 3])
def test_other_keypoints_are_refused(model, images, rng, more):
    for name, xy in images.xy.items():
        images.xy[name] = rng.uniform(0, 500, (len(xy) + more, 2))
        images.descriptor[name] = sift(rng, len(xy) + more)
    for path in (write_database(model / "d.db", images), write_hloc(model / "a.h5", images)):
        with pytest.raises(InputError, match=r"keypoints of mapping/.*jpg, other ones than the \d+ of the model; give"):
            described(model, path)


def test_a_file_without_the_images_or_points_is_refused(model, images):
    names = sorted(images.xy)
    write_database(model / "few.db", images, names=names[:1])
    with pytest.raises(InputError, match=r"few.db has no descriptor of \d+ of the 34 points; give the file"):
        described(model, model / "few.db")
    other = Images(
        images.model, *({f"x{name}": value[name] for name in names} for value in (images.xy, images.descriptor))
    )
    write_hloc(model / "other.h5", other)
    with pytest.raises(
        InputError, match=r"other.h5 has descriptors of none of the 8 images of the model; give the file"
    ):
        described(model, model / "other.h5")


def test_the_model_must_have_the_points(model, images):
    write_database(model / "d.db", images)
    scene = read(model)
    some = int(scene.ids[3])
    images.model.delete_point3D(some)
    with pytest.raises(InputError, match=f"the model lacks the point {some} of the scene"):
        with_descriptors(scene, model / "d.db", images.model)
    with pytest.raises(InputError, match=r"d.db, for a scene without tracks; expected a COLMAP model"):
        with_descriptors(scene, model / "d.db")


# Damaged files


def test_damaged_databases(model, images, rng):
    file = write_database(model / "d.db", images)

    def refused(sentence: str, *changes: str) -> None:
        copy = Path(shutil.copy(file, model / "bad.db"))
        with sqlite3.connect(copy) as database:
            for change in changes:
                database.execute(change)
        database.close()
        with pytest.raises(InputError, match=f"bad.db.* {sentence}") as error:
            described(model, copy)
        assert "\n" not in str(error.value)

    refused("damaged in the features of .*; extract features again", "UPDATE descriptors SET rows = rows + 1")
    refused("damaged in the features of", "UPDATE descriptors SET data = 'text'")
    refused("damaged in the features of", "UPDATE descriptors SET data = NULL")
    refused("damaged in the features of", "UPDATE descriptors SET rows = -1 * rows, cols = -128 WHERE image_id < 995")
    refused(r"\d+ keypoints and \d+ descriptors of .*; expected one each", "UPDATE keypoints SET rows = 0, data = x''")
    refused("no descriptors; give the file that has them", "DELETE FROM descriptors")
    refused("descriptors of 2 types; expected one", "UPDATE descriptors SET type = 1 WHERE image_id < 995")
    refused("descriptors of type 77, 128 bytes each, unknown", "UPDATE descriptors SET type = 77")
    refused("no table of descriptors; expected a database of COLMAP", "DROP TABLE descriptors")
    refused("damaged or no database of COLMAP .*no such table: images", "DROP TABLE images")
    refused("descriptors of type -1, 64 bytes each", "UPDATE descriptors SET type = -1, cols = 64, rows = 2 * rows")


def test_a_database_cut_short_or_open(model, images):
    file = write_database(model / "d.db", images)
    whole = file.read_bytes()
    for share in (0.001, 0.1, 0.5, 0.9):
        (model / "cut.db").write_bytes(whole[: max(20, int(share * len(whole)))])
        with pytest.raises(InputError, match=r"cut.db is damaged"):
            described(model, model / "cut.db")
    (model / "d.db-wal").write_bytes(b"changes")
    with pytest.raises(InputError, match=r"d.db has changes that are still in d.db-wal; open and close it with COLMAP"):
        described(model, file)


def test_no_keypoints_table_row_is_no_obstacle(model, images):
    file = write_database(model / "d.db", images)
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM keypoints")
    database.close()
    np.testing.assert_array_equal(described(model, file).descriptor, half_up(images.means(read(model).ids.tolist())))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda group: group.__delitem__("descriptors"), "has descriptors of none of the 8 images"),
        (
            lambda group: _put(group, "descriptors", np.ones((128, 3))),
            r"keypoints \(\d+, 2\) and descriptors \(128, 3\)",
        ),
        (lambda group: _put(group, "keypoints", np.ones(4)), r"keypoints \(4,\) and descriptors"),
        (lambda group: _put(group, "keypoints", np.full((4, 2), b"x")), "that are no numbers"),
        (
            lambda group: _put(group, "descriptors", np.ones((128, 3), dtype=int)),
            "of type int64; expected uint8 or flo",
        ),
        (lambda group: _nan(group), "that are NaN, infinite or beyond 1e30; extract them again"),
        (lambda group: _put(group, "keypoints", group["keypoints"][:] * np.nan), "that are NaN or no pixels; extract"),
        (lambda group: _huge(group), "is damaged in the features of"),
        (lambda group: _other_length(group), "has descriptors of several lengths or types; expected one kind"),
    ],
)
def test_damaged_features(model, change, message):
    file = write_hloc(model / "a.h5", features_of(read_model(model), unit))
    with h5py.File(file, "a") as opened:
        for name in features_of(read_model(model), unit).xy:
            change(opened[name])
    with pytest.raises(InputError, match=f"a.h5.* {message}") as error:
        described(model, file)
    assert "\n" not in str(error.value)


def _put(group: Any, key: str, value: np.ndarray) -> None:
    del group[key]
    group[key] = value


def _nan(group: Any) -> None:
    group["descriptors"][3] = np.nan


def _huge(group: Any) -> None:
    """A dataset that claims a terabyte and holds nothing."""
    del group["descriptors"]
    group.create_dataset("descriptors", shape=(256, 1 << 32), dtype="f2", chunks=(256, 64))


def _other_length(group: Any) -> None:
    if group.name.endswith("/3.jpg"):
        _put(group, "descriptors", group["descriptors"][:100])


@pytest.mark.parametrize("share", [0.001, 0.02, 0.5, 0.95])
def test_features_cut_short(model, share):
    whole = write_hloc(model / "a.h5", features_of(read_model(model), unit)).read_bytes()
    (model / "cut.h5").write_bytes(whole[: max(20, int(share * len(whole)))])
    with pytest.raises(InputError, match=r"cut.h5 is truncated or damaged; expected a complete HDF5 file"):
        described(model, model / "cut.h5")


def test_without_h5py_a_sentence_says_how_to_get_it(model, images, monkeypatch):
    write_hloc(model / "a.h5", images)
    monkeypatch.setitem(sys.modules, "h5py", None)
    for source in (model / "a.h5", None):
        with pytest.raises(InputError, match=r"a.h5 needs h5py; install it with pip install h5py"):
            load_described(model, source)
    write_database(model / "database.db", images)
    assert load_described(model)[1].name == "database.db"


def test_what_is_no_file_of_descriptors(model, tmp_path):
    scene = read(model)
    with pytest.raises(FileNotFoundError, match=r"none.npz does not exist; expected a file of descriptors"):
        with_descriptors(scene, model / "none.npz")
    with pytest.raises(InputError, match="is no regular file; expected an npz with point3D_id and descriptor"):
        with_descriptors(scene, tmp_path)
    for content in (b"", b"hello", b"SQLite"):
        (tmp_path / "file").write_bytes(content)
        with pytest.raises(InputError, match="file is no file of descriptors; expected an npz with"):
            with_descriptors(scene, tmp_path / "file")
    (tmp_path / "file").write_bytes(b"PK not a zip")
    with pytest.raises(InputError, match="truncated or damaged; expected a complete npz"):
        with_descriptors(scene, tmp_path / "file")


# npz by point id


def npz(path: Path, scene: Any, **changes: Any) -> Path:
    arrays: dict[str, Any] = {"point3D_id": scene.ids, "descriptor": np.ones((len(scene), 4), dtype=np.float32)}
    np.savez(path, **(arrays | changes))
    return path


def test_an_npz_is_read_by_id(model, rng):
    scene = read(model)
    ids = rng.permutation(np.concatenate([scene.ids, [10**6, 10**7]])).astype(np.uint64)
    descriptor = rng.integers(0, 256, (len(ids), 128), dtype=np.uint8)
    np.savez(model / "d.npz", point3D_id=ids, descriptor=descriptor)
    found = described(model, model / "d.npz")
    row = {int(key): value for key, value in zip(ids, descriptor, strict=True)}
    np.testing.assert_array_equal(found.descriptor, [row[int(key)] for key in scene.ids])
    assert found.descriptor_kind == "sift"
    named = npz(model / "e.npz", scene, descriptor=descriptor[: len(scene)], descriptor_kind=np.array("Disk"))
    assert described(model, named).descriptor_kind == "disk"
    assert described(model, npz(model / "f.npz", scene)).descriptor_kind == "unknown"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"point3D_id": np.arange(34) + 500}, "lacks 34 of the 34 points, .* give the descriptors of this model"),
        ({"point3D_id": np.ones(34, dtype=int)}, "has 33 repeated point ids; expected each point once"),
        ({"point3D_id": np.ones(3, dtype=int)}, r"has descriptor of shape \(34, 4\); expected \(3, any\)"),
        ({"point3D_id": np.ones(34)}, "has point3D_id of type float64; expected integers"),
        ({"point3D_id": np.zeros(0, dtype=int), "descriptor": np.zeros((0, 4))}, "lacks 34 of the 34 points"),
        ({"descriptor": np.full((34, 4), np.nan)}, r"got 34 descriptor\(s\) that are NaN or infinite"),
        ({"descriptor": np.ones((34, 4), dtype=int)}, "has descriptors of type int64; expected uint8 or float32"),
        ({"descriptor": np.ones((34, 0))}, r"got descriptors of type float64, shape \(34, 0\)"),
        ({"descriptor_kind": np.array(3)}, "has descriptor_kind of type int64; expected a string"),
    ],
)
def test_a_wrong_npz_is_refused(model, changes, message):
    scene = read(model)
    with pytest.raises(InputError, match=message):
        described(model, npz(model / "d.npz", scene, **changes))


def test_a_scene_without_ids_is_refused(tmp_path):
    np.savez(tmp_path / "scene.npz", xyz=np.eye(3))
    with pytest.raises(InputError, match="for a scene without point ids"):
        load_described(tmp_path / "scene.npz", tmp_path / "d.npz")
    with pytest.raises(InputError, match=r"scene.npz has no descriptors; give a scene npz that has them"):
        load_described(tmp_path / "scene.npz")


# The search


def test_the_search_takes_the_nearest_file_and_skips_what_has_no_local_features(model, images):
    with pytest.raises(
        InputError, match="has no descriptors in its folder or two above; give their file: expected an npz"
    ):
        load_described(model)
    project, sparse = model.parents[1], model.parent
    # As hloc leaves them: a database without descriptors, matches, and descriptors of whole images.
    empty = Images(images.model, images.xy, {name: value[:0] for name, value in images.descriptor.items()})
    write_database(model / "database.db", empty)
    with h5py.File(project / "global-feats-netvlad.h5", "w") as file:
        file["mapping/night 0/0.jpg/global_descriptor"] = np.ones(4)
    with h5py.File(project / "feats-matches.h5", "w") as file:
        file["a.jpg/b.jpg/matches0"] = np.ones(4)
    (project / "broken.h5").write_bytes(b"not HDF5")
    assert file_beside(model) is None
    for path, write in (
        (project / "feats-disk.h5", write_hloc),
        (sparse / "feats-sift.h5", write_hloc),
        (project / "database.db", write_database),
        (sparse / "database.db", write_database),
    ):
        write(path, images)
        assert load_described(model)[1] == file_beside(model) == path
    npz(sparse / "descriptors.npz", read(model))
    assert file_beside(model) != sparse / "descriptors.npz", "ids are those of one model"
    shutil.copy(sparse / "descriptors.npz", model)
    assert file_beside(model) == model / "descriptors.npz"


def test_two_files_of_features_are_a_question(model, images):
    for name in ("feats-a.h5", "feats-b.h5"):
        write_hloc(model.parent / name, images)
    with pytest.raises(InputError, match=r"feats-a.h5 and feats-b.h5 both have features; give the file"):
        load_described(model)


def test_load_gives_descriptors_only_if_asked(model, images, tmp_path):
    write_database(model / "database.db", images)
    assert l2p.load(model).descriptor is None
    for source in (True, model / "database.db", str(model / "database.db")):
        assert l2p.load(model, l2p.Scene, descriptors=source).appearance.names == ("rgb", "descriptor")
    np.savez(tmp_path / "scene.npz", xyz=np.eye(3), descriptor=np.ones((3, 8), dtype=np.uint8))
    assert l2p.load(tmp_path / "scene.npz", descriptors=True).descriptor.shape == (3, 8)
    with pytest.raises(InputError, match="got descriptors for a LineCloud; expected a Scene"):
        l2p.load(model, l2p.LineCloud, descriptors=True)
