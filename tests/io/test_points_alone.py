"""The points of a COLMAP model are enough: whatever its tracks, images, cameras and folders are like, they are read."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import l2p
from l2p.cli.main import main
from l2p.errors import InputError, InputWarning
from l2p.io.colmap import read_model
from l2p.io.colmap_tables import read_points
from l2p.io.kinds import Kind, kind_of
from l2p.io.scene_files import load_scene

CAMERAS = "# Camera list\n1 PINHOLE 640 480 500 500 320 240\n"
IMAGES = """# Image list with two lines of data per image:
1 1 0 0 0 -1 -2 -3 1 left one.jpg
10 20 7 30 40 -1 50 60 9
2 0.7071067811865476 0 0 0.7071067811865476 0 0 0 1 right.jpg
11 21 7 31 41 9
"""
POINTS = """# 3D point list with one line of data per point:
9 0.5 -1.25 3 1 0 1 0.75 1 2 2 1
7 0.1 1e3 -2.5 255 128 0 0.5 1 0 2 0
"""
XYZ = [[0.1, 1e3, -2.5], [0.5, -1.25, 3.0]]
RGB = [[255, 128, 0], [1, 0, 1]]


def written(
    folder: Path, cameras: str | None = CAMERAS, images: str | None = IMAGES, points: str | None = POINTS
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("cameras", cameras), ("images", images), ("points3D", points)):
        if text is not None:
            (folder / f"{name}.txt").write_text(text)
    return folder


def points_of(path: Path, *sentences: str) -> l2p.Scene:
    """The scene of a path, whose points are right and which warns with exactly these sentences."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        scene = load_scene(path)
    assert all(each.category is InputWarning for each in said)
    assert len(said) == len(sentences), [str(each.message) for each in said]
    for each, sentence in zip(said, sentences, strict=True):
        assert sentence in str(each.message)
    np.testing.assert_array_equal(scene.xyz, XYZ)
    return scene


def test_a_whole_model_is_read_without_a_word(tmp_path):
    scene = points_of(written(tmp_path / "m"))
    np.testing.assert_array_equal(scene.rgb, RGB)
    assert scene.ids is not None and scene.ids.tolist() == [7, 9]
    assert scene.track_length is not None and scene.track_length.tolist() == [2, 2]
    assert scene.camera_centers is not None
    np.testing.assert_allclose(scene.camera_centers, [[1, 2, 3], [0, 0, 0]], atol=1e-12)


# What is changed in the text model, and what the warning and the error of whoever needs tracks say.
BROKEN: dict[str, tuple[dict[str, str | None], str]] = {
    "an image is missing": (
        {"images": "\n".join(IMAGES.split("\n")[3:])},
        "points3D.txt line 2, point 9 is seen by image 1, which images.txt lacks",
    ),
    "images have no keypoints": (
        {"images": "1 1 0 0 0 -1 -2 -3 1 left one.jpg\n\n2 1 0 0 0 0 0 0 1 right.jpg\n\n"},
        "points3D.txt line 2, point 9 is keypoint 2 of image 1 (left one.jpg), which has 0 in images.txt",
    ),
    "another point is seen": (
        {"images": IMAGES.replace("30 40 -1", "30 40 7").replace("50 60 9", "50 60 7")},
        "points3D.txt line 2, point 9 is keypoint 2 of image 1 (left one.jpg), which is of point 7",
    ),
    "images name a point that is not there": (
        {"images": IMAGES.replace("30 40 -1", "30 40 12")},
        "images.txt line 2, image 1 (left one.jpg) has keypoint 1 of point 12, which points3D.txt lacks",
    ),
    "one line an image": (
        {"images": "1 1 0 0 0 -1 -2 -3 1 left one.jpg\n2 1 0 0 0 0 0 0 1 right.jpg\n"},
        "line 1 has image 1 (left one.jpg), whose line of keypoints is missing",
    ),
    "seven columns": (
        {"points": "".join(" ".join(line.split()[:7]) + "\n" for line in POINTS.split("\n")[1:3])},
        "points3D.txt line 1 has 7 words",
    ),
    "no images": ({"images": None}, "images.txt is missing"),
    "points alone": ({"images": None, "cameras": None}, "cameras.txt and images.txt are missing"),
    "a camera of another model": (
        {"cameras": CAMERAS.replace("PINHOLE", "PANORAMA_360")},
        "cameras.txt line 2 is '1 PANORAMA_360 640 480 500 500 320 240'",
    ),
    "a camera is missing": ({"cameras": "# none\n"}, "images.txt line 2, image 1 (left one.jpg) has camera 1, which"),
    "a pose of NaN": ({"images": IMAGES.replace("0 0 0 -1 -2 -3", "nan nan nan nan nan nan")}, "whose pose is not fin"),
    "no images at all": ({"images": "hello\n"}, "images.txt line 1 is 'hello'; expected IMAGE_ID, QW"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_the_points_are_read_with_one_warning_and_what_needs_tracks_says_where(tmp_path, case):
    change, where = BROKEN[case]
    folder = written(tmp_path / "m", **change)
    also = ("1 of 2 cameras have a place that is NaN",) if case == "a pose of NaN" else ()
    scene = points_of(folder, "only the points are read, without tracks, since", *also)
    np.testing.assert_array_equal(scene.rgb, RGB)
    assert scene.ids is not None and scene.ids.tolist() == [7, 9]
    with pytest.raises(InputError, match="m is not a complete COLMAP model") as refused:
        read_model(folder)
    assert where in str(refused.value)


def test_images_without_keypoints_and_points_without_tracks_fit_each_other(tmp_path):
    """As VGGT writes them."""
    images = "1 1 0 0 0 -1 -2 -3 1 left one.jpg\n\n2 1 0 0 0 0 0 0 1 right.jpg\n\n"
    points = "".join(" ".join(line.split()[:8]) + "\n" for line in POINTS.split("\n")[1:3])
    scene = points_of(written(tmp_path / "m", images=images, points=points))
    assert scene.track_length is None
    assert scene.camera_centers is not None
    np.testing.assert_allclose(scene.camera_centers, [[1, 2, 3], [0, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("text", [False, True])
def test_the_small_reader_reads_what_pycolmap_reads(tmp_path, write_model, text):
    folder = write_model(tmp_path / "model", text=text)
    whole = load_scene(folder)
    alone = load_scene(folder / f"points3D.{'txt' if text else 'bin'}")
    for name in ("xyz", "rgb", "error", "track_length", "ids"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(whole, name), err_msg=name, strict=True)
    assert alone.camera_centers is not None and whole.camera_centers is not None
    np.testing.assert_allclose(alone.camera_centers, whole.camera_centers, atol=1e-12)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("table", ["cameras", "images"])
@pytest.mark.parametrize("share", [None, 0.0, 0.6])
def test_damaged_and_missing_tables_leave_the_points(tmp_path, write_model, capfd, text, table, share):
    folder = write_model(tmp_path / "model", text=text)
    whole, file = load_scene(folder), folder / f"{table}.{'txt' if text else 'bin'}"
    content = file.read_bytes()
    file.unlink()
    if share is not None:
        file.write_bytes(content[: int(share * len(content))])
    said = f"{file.name} is missing" if share is None else f"{table}.bin is truncated or damaged"
    with pytest.warns(InputWarning, match="only the points are read" if text and share is not None else said):
        scene = load_scene(folder)
    assert capfd.readouterr().err == "", "pycolmap says nothing"
    np.testing.assert_array_equal(scene.xyz, whole.xyz)
    np.testing.assert_array_equal(scene.ids, whole.ids)


def test_binary_tables_that_do_not_fit_name_image_and_point(tmp_path, write_model):
    import pycolmap

    folder, other = write_model(tmp_path / "model"), tmp_path / "other"
    model = pycolmap.Reconstruction(str(folder))
    gone = max(model.point3D_ids())
    model.delete_point3D(gone)
    other.mkdir()
    model.write_binary(str(other))
    (folder / "points3D.bin").write_bytes((other / "points3D.bin").read_bytes())
    with pytest.warns(InputWarning, match=rf"image \d+ \(.*\) has keypoint \d+ of point {gone}, which points3D"):
        assert len(load_scene(folder)) == model.num_points3D()


def test_a_camera_of_two_parameters_in_binary(tmp_path):
    """A panorama has a width and a height, and no focal length; a pycolmap that does not know it leaves the points."""
    folder = written(tmp_path / "m")
    record = struct.Struct("<QdddBBBdQ")
    rows = ((9, *XYZ[1], *RGB[1]), (7, *XYZ[0], *RGB[0]))
    points = b"".join(record.pack(*row, 0.5, 0) for row in rows)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 2) + points)
    (folder / "images.bin").write_bytes(struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, -1, -2, -3, 1) + b"a\0" + bytes(8))
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ2d", 1, 1, 17, 640, 320, 640, 320))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        scene = load_scene(folder)
    assert "has points3D.bin and points3D.txt; points3D.bin is read" in str(said[0].message)
    assert not any("truncated" in str(each.message) for each in said)
    np.testing.assert_array_equal(scene.xyz, XYZ)
    assert scene.camera_centers is not None
    np.testing.assert_allclose(scene.camera_centers, [[1, 2, 3]])


def test_a_stray_binary_file_beside_a_whole_text_model_is_named(tmp_path):
    folder = written(tmp_path / "m")
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    scene = points_of(folder, "m has points3D.bin and points3D.txt; points3D.txt is read")
    assert scene.track_length is not None


@pytest.mark.parametrize("first", [2**63, 2**64 - 2, -2])
def test_ids_beyond_the_largest_are_left_out(tmp_path, first):
    """COLMAP's ids are unsigned."""
    points = POINTS.replace("\n9 ", f"\n{first + 1} ").replace("\n7 ", f"\n{first} ")
    folder = written(tmp_path / "m", images="#\n", points=points.replace(" 1 2 2 1", "").replace(" 1 0 2 0", ""))
    for path in (folder, folder / "points3D.txt"):
        assert points_of(path, "larger than 2^63 - 1; the points are read without ids").ids is None


def test_repeated_ids_are_left_out(tmp_path):
    points = POINTS.replace("\n9 ", "\n-1 ").replace("\n7 ", "\n-1 ")
    (tmp_path / "points3D.txt").write_text(points)
    with pytest.warns(InputWarning, match="point id"):
        scene = load_scene(tmp_path / "points3D.txt")
    assert scene.ids is None and len(scene) == 2


@pytest.mark.parametrize("name", ["points3D.txt", "points3D.bin", "points3D_filtered.txt", "map.txt", "map"])
def test_the_file_of_points_itself(tmp_path, name):
    (tmp_path / "p").write_text(POINTS)
    table = read_points(tmp_path / "p")
    assert table.error is not None
    if name.endswith(("bin", "map")):
        record = struct.Struct("<QdddBBBdQ")
        rows = (record.pack(int(i), *x, *c, e, 0) for i, x, c, e in zip(table.ids, XYZ, RGB, table.error, strict=True))
        (tmp_path / name).write_bytes(struct.pack("<Q", 2) + b"".join(rows))
    else:
        (tmp_path / name).write_text(POINTS)
    assert kind_of(tmp_path / name) is Kind.SCENE_POINTS
    scene = points_of(tmp_path / name)
    np.testing.assert_array_equal(scene.rgb, RGB)
    assert scene.error is not None and scene.error.tolist() == [0.5, 0.75]


def test_damaged_points_are_refused_also_alone(tmp_path):
    folder = written(tmp_path / "m", points=POINTS.replace("1e3", "1e3x"))
    for path in (folder, folder / "points3D.txt"):
        with pytest.raises(InputError, match=r"points3D\.txt line 3 is '7 0\.1 1e3x .*expected POINT3D_ID, X, Y, Z"):
            load_scene(path)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 3) + bytes(60))
    with pytest.raises(InputError, match=r"points3D\.bin is truncated or damaged"):
        load_scene(folder / "points3D.bin")
    (folder / "points3D.txt").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n")
    (folder / "points3D.bin").unlink()
    for path in (folder, folder / "points3D.txt"):
        with pytest.raises(InputError, match=r"points3D\.txt is a Git LFS pointer.*run git lfs pull"):
            load_scene(path)


# Folders of projects


@pytest.mark.parametrize(("model", "given"), [("sparse/0", "."), ("sparse/0", "sparse"), ("models/0", "models")])
def test_the_only_model_of_a_project_is_read_and_named(tmp_path, model, given):
    written(tmp_path / "proj" / model)
    (tmp_path / "proj" / "images").mkdir()
    assert kind_of(tmp_path / "proj" / given) is Kind.SCENE_MODEL
    shorter = str(Path(model).relative_to(given))
    points_of(tmp_path / "proj" / given, f"its only COLMAP model, {shorter}, is read")
    with pytest.warns(InputWarning):
        assert read_model(tmp_path / "proj" / given).num_points3D() == 2


def test_several_models_are_named_with_their_sizes(tmp_path):
    written(tmp_path / "proj" / "sparse" / "0")
    written(tmp_path / "proj" / "sparse" / "1", points=POINTS + "8 1 2 3 4 5 6 0.5\n")
    for reader in (kind_of, load_scene, read_model):
        with pytest.raises(InputError, match=r"has 2 COLMAP models, sparse/1 \(3 points\), sparse/0 \(2 points\)"):
            reader(tmp_path / "proj")
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match=r"images is a folder without points3D\.bin or points3D\.txt"):
        load_scene(tmp_path / "images")
    (tmp_path / "images" / "reconstruction.json").write_text("[]")
    with pytest.raises(InputError, match=r"expected a COLMAP model or a file, such as reconstruction\.json in it"):
        load_scene(tmp_path / "images")


# Commands


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command in a folder of its own; returns what it said on stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str, code: int = 0) -> str:
        assert main(words) == code
        return capsys.readouterr().err

    return run


def test_commands_say_once_what_they_took(run, tmp_path):
    written(tmp_path / "proj" / "sparse" / "0", images=None)
    (tmp_path / "proj" / "database.db").write_bytes(b"x")
    said = [
        "l2p: proj: its only COLMAP model, sparse/0, is read",
        "l2p: proj/sparse/0: only the points are read, without tracks, since images.txt is missing",
    ]
    assert run("info", "proj").splitlines() == said
    assert run("view", "proj", "-o", "page.html").splitlines() == said
    *first, leaks = run("lift", "proj", "-o", "lines.npz", "--rgb", "--truth", "truth.npz").splitlines()
    assert first == said
    assert "points3D.txt (the points)" in leaks and "../../database.db" in leaks
    assert "points3D.txt (the points)" in run("lift", "proj/sparse/0/points3D.txt", "-o", "again.npz")
    refused = run("recover", "lines.npz", "-o", "out", "--model", "proj", "--truth", "truth.npz", code=2)
    assert "l2p: error: proj/sparse/0 is not a complete COLMAP model: images.txt is missing" in refused
    assert "images.txt is missing" in run("localize", "proj", code=2)


def test_a_model_goes_to_a_project_and_back(run, tmp_path, write_model):
    (tmp_path / "proj").mkdir()
    write_model(tmp_path / "proj" / "0")
    run("lift", "proj", "-o", "lines.npz", "--truth", "truth.npz")
    words = "recover lines.npz -o {} --model proj --truth truth.npz --method tomography --rounds 0"
    run(*words.format("out").split())
    assert read_model(tmp_path / "out").num_points3D() == read_model(tmp_path / "proj" / "0").num_points3D()
    assert "share a folder; choose another" in run(*words.format("proj/0/new").split(), code=2)


def test_descriptors_by_id_need_no_tracks_and_features_of_images_do(tmp_path):
    folder = written(tmp_path / "m", images=None)
    np.savez(folder / "descriptors.npz", point3D_id=[7, 9], descriptor=np.eye(2, dtype=np.float32))
    with pytest.warns(InputWarning, match="only the points are read"):
        scene = l2p.load(folder, descriptors=True)
    np.testing.assert_array_equal(scene.descriptor, np.eye(2))
    (folder / "features.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.warns(InputWarning), pytest.raises(InputError, match=r"images\.txt is missing; export it again"):
        l2p.load(folder, descriptors=folder / "features.h5")
