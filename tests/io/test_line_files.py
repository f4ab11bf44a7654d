"""Line clouds survive their files, and files that are none are refused by name."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.geometry.frame import Frame
from l2p.io.line_files import load_lines, save_lines, segments
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.schemes.hide import hide


def cloud_of(count: int = 20, seed: int = 0, colours: bool = False, offset: float = 0.0) -> LineCloud:
    rng = np.random.default_rng(seed)
    point, direction = offset + rng.normal(size=(count, 3)), rng.normal(size=(count, 3))
    rgb = rng.integers(0, 256, size=(count, 3), dtype=np.uint8) if colours else None
    return LineCloud.through(point, direction, Appearance(rgb))


def same_lines(first: LineCloud, second: LineCloud, tolerance: float = 1e-9) -> None:
    sign = np.sign(np.sum(first.direction * second.direction, axis=1, keepdims=True))
    np.testing.assert_allclose(first.direction, sign * second.direction, atol=tolerance)
    np.testing.assert_allclose(first.moment, sign * second.moment, atol=tolerance * max(1, np.abs(first.moment).max()))


def npz(path: Path, **changes: object) -> Path:
    """The npz of a good line cloud with some arrays changed; None leaves one out."""
    cloud = cloud_of()
    arrays: dict[str, object] = {
        "direction": cloud.direction,
        "moment": cloud.moment,
        "scheme": np.array("uniform"),
        "version": np.array(1),
    }
    arrays |= changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})  # type: ignore[arg-type]
    return path


def changed(array: np.ndarray, row: int, value: object) -> np.ndarray:
    array = np.array(array)
    array[row] = value
    return array


@pytest.mark.parametrize("colours", [False, True])
def test_npz_keeps_the_lines(tmp_path, colours):
    cloud = cloud_of(colours=colours)
    l2p.save(cloud, tmp_path / "lines.npz")
    with np.load(tmp_path / "lines.npz") as archive:
        np.testing.assert_array_equal(archive["direction"], cloud.direction, strict=True)
        np.testing.assert_array_equal(archive["moment"], cloud.moment, strict=True)
    again = l2p.load(tmp_path / "lines.npz", LineCloud)
    # A line cloud normalises what it is given, which moves the last digit.
    np.testing.assert_array_equal(again.moment, cloud.moment)
    np.testing.assert_array_equal(again.direction, cloud.direction)
    assert again.scheme == "uniform"
    assert (again.rgb is None) == (not colours)
    if colours:
        np.testing.assert_array_equal(again.rgb, cloud.rgb)


def test_the_same_cloud_gives_the_same_bytes(tmp_path):
    for name in ("a.npz", "b.npz", "a.ply", "b.ply", "a.obj", "b.obj"):
        save_lines(cloud_of(colours=True), tmp_path / name)
    for ending in ("npz", "ply", "obj"):
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


def test_the_npz_holds_what_the_format_says_and_nothing_else(tmp_path):
    save_lines(cloud_of(), tmp_path / "lines.npz")
    with np.load(tmp_path / "lines.npz") as archive:
        found = {name: (archive[name].dtype.str, archive[name].shape) for name in archive}
    assert found == {
        "direction": ("<f8", (20, 3)),
        "moment": ("<f8", (20, 3)),
        "scheme": ("<U7", ()),
        "version": ("<i8", ()),
    }
    with zipfile.ZipFile(tmp_path / "lines.npz") as archive:
        assert {member.date_time for member in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


@pytest.mark.parametrize("ending", ["ply", "obj"])
@pytest.mark.parametrize("offset", [0.0, 1e5])
def test_line_sets_keep_the_lines(tmp_path, ending, offset):
    cloud = cloud_of(colours=True, offset=offset)
    path = tmp_path / f"lines.{ending}"
    save_lines(cloud, path)
    again = load_lines(path)
    same_lines(cloud, again, tolerance=1e-9)
    if ending == "ply":
        np.testing.assert_array_equal(again.rgb, cloud.rgb)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_npz_keeps_the_descriptors_to_the_bit(tmp_path, rng, dtype):
    descriptor = (rng.integers(0, 256, (20, 128)) if dtype == np.uint8 else rng.normal(size=(20, 64))).astype(dtype)
    appearance = Appearance(descriptor=descriptor, descriptor_kind="sift")
    cloud = LineCloud.through(rng.normal(size=(20, 3)), rng.normal(size=(20, 3)), appearance)
    save_lines(cloud, tmp_path / "lines.npz")
    again = load_lines(tmp_path / "lines.npz")
    assert again.descriptor is not None and again.descriptor.dtype == dtype and again.descriptor_kind == "sift"
    np.testing.assert_array_equal(again.descriptor, descriptor)
    with np.load(tmp_path / "lines.npz") as archive:
        assert list(archive) == ["direction", "moment", "descriptor", "descriptor_kind", "scheme", "version"]
        assert archive["version"] == 1, "a reader that knows no descriptors finds the lines"


def test_a_kind_without_descriptors_is_ignored(tmp_path):
    assert load_lines(npz(tmp_path / "lines.npz", descriptor_kind=np.array("sift"))).descriptor_kind is None


def test_line_sets_leave_out_what_they_cannot_hold(tmp_path):
    cloud = cloud_of(colours=True)
    rich = LineCloud(cloud.direction, cloud.moment, cloud.rgb, descriptor=np.ones((20, 8), dtype=np.uint8))
    for ending in ("ply", "obj"):
        save_lines(cloud, tmp_path / f"a.{ending}")
        save_lines(rich, tmp_path / f"b.{ending}")
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


def test_drawn_pieces_are_on_the_lines_and_blind_to_the_points():
    """The same lines through other points give the same pieces, so a piece cannot tell its point."""
    rng = np.random.default_rng(3)
    point, direction = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    cloud = LineCloud.through(point, direction)
    slid = LineCloud.through(point + rng.normal(size=(50, 1)) * direction, direction)
    start, stop = segments(cloud)
    np.testing.assert_allclose(np.cross(start, cloud.direction), cloud.moment, atol=1e-12)
    np.testing.assert_allclose(segments(slid)[0], start, atol=1e-9)
    length = np.linalg.norm(stop - start, axis=1)
    np.testing.assert_allclose(length, length[0])
    middle = (start + stop) / 2
    np.testing.assert_allclose(np.sum((middle - Frame.of(cloud).center) * cloud.direction, axis=1), 0, atol=1e-9)


@pytest.mark.parametrize("separator", [" ", ",", ";", "\t", ", ", " ; "])
def test_text_of_point_and_direction(tmp_path, separator):
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(5, 6))
    text = "# a comment\nx,y,z,dx,dy,dz\n\n" + "".join(
        separator.join(repr(float(v)) for v in row) + "  # tail\n" for row in rows
    )
    (tmp_path / "lines.whatever").write_text(text)
    same_lines(load_lines(tmp_path / "lines.whatever"), LineCloud.through(rows[:, :3], rows[:, 3:]))


def test_origins_are_canonical_on_reading(tmp_path):
    """Two files that place the point elsewhere on the line and scale or flip the direction are one line cloud."""
    (tmp_path / "a.txt").write_text("1 2 3 0 0 1\n0 1 0 1 0 0\n")
    (tmp_path / "b.txt").write_text("1 2 -50 0 0 -7\n9 1 0 0.5 0 0\n")
    first, second = load_lines(tmp_path / "a.txt"), load_lines(tmp_path / "b.txt")
    same_lines(first, second)
    np.testing.assert_allclose(first.origin, second.origin, atol=1e-12)


def test_obj_of_other_tools(tmp_path):
    text = """# exported
    o lines
    v 0 0 0 0.5 0.5 0.5
    v 0 0 2
    vn 0 0 1
    l 1 2
    v 1 0 0
    v 1 3 0 1.0
    l -2 -1
    l 1/1 3/2
    """
    (tmp_path / "lines.obj").write_text(text)
    cloud = load_lines(tmp_path / "lines.obj")
    expected = LineCloud.through(
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0]]), np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]])
    )
    same_lines(cloud, expected)


@pytest.mark.parametrize("order", ["<", ">", "ascii"])
def test_ply_line_sets_of_other_tools(tmp_path, order):
    from plyfile import PlyData, PlyElement

    kind = "<" if order == "ascii" else order
    vertex = np.array([(0, 0, 0), (0, 0, 2), (1, 3, 0)], dtype=[(name, kind + "f4") for name in "xyz"])
    edge = np.array([(0, 1), (2, 0)], dtype=[("vertex1", kind + "i4"), ("vertex2", kind + "i4")])
    data = PlyData(
        [PlyElement.describe(vertex, "vertex"), PlyElement.describe(edge, "edge")],
        text=order == "ascii",
        byte_order=kind,
    )
    data.write(str(tmp_path / "lines.ply"))
    expected = LineCloud.through(np.array([[0.0, 0, 0], [0, 0, 0]]), np.array([[0.0, 0, 1], [1, 3, 0]]))
    same_lines(load_lines(tmp_path / "lines.ply"), expected)


def test_the_kind_is_told_from_the_content_and_not_the_name(tmp_path):
    save_lines(cloud_of(), tmp_path / "lines.npz")
    (tmp_path / "lines.npz").rename(tmp_path / "lines.txt")
    assert len(load_lines(tmp_path / "lines.txt")) == 20


def test_a_written_line_cloud_has_the_order_of_its_directions(tmp_path):
    """What lift hides stays hidden in the file: the rows say nothing about the order of the scene."""
    points = np.cumsum(np.random.default_rng(0).normal(size=(500, 3)), axis=0)
    hidden = hide(points, seed=5)
    cloud, index = hidden.map, hidden.truth.index
    save_lines(cloud, tmp_path / "lines.npz")
    again = load_lines(tmp_path / "lines.npz")
    order = np.lexsort(again.direction.T)
    np.testing.assert_array_equal(order, np.arange(500))
    assert (again.direction[:, 2] >= 0).all()
    assert abs(np.corrcoef(index, np.arange(500))[0, 1]) < 0.2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"moment": None}, "holds direction, scheme, version; direction needs points or moments beside it"),
        ({"version": np.array(2)}, "version 2; this l2p reads up to 1, so upgrade"),
        ({"version": np.array(0)}, "version 0"),
        ({"version": np.array("1")}, "version of type <U1; expected integers"),
        ({"version": np.array([1])}, r"version of shape \(1,\); expected \(\)"),
        ({"scheme": np.array(3)}, "scheme of type int64; expected a string"),
        ({"direction": np.ones((20, 2))}, r"direction of shape \(20, 2\); expected \(any, 3\)"),
        ({"direction": np.ones(3)}, r"direction of shape \(3,\)"),
        ({"direction": np.ones((19, 3))}, r"moment of shape \(20, 3\); expected \(19, 3\)"),
        ({"direction": np.full((20, 3), "x")}, "direction of type <U1; expected numbers"),
        ({"direction": np.ones((20, 3), dtype=complex)}, "direction of type complex128; expected numbers"),
        ({"direction": np.zeros((20, 3))}, "20 line.s. with a direction of length other than 1"),
        ({"direction": np.full((20, 3), np.nan)}, "direction that is NaN, infinite or beyond 1e30"),
        ({"direction": changed(cloud_of().direction, 7, 0.0)}, "1 line.s. .* first at line 7"),
        ({"moment": changed(cloud_of().moment, 3, np.inf)}, "moment that is NaN, infinite or .*, first at line 3"),
        ({"moment": changed(cloud_of().moment, 3, cloud_of().direction[3])}, "not perpendicular to its direction"),
        ({"moment": np.zeros((0, 3)), "direction": np.zeros((0, 3))}, "has no lines; expected at least one"),
        ({"rgb": np.zeros((20, 3))}, "rgb of type float64; expected integers"),
        ({"rgb": np.zeros((20, 3), dtype=np.int64)}, "rgb of type int64; expected uint8"),
        ({"rgb": np.zeros((5, 3), dtype=np.uint8)}, r"rgb of shape \(5, 3\); expected \(20, 3\)"),
        ({"descriptor": np.zeros((19, 4), dtype=np.uint8)}, r"descriptor of shape \(19, 4\); expected \(20, any\)"),
        ({"descriptor": np.zeros(20, dtype=np.uint8)}, r"descriptor of shape \(20,\); expected \(20, any\)"),
        ({"descriptor": np.zeros((20, 0), dtype=np.uint8)}, r"got descriptors of type uint8, shape \(20, 0\)"),
        ({"descriptor": np.zeros((20, 4), dtype=np.int8)}, "descriptors of type int8; expected uint8 or float32"),
        ({"descriptor": np.zeros((20, 4), dtype="U1")}, "descriptor of type <U1; expected numbers"),
        (
            {"descriptor": changed(np.zeros((20, 4)), 3, np.nan)},
            r"got 1 descriptor\(s\) that are NaN .* first in row 3",
        ),
        ({"descriptor": changed(np.zeros((20, 4)), 3, 1e300)}, r"got 1 descriptor\(s\) that are NaN or infinite"),
        (
            {"descriptor": np.zeros((20, 4)), "descriptor_kind": np.array(1)},
            "descriptor_kind of type int64; expected a s",
        ),
        ({"descriptor": np.full((20, 4), None)}, "holds Python objects"),
        ({"direction": np.full((20, 3), None)}, "holds Python objects, which l2p never loads"),
    ],
)
def test_a_wrong_npz_is_named_and_explained(tmp_path, changes, message):
    path = npz(tmp_path / "bad.npz", **changes)
    with pytest.raises(InputError, match=f"bad.npz.*{message}"):
        load_lines(path)


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_a_pickle_is_never_loaded(tmp_path):
    target = tmp_path / "boom"
    bomb = np.empty((1, 3), dtype=object)
    bomb[:] = Bomb(target)
    path = npz(tmp_path / "bomb.npz", direction=bomb)
    with pytest.raises(InputError, match="holds Python objects"):
        load_lines(path)
    (tmp_path / "bare.npz").write_bytes(pickle.dumps(Bomb(target)))
    with pytest.raises(InputError):
        load_lines(tmp_path / "bare.npz")
    assert not target.exists()
    pickle.loads(pickle.dumps(Bomb(target)))
    assert target.exists(), "the bomb of this test is a dud"


def test_files_that_are_no_line_cloud(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.npz does not exist"):
        load_lines(tmp_path / "missing.npz")
    with pytest.raises(InputError, match="is a folder without points3D"):
        load_lines(tmp_path)
    (tmp_path / "empty.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty\.npz is empty"):
        load_lines(tmp_path / "empty.npz")
    np.savez(tmp_path / "scene.npz", xyz=np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"scene\.npz is a scene \(npz\); expected a line cloud"):
        load_lines(tmp_path / "scene.npz")
    np.save(tmp_path / "bare.npy", np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"bare\.npy holds points .*, not lines; hide the points first"):
        load_lines(tmp_path / "bare.npy")
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0\x00\x10JFIF")
    with pytest.raises(InputError, match="is a JPEG picture"):
        load_lines(tmp_path / "photo.jpg")
    (tmp_path / "latin.txt").write_bytes("caf\xe9 1 2 3".encode("latin-1"))
    with pytest.raises(InputError, match=r"holds points .*, not lines"):
        load_lines(tmp_path / "latin.txt")
    with pytest.raises(InputError, match=r"lines\.las ends with '\.las'; expected a line cloud to end with"):
        save_lines(cloud_of(), tmp_path / "lines.las")


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.99])
@pytest.mark.parametrize("ending", ["npz", "ply"])
def test_a_truncated_file_is_refused(tmp_path, ending, share):
    save_lines(cloud_of(), tmp_path / f"lines.{ending}")
    whole = (tmp_path / f"lines.{ending}").read_bytes()
    (tmp_path / "cut").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match="cut"):
        load_lines(tmp_path / "cut")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3 4 5\n", "5 columns without names.*--columns"),
        ("a b c d e f\n1 2 3 4 5 6 7\n", "7 columns without names"),
        ("1 2 3 4 5 6\na b c d e f\n", "line 2"),
        ("1 2 3 x 5 6\n", "line 1"),
        ("a b c\n", "has no rows of numbers"),
        ("# nothing\n", "has no rows of numbers"),
        ("1 2 3 0 0 0\n", "direction of length 0"),
        ("1 2 nan 0 0 1\n", "NaN"),
        ("1 2 3 0 0 inf\n", "infinite"),
        ("1e308 1e308 1e308 1e308 1 1\n", "bad.txt"),
        ("v 0 0 0\nv 1 0 0\n", r"is a point cloud \(OBJ\); expected a line cloud"),
        ("v 0 0 0\nv 1 0 0\nl 1 2 1\n", "line 3: got 'l 1 2 1'; expected exactly two vertices"),
        ("v 0 0\nl 1 1\n", "line 1: got 'v 0 0'; expected three numbers"),
        ("v 0 0 0\nl 1 2\n", "line to vertex 1; expected 0 to 0"),
        ("v 0 0 0\nl 0 1\n", "line 2"),
        ("v 0 0 0\nl 1 -2\n", "line 2"),
        ("v 0 0 0\nl 1 99999999999999999999\n", "line 2"),
        ("v 0 0 0\nv 0 0 0\nl 1 2\n", "direction of length 0"),
    ],
)
def test_wrong_text_is_named_with_its_line(tmp_path, text, message):
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(InputError, match=f"bad.txt.*{message}|bad.txt.*") as caught:
        load_lines(tmp_path / "bad.txt")
    assert caught.match(message)


@pytest.mark.parametrize(
    ("vertex", "edge", "message"),
    [
        ("property double x\nproperty double y", "property int vertex1\nproperty int vertex2", "lacks the property z"),
        ("property double x\nproperty double y\nproperty double z", "property int vertex1", "lacks .* vertex2"),
        (
            "property double x\nproperty double y\nproperty double z",
            "property float vertex1\nproperty float vertex2",
            "expected integers",
        ),
        (
            "property double x\nproperty double y\nproperty list uchar double z",
            "property int vertex1\nproperty int vertex2",
            "are lists",
        ),
    ],
)
def test_a_wrong_ply_is_explained(tmp_path, vertex, edge, message):
    values = {"property int vertex1": "0", "property float vertex1": "0.0"}
    rows = [
        " ".join("1 0" if "list" in line else "0" for line in vertex.splitlines()),
        " ".join(values.get(line, "0") for line in edge.splitlines()),
    ]
    header = f"ply\nformat ascii 1.0\nelement vertex 1\n{vertex}\nelement edge 1\n{edge}\nend_header\n"
    (tmp_path / "bad.ply").write_text(header + "\n".join(rows) + "\n")
    with pytest.raises(InputError, match=f"bad.ply.*{message}"):
        load_lines(tmp_path / "bad.ply")


def test_elements_whose_name_begins_with_edge_are_no_lines(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "bad.ply").write_text(f"{header}element edgege 1\nproperty int vertex1\nend_header\n0 0 0\n0\n")
    with pytest.raises(InputError, match="expected a line cloud"):
        load_lines(tmp_path / "bad.ply")


@pytest.mark.parametrize("code", [0x110000, 0x7FFFFFFF, 0xD800])
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_scheme_that_is_no_text_is_refused(tmp_path, code, order):
    """Codes beyond the last character, which NumPy reads all the same, and half of a surrogate pair."""
    scheme = np.array([code], dtype=f"{order}u4").view(f"{order}U1").reshape(())
    direction = np.eye(3)
    arrays = {"direction": direction, "moment": np.roll(direction, 1, axis=0), "scheme": scheme, "version": 1}
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(InputError, match=r"bad.npz has a scheme that is no text"):
        load_lines(tmp_path / "bad.npz")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("text", ["", "uniform", "naïve 線 \U0001d54f"])
def test_any_text_is_read_in_either_byte_order(tmp_path, order, text):
    direction = np.eye(3)
    scheme = np.array(text, dtype=np.array(text).dtype.newbyteorder(order))
    arrays = {"direction": direction, "moment": np.roll(direction, 1, axis=0), "scheme": scheme, "version": 1}
    np.savez(tmp_path / "lines.npz", **arrays)
    assert load_lines(tmp_path / "lines.npz").scheme == text


def test_a_ply_with_an_empty_list_is_read_without_a_word(tmp_path, recwarn):
    path = tmp_path / "lines.ply"
    vertex = "element vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    edge = "element edge 1\nproperty list uchar int other\nproperty int vertex1\nproperty int vertex2\n"
    path.write_text(f"ply\nformat ascii 1.0\n{vertex}{edge}end_header\n0 0 0\n1 1 1\n0 0 1\n")
    assert len(load_lines(path)) == 1
    assert not recwarn.list


def test_an_existing_file_is_kept(tmp_path):
    (tmp_path / "lines.npz").write_bytes(b"precious")
    with pytest.raises(InputError, match=r"exists; choose another path, or replace it"):
        l2p.save(cloud_of(), tmp_path / "lines.npz")
    assert (tmp_path / "lines.npz").read_bytes() == b"precious"
    l2p.save(cloud_of(), tmp_path / "lines.npz", overwrite=True)
    assert len(l2p.load(tmp_path / "lines.npz", LineCloud)) == 20


def test_nothing_but_arrays_is_in_the_file(tmp_path):
    save_lines(cloud_of(), tmp_path / "lines.npz")
    with zipfile.ZipFile(tmp_path / "lines.npz") as archive:
        for name in archive.namelist():
            np.load(io.BytesIO(archive.read(name)), allow_pickle=False)
        assert archive.comment == b""
