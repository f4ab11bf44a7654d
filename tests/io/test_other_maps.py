"""Maps and point clouds of other programs come in with what they have; what is not read is named, with the way out."""

from __future__ import annotations

import json
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import l2p
from l2p.errors import InputError, InputWarning
from l2p.io.kinds import Kind, kind_of
from l2p.io.line_files import load_lines
from l2p.io.scene_files import load_scene

XYZ = np.array([[0.5, -1.25, 3.0], [10.0, 0.125, -2.5], [4.0, 5.0, 6.0]])
RGB = np.array([[255, 0, 1], [1, 1, 1], [17, 128, 254]], dtype=np.uint8)
#: Centres of the cameras, and one that looks along x.
CENTERS = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 2.0]])
TURNED = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
ROTATIONS = (np.eye(3), TURNED)
TRACKS = [2, 1, 2]


def rows(*columns: np.ndarray) -> str:
    return "".join(" ".join(f"{number:g}" for number in row) + "\n" for row in np.hstack(columns).tolist())


def bundler() -> str:
    cameras = "".join(
        f"500 0 0\n{rows(turn)}{' '.join(map(str, -turn @ center))}\n"
        for turn, center in zip(ROTATIONS, CENTERS, strict=True)
    )
    unknown = "0 0 0\n" * 5
    points = "".join(
        f"{rows(xyz[None])}{rows(rgb[None])}{count}{' 0 7 1.5 -2.5' * count}\n"
        for xyz, rgb, count in zip(XYZ, RGB, TRACKS, strict=True)
    )
    return f"# Bundle file v0.3\n3 3\n{cameras}{unknown}{points}"


def nvm(by_matrix: bool = False) -> str:
    cameras = ""
    for name, turn, center in zip(("a.jpg\t", "b c.jpg "), ROTATIONS, CENTERS, strict=True):
        pose = [*turn.ravel(), *(-turn @ center)] if by_matrix else [1, 0, 0, 0, *center]
        cameras += f"{name}500 {' '.join(map(str, pose))} 0.01 0\n"
    points = "".join(
        f"{rows(xyz[None])[:-1]} {rows(rgb[None])[:-1]} {count}{' 0 7 1.5 -2.5' * count}\n"
        for xyz, rgb, count in zip(XYZ, RGB, TRACKS, strict=True)
    )
    small = "1\nz.jpg 500 1 0 0 0 9 9 9 0 0\n\n1\n0 0 0 9 9 9 1 0 0 0 0\n\n"
    header = "NVM_V3_R9T" if by_matrix else "NVM_V3"
    return f"{header}\n\n{'' if by_matrix else small}2\n{cameras}\n3\n{points}\n\n0\n#the last part\n0\n"


def opensfm() -> list[Any]:
    turns = ([0, 0, 0], [0, -np.pi / 2, 0])
    shots = {
        name: {"rotation": turn, "translation": (-matrix @ center).tolist(), "camera": "c"}
        for name, turn, matrix, center in zip("ab", turns, ROTATIONS, CENTERS, strict=True)
    }
    points = {
        str(number): {"coordinates": xyz.tolist(), "color": rgb.astype(float).tolist()}
        for number, xyz, rgb in zip((5, 17, 4), XYZ, RGB, strict=True)
    }
    small = {"cameras": {}, "shots": {}, "points": {"1": {"coordinates": [0, 0, 0], "color": [0, 0, 0]}}}
    return [small, {"cameras": {"c": {}}, "shots": shots, "points": points}]


def openmvg() -> dict[str, Any]:
    return {
        "sfm_data_version": "0.3",
        "views": [],
        "extrinsics": [
            {"key": number, "value": {"rotation": np.eye(3).tolist(), "center": center.tolist()}}
            for number, center in enumerate(CENTERS)
        ],
        "structure": [
            {"key": number, "value": {"X": xyz.tolist(), "observations": [{}] * count}}
            for number, xyz, count in zip((5, 17, 4), XYZ, TRACKS, strict=True)
        ],
    }


def meshroom() -> dict[str, Any]:
    """All numbers are texts."""
    return {
        "version": ["1", "2", "3"],
        "featuresFolders": [],
        "poses": [
            {"poseId": "1", "pose": {"transform": {"center": [str(number) for number in center]}}}
            for center in CENTERS.tolist()
        ],
        "structure": [
            {
                "landmarkId": str(number),
                "color": [str(value) for value in rgb],
                "X": [str(value) for value in xyz],
                "observations": [{}] * count,
            }
            for number, xyz, rgb, count in zip((5, 17, 4), XYZ.tolist(), RGB.tolist(), TRACKS, strict=True)
        ],
    }


#: Kind, name of the file and its content; whether it has colours, ids and track lengths, and what is warned of.
MAPS: dict[str, tuple[Kind, str, Any, str, str | None]] = {
    "Bundler": (Kind.SCENE_BUNDLER, "bundle.out", bundler(), "rgb track", None),
    "NVM": (Kind.SCENE_NVM, "a.nvm", nvm(), "rgb track", "has 2 models of 1, 3 points; the largest is read"),
    "NVM with matrices": (Kind.SCENE_NVM, "b.nvm", nvm(by_matrix=True), "rgb track", None),
    "OpenSfM": (
        Kind.SCENE_OPENSFM,
        "reconstruction.json",
        json.dumps(opensfm()),
        "rgb ids",
        "has 2 reconstructions of 1, 3 points; the largest is read",
    ),
    "OpenMVG": (Kind.SCENE_OPENMVG, "sfm_data.json", json.dumps(openmvg()), "ids track", None),
    "Meshroom": (Kind.SCENE_MESHROOM, "a.sfm", json.dumps(meshroom(), indent=1), "rgb ids track", None),
}


@pytest.mark.parametrize("case", MAPS)
def test_maps_come_in_with_colours_cameras_and_track_lengths(tmp_path, case):
    kind, name, content, known, warned = MAPS[case]
    path = tmp_path / name
    path.write_text(content)
    assert kind_of(path) is kind
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        scene = l2p.load(path)
    assert [str(warned) in str(each.message) for each in said] == ([True] if warned else []), said
    np.testing.assert_array_equal(scene.xyz, XYZ)
    assert scene.camera_centers is not None
    np.testing.assert_allclose(scene.camera_centers, CENTERS, atol=1e-12)
    np.testing.assert_array_equal(scene.rgb, RGB if "rgb" in known else None)
    np.testing.assert_array_equal(scene.ids, [5, 17, 4] if "ids" in known else None)
    np.testing.assert_array_equal(scene.track_length, TRACKS if "track" in known else None)
    with pytest.raises(InputError, match="expected a line cloud"):
        load_lines(path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.out", "# Bundle file v0.3\n1 99\n", r"it announces 1 camera\(s\), and ends with line 2"),
        ("a.out", bundler().replace("10 0.125 -2.5", "10 0.125 x"), "line 21: got '10 0.125 x'; expected x, y, z of"),
        ("a.out", bundler().replace("10 0.125 -2.5", "10 0.125 nan"), "line 21: got '10 0.125 nan'; expected x, y, z"),
        ("a.out", "# Bundle file v0.3\n99\n", "line 2: got '99'; expected the numbers of cameras and points"),
        ("a.nvm", "NVM_V3\n\n1\n", r"it announces 1 camera\(s\), and ends with line 3"),
        ("a.nvm", "NVM_V3\n\n0\n", "has no model; expected cameras and points"),
        ("a.nvm", nvm().replace("b c.jpg 500", "b c.jpg"), "line [0-9]+: got 'b c.jpg 1 0 .*; expected NAME and ten"),
        ("a.json", '[{"points": {}}]', "has no points; expected at least one"),
        ("a.json", "[]", "is JSON of no map that l2p knows"),
        ("a.json", json.dumps(opensfm())[:-9], "is truncated or damaged; expected complete JSON"),
        (
            "a.json",
            '[{"points": {"1": {"coordinates": [1, 2]}}, "shots": {}}]',
            "is laid out otherwise than its program",
        ),
        ("a.json", '{"sfm_data_version": "0.3"}', "is laid out otherwise than its program writes it .*'structure'"),
        ("a.sfm", '{"featuresFolders": []}', "has no structure; convert it with Meshroom"),
        ("a.json", '{"frames": []}', "has cameras, and no ply_file_path; give the COLMAP model"),
        ("a.json", '{"frames": [], "ply_file_path": "s.ply"}', "names s.ply, which is missing; give the COLMAP model"),
        ("a.json", '{"type": "FeatureCollection"}', "is JSON of no map that l2p knows; expected OpenSfM, OpenMVG"),
        ("a.pcd", "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\n", "its header has no POINTS or no DATA"),
        ("a.pcd", "VERSION 0.7\nFIELDS x\nPOINTS 99999999\nDATA ascii\n", "it announces 99999999 points in"),
        ("a.xyz", "1 2 3\n4 five 6\n", "line 2: got '4 five 6'; expected 3 numbers, as in the first row"),
        ("a.xyz", "1 2 3\n4 5\n", "line 2: got '4 5'; expected 3 numbers"),
        ("a.xyz", "1 2\n4 5\n", "has 2 columns; expected x, y, z"),
        ("a.xyz", "# nothing\n", "has no points"),
        ("a.xyz", "1 2 nan\n", "has 1 of 1 points that are NaN"),
        ("a.pts", "3\n1 2 3\n4 5 6\n", "is truncated: it announces 3 points, and has 2"),
        ("a.obj", "v 1 2 3\nv 1 2\n", "line 2: got 'v 1 2'; expected three numbers after v"),
    ],
)
def test_damaged_maps_name_the_line(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=f"{name}.*{message}"):
        load_scene(tmp_path / name)


@pytest.mark.parametrize("named", [True, False])
def test_nerfstudio_names_its_point_cloud(tmp_path, named):
    cloud = tmp_path / ("points/cloud.ply" if named else "sparse_pc.ply")
    cloud.parent.mkdir(exist_ok=True)
    l2p.save(l2p.Scene(XYZ, RGB), cloud)
    matrices = [
        np.vstack([np.column_stack([turn.T, center]), [0, 0, 0, 1]])
        for turn, center in zip(ROTATIONS, CENTERS, strict=True)
    ]
    data = {"w": 640, "frames": [{"file_path": "a.jpg", "transform_matrix": each.tolist()} for each in matrices]}
    (tmp_path / "transforms.json").write_text(
        json.dumps(data | ({"ply_file_path": "points/cloud.ply"} if named else {}))
    )
    scene = l2p.load(tmp_path / "transforms.json", l2p.Scene)
    np.testing.assert_array_equal(scene.xyz, XYZ)
    np.testing.assert_array_equal(scene.rgb, RGB)
    np.testing.assert_array_equal(scene.camera_centers, CENTERS)


# Point clouds

NORMALS = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.36, 0.48, 0.8]])
SHARES = RGB / 255


@pytest.mark.parametrize(
    ("name", "content", "coloured"),
    [
        ("a.xyz", rows(XYZ), False),
        ("a.xyz", rows(XYZ).replace(" ", ",").replace("\n", "\r\n"), False),
        ("a.xyz", "# made by hand\n" + rows(XYZ, RGB), True),
        ("a.xyz", "x y z nx ny nz\n" + rows(XYZ, NORMALS), False),
        ("a.xyzn", rows(XYZ, NORMALS), False),
        ("a.xyzrgb", rows(XYZ, SHARES.round(6)), True),
        ("a.xyzrgb", rows(XYZ, RGB), True),
        ("a.pts", "3\n" + rows(XYZ), False),
        ("a.pts", "3\n" + rows(XYZ, np.array([[-7], [12], [2000]]), RGB), True),
        ("a.pts", "3\n" + rows(XYZ, np.array([[0.5], [0.25], [0.125]])), False),
        ("a.asc", "//X Y Z Rf Gf Bf R G B\n" + rows(XYZ, SHARES.round(3), RGB), True),
        ("a.asc", rows(XYZ, NORMALS, RGB), True),
        ("a.xyz", "b;g;r;z;y;x\n" + rows(RGB[:, ::-1], XYZ[:, ::-1]).replace(" ", ";"), True),
    ],
)
def test_points_as_text(tmp_path, name, content, coloured):
    (tmp_path / name).write_bytes(content.encode())
    assert kind_of(tmp_path / name) is Kind.SCENE_XYZ
    scene = load_scene(tmp_path / name)
    np.testing.assert_array_equal(scene.xyz, XYZ)
    np.testing.assert_array_equal(scene.rgb, RGB if coloured else None)


@pytest.mark.parametrize("scale", [None, 1, 255])
def test_vertices_of_an_obj(tmp_path, scale):
    columns = XYZ if scale is None else np.hstack([XYZ, RGB.astype(np.float64) * scale / 255])
    text = "".join("v " + " ".join(f"{value:.9g}" for value in row) + "\n" for row in columns.tolist())
    (tmp_path / "a.obj").write_text(f"# a mesh\nmtllib a.mtl\n{text}vn 0 0 1\nf 1 2 3\n")
    assert kind_of(tmp_path / "a.obj") is Kind.SCENE_OBJ
    scene = load_scene(tmp_path / "a.obj")
    np.testing.assert_array_equal(scene.xyz, XYZ)
    np.testing.assert_array_equal(scene.rgb, None if scale is None else RGB)
    (tmp_path / "lines.obj").write_text(text + "l 1 2\n")
    assert kind_of(tmp_path / "lines.obj") is Kind.LINES_OBJ


def _packed(rgb: np.ndarray) -> np.ndarray:
    return (rgb.astype(np.uint32) << [16, 8, 0]).sum(axis=1).astype(np.uint32)


def pcd(data: str) -> bytes:
    """XYZ, and a point that was not measured, with packed colours."""
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\n"
        f"COUNT 1 1 1 1\nWIDTH 4\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA {data}\n"
    )
    points, colours = [*XYZ.tolist(), [np.nan] * 3], [*_packed(RGB).tolist(), 0]
    if data == "ascii":
        lines = (f"{' '.join(map(str, xyz))} {colour}\n" for xyz, colour in zip(points, colours, strict=True))
        return (header + "".join(lines)).encode()
    return header.encode() + b"".join(struct.pack("<3fI", *xyz, c) for xyz, c in zip(points, colours, strict=True))


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_pcd_by_open3d(tmp_path, capfd, data):
    (tmp_path / "cloud").write_bytes(pcd(data))
    assert kind_of(tmp_path / "cloud") is Kind.SCENE_PCD
    with pytest.warns(InputWarning, match="1 of 4 points are not finite; they are left out"):
        scene = load_scene(tmp_path / "cloud")
    np.testing.assert_array_equal(scene.xyz, XYZ)
    np.testing.assert_array_equal(scene.rgb, RGB)
    (tmp_path / "cut").write_bytes(pcd(data)[:-20])
    with pytest.raises(InputError, match="cut is truncated or damaged"):
        load_scene(tmp_path / "cut")
    assert "Open3D" not in "".join(capfd.readouterr())


# PLY


def ply(body: str, *properties: str, comment: bytes = b"", more: str = "") -> bytes:
    names = "".join(f"property {each}\n" for each in ("double x", "double y", "double z", *properties))
    header = f"element vertex 3\n{names}{more}end_header\n"
    return b"ply\nformat ascii 1.0\n" + comment + header.encode() + body.encode()


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8"])
@pytest.mark.parametrize("record", ["comment", "obj_info"])
def test_ply_comments_may_have_any_encoding(tmp_path, encoding, record):
    comment = f"{record} TextureFile Fassade_Süd.jpg\n".encode(encoding)
    (tmp_path / "a.ply").write_bytes(ply(rows(XYZ), comment=comment))
    np.testing.assert_array_equal(load_scene(tmp_path / "a.ply").xyz, XYZ)
    little = ply("", comment=comment).replace(b"ascii", b"binary_little_endian") + XYZ.astype("<f8").tobytes()
    (tmp_path / "b.ply").write_bytes(little)
    np.testing.assert_array_equal(load_scene(tmp_path / "b.ply").xyz, XYZ)


@pytest.mark.parametrize(
    ("names", "kind", "colours"),
    [
        ("red green blue", "uchar", RGB),
        ("diffuse_red diffuse_green diffuse_blue", "uchar", RGB),
        ("r g b", "uchar", RGB),
        ("red green blue", "float", SHARES),
        ("red green blue", "float", RGB),
        ("red green blue", "ushort", RGB.astype(np.int64) * 257),
        ("red green blue", "int", RGB),
    ],
)
def test_ply_colours_of_other_programs(tmp_path, names, kind, colours):
    properties = [f"{kind} {name}" for name in names.split()]
    text = "".join(
        " ".join(f"{value:.9g}" for value in row) + "\n" for row in np.hstack([XYZ, colours]).astype(float).tolist()
    )
    (tmp_path / "a.ply").write_bytes(ply(text, *properties))
    np.testing.assert_array_equal(load_scene(tmp_path / "a.ply").rgb, RGB, strict=True)


@pytest.mark.parametrize("edges", ["element edge 0\n", "element edge 1\n", "element edge 3\nELEMENTface 1\n"])
def test_a_scene_may_have_edges(tmp_path, edges):
    """Frames of cameras, or a mesh: some vertices have no edge, or there are faces."""
    count = int(edges.split()[2])
    more = edges.split("ELEMENT")[0] + "property int vertex1\nproperty int vertex2\n"
    face = "ELEMENT" in edges
    more += "element face 1\nproperty list uchar int vertex_indices\n" if face else ""
    body = rows(XYZ) + "0 1\n" * count + ("3 0 1 2\n" if face else "")
    (tmp_path / "a.ply").write_bytes(ply(body, more=more))
    assert kind_of(tmp_path / "a.ply") is Kind.SCENE_PLY
    np.testing.assert_array_equal(load_scene(tmp_path / "a.ply").xyz, XYZ)
    l2p.save(l2p.lift(XYZ, seed=0), tmp_path / "lines.ply")
    assert kind_of(tmp_path / "lines.ply") is Kind.LINES_PLY


# What is not read

ZEROS = bytes(300)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "a.ply",
            b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n",
            "Git LFS pointer.*git lfs pull",
        ),
        ("a", b"LASF" + ZEROS, "is a LAS or LAZ point cloud, which l2p does not read; convert it to PLY"),
        ("a.laz", ZEROS, "is a LAS or LAZ point cloud"),
        ("a", b"ASTM-E57" + ZEROS, "is an E57 point cloud.*convert it to PLY"),
        ("a", b"\x89HDF\r\n\x1a\n" + ZEROS, "is an HDF5 file, as hloc's features.*give the folder of the model"),
        ("a", b"SQLite format 3\0" + ZEROS, "is a database, as COLMAP's of features.*give the folder of the model"),
        ("a.glb", b"glTF" + ZEROS, "is a glTF model.*convert it to PLY"),
        ("a.gltf", b'{"asset": {}}', "is a glTF model"),
        ("a", b"\x1f\x8b" + ZEROS, "is a gzip archive.*unpack it"),
        ("a", b"MATLAB 5.0 MAT-file" + ZEROS, r"is a MATLAB file.*scipy\.io\.loadmat"),
        ("a", b"\x80\x04\x95" + ZEROS, "is a file of Python or PyTorch objects.*l2p runs no code"),
        ("a.html", b"\n<!DOCTYPE html><html>", "is a web page or XML document"),
        ("a.psz", ZEROS, "is a Metashape project.*export its tie points"),
        ("images.bin", ZEROS, "is a table of a COLMAP model without its points.*give the folder of the model"),
        ("cameras.txt", b"1 PINHOLE 1 1 1 1 1 1\n", "is a table of a COLMAP model"),
        ("a.spz", ZEROS, "is a file of Gaussian splats"),
        ("a.bin", b"\x01\x02" + ZEROS, "is neither npz, PLY, OBJ nor text"),
    ],
)
def test_formats_that_are_not_read_are_named_with_the_way_out(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    for reader in (kind_of, load_scene, load_lines, l2p.load):
        with pytest.raises(InputError, match=f"{name}.*{message}") as refused:
            reader(tmp_path / name)
        assert "\n" not in str(refused.value) and len(str(refused.value)) - len(str(tmp_path)) < 200


def test_archives_are_no_npz(tmp_path, zipped: Callable[..., Path]):
    with pytest.raises(InputError, match="is a zip archive of 2 files; unpack it"):
        kind_of(zipped("model.zip", "sparse/0/points3D.bin", "sparse/0/images.bin"))
    with pytest.raises(
        InputError, match=r"is a PyTorch file, which l2p does not read; write its points with numpy\.sav"
    ):
        kind_of(zipped("a.pt", "a/data.pkl", "a/version"))


@pytest.fixture
def zipped(tmp_path: Path) -> Callable[..., Path]:
    def make(name: str, *members: str) -> Path:
        import zipfile

        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            for member in members:
                archive.writestr(member, b"x")
        return tmp_path / name

    return make
