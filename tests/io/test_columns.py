"""Rows of numbers are read as what they are: by names in any order, by the numbers, or as the user says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.io.kinds import Kind, kind_of
from l2p.io.line_files import load_lines
from l2p.io.scene_files import load_scene
from l2p.io.table_files import table_layout
from l2p.io.taken_for import taken_for
from l2p.maps.lines import LineCloud

ROWS = 400


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def sheet() -> dict[str, np.ndarray]:
    """Points of a wavy surface away from the origin, its normals, and what may stand beside a point in a file."""
    rng = np.random.default_rng(5)
    u, v = rng.uniform(-1, 1, (2, ROWS)) * 3
    xyz = np.c_[u, v, np.sin(u) + 0.3 * v**2] + [2, 1, 4]
    normal = unit(np.c_[-np.cos(u), -0.6 * v, np.ones(ROWS)])
    direction = unit(rng.normal(size=(ROWS, 3)))
    far = xyz + rng.uniform(1, 3, (ROWS, 1)) * direction
    return {
        "xyz": xyz,
        "normal": normal,
        "direction": direction,
        "end": far,
        "moment": np.cross(xyz, direction),
        "foot": xyz - np.sum(xyz * direction, axis=1, keepdims=True) * direction,
        "rgb": rng.integers(0, 256, (ROWS, 3)).astype(float),
    }


def write(path: Path, *columns: np.ndarray, header: str = "", form: str = "%.8g", separator: str = " ") -> Path:
    np.savetxt(path, np.concatenate(columns, axis=1), fmt=form, delimiter=separator, header=header, comments="")
    return path


def same_lines(found: LineCloud, point: np.ndarray, direction: np.ndarray, tolerance: float = 1e-5) -> None:
    expected = LineCloud.through(point, direction)
    sign = np.sign(np.sum(found.direction * expected.direction, axis=1, keepdims=True))
    np.testing.assert_allclose(sign * found.direction, expected.direction, atol=tolerance)
    np.testing.assert_allclose(sign * found.moment, expected.moment, atol=20 * tolerance)


@pytest.mark.parametrize(
    ("names", "parts"),
    [
        ("x,y,z,dx,dy,dz", ("xyz", "direction")),
        ("dir_x,dir_y,dir_z,px,py,pz", ("direction", "xyz")),
        ("X1,Y1,Z1,X2,Y2,Z2", ("xyz", "end")),
        ("x0,y0,z0,x1,y1,z1", ("xyz", "end")),
        ("start_x,start_y,start_z,end_x,end_y,end_z", ("xyz", "end")),
        ("d1,d2,d3,m1,m2,m3", ("direction", "moment")),
        ("mx,my,mz,dx,dy,dz", ("moment", "direction")),
        ("#R,G,B,ox,oy,oz,vx,vy,vz", ("rgb", "xyz", "direction")),
        ('"x","y","z","nx","ny","nz","dx","dy","dz"', ("xyz", "normal", "direction")),
    ],
)
@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_names_in_any_order_make_the_same_lines(tmp_path, sheet, names, parts, separator):
    header = names.replace(",", separator)
    path = write(tmp_path / "a.csv", *(sheet[part] for part in parts), header=header, separator=separator)
    lines = load_lines(path)
    same_lines(lines, sheet["xyz"], sheet["direction"])
    if "rgb" in parts:
        np.testing.assert_array_equal(lines.rgb, sheet["rgb"])
    assert kind_of(path) is Kind.LINES_TEXT and not table_layout(path).told_by


@pytest.mark.parametrize(
    ("names", "parts", "content"),
    [
        ("X,Y,Z,R,G,B", ("xyz", "rgb"), "points with colours (columns x y z r g b)"),
        ("//X Y Z Red Green Blue", ("xyz", "rgb"), "points with colours (columns x y z r g b)"),
        ("# x y z nx ny nz", ("xyz", "normal"), "points with normals (columns x y z nx ny nz)"),
        ("r,g,b,x,y,z,Nx,Ny,Nz", ("rgb", "xyz", "normal"), "points with colours and normals"),
        ("# columns: x y z diffuse_red diffuse_green diffuse_blue", ("xyz", "rgb"), "points with colours"),
        ("x,y,z,alpha,beta,gamma", ("xyz", "direction"), "points (columns x y z)"),
    ],
)
def test_named_points_are_a_scene_and_never_lines(tmp_path, sheet, names, parts, content):
    separator = "," if "," in names else " "
    path = write(tmp_path / "map.csv", *(sheet[part] for part in parts), header=names, separator=separator)
    scene = load_scene(path)
    np.testing.assert_allclose(scene.xyz, sheet["xyz"], atol=1e-6)
    if "rgb" in parts:
        np.testing.assert_array_equal(scene.rgb, sheet["rgb"])
    assert taken_for(path, scene).startswith(f"map.csv: {ROWS} {content}")
    with pytest.raises(InputError, match=r"map\.csv holds points.*, not lines; hide the points first with l2p lift"):
        load_lines(path)


def test_colours_without_names_are_colours_of_any_usual_range(tmp_path, sheet):
    for number, (rgb, form) in enumerate(((sheet["rgb"], "%.8g"), (sheet["rgb"] / 255, "%.4f"))):
        path = write(tmp_path / f"{number}.txt", sheet["xyz"], rgb, form=form)
        np.testing.assert_array_equal(load_scene(path).rgb, sheet["rgb"])
        assert "columns x y z r g b, recognised by their values" in taken_for(path, load_scene(path))
    first = load_scene(write(tmp_path / "first.txt", sheet["rgb"], sheet["xyz"]))
    np.testing.assert_allclose(first.xyz, sheet["xyz"], atol=1e-6)
    np.testing.assert_array_equal(first.rgb, sheet["rgb"])
    wide = load_scene(write(tmp_path / "wide.csv", sheet["xyz"], 257 * sheet["rgb"], header="x y z r g b"))
    np.testing.assert_array_equal(wide.rgb, sheet["rgb"])


@pytest.mark.parametrize("order", [("xyz", "normal"), ("normal", "xyz")])
@pytest.mark.parametrize("form", ["%.8g", "%.2f"])
def test_normals_without_names_are_told_from_directions(tmp_path, sheet, order, form):
    """Both are unit vectors; only normals are perpendicular to the surface, and vary smoothly along it."""
    rng = np.random.default_rng(0)
    flipped = {**sheet, "normal": sheet["normal"] * rng.choice([-1, 1], (ROWS, 1))}
    path = write(tmp_path / "n.txt", *(flipped[part] for part in order), form=form)
    np.testing.assert_allclose(load_scene(path).xyz, sheet["xyz"], atol=0.006)
    lines = write(tmp_path / "d.txt", *(sheet[{"normal": "direction"}.get(part, part)] for part in order), form=form)
    same_lines(load_lines(lines), sheet["xyz"], sheet["direction"], 0.02)


@pytest.mark.parametrize("first", ["direction", "moment", "foot"])
def test_pluecker_rows_are_read_in_both_orders_and_feet_are_not_moments(tmp_path, sheet, first):
    """Moments and feet are both perpendicular to the directions: lines of a map come closer to each other."""
    beside = "moment" if first == "direction" else "direction"
    path = write(tmp_path / "a.txt", sheet[first], sheet[beside])
    same_lines(load_lines(path), sheet["xyz"], sheet["direction"])
    assert table_layout(path).has(("mx", "my", "mz")) == (first != "foot")


def test_two_points_of_a_line_are_told_from_a_point_and_a_direction(tmp_path, sheet):
    same_lines(load_lines(write(tmp_path / "e.txt", sheet["xyz"], sheet["end"])), sheet["xyz"], sheet["direction"])
    long = sheet["direction"] * np.random.default_rng(1).uniform(0.5, 9, (ROWS, 1))
    same_lines(load_lines(write(tmp_path / "d.txt", sheet["xyz"], long)), sheet["xyz"], sheet["direction"])
    one = np.ones((ROWS, 1))
    ends = write(tmp_path / "h.txt", 2 * sheet["xyz"], 2 * one, sheet["end"], one, header="x1 y1 z1 w1 x2 y2 z2 w2")
    same_lines(load_lines(ends), sheet["xyz"], sheet["direction"])
    for last, second in ((1, "end"), (0, "direction")):
        same_lines(
            load_lines(write(tmp_path / f"{last}.txt", sheet["xyz"], one, sheet[second], last * one)),
            sheet["xyz"],
            sheet["direction"],
        )


@pytest.mark.parametrize("length", ["as it is", "unit"])
def test_lines_of_other_schemes_are_still_lines(tmp_path, sheet, length):
    """Rays, spheres, parallels and pairs are not uniform, and neither normals nor the ends of lines."""
    xyz, rng = sheet["xyz"], np.random.default_rng(3)
    centers = np.array([[2.0, 1, 9], [0, 2, 5]])
    cases = {
        "sphere": xyz - centers[0],
        "rays": xyz - centers[rng.integers(0, 2, ROWS)],
        "parallel": np.tile([0.3, 0.5, 0.9], (ROWS, 1)),
        "pairs": xyz[np.roll(rng.permutation(ROWS), 1)] - xyz + 1e-9,
    }
    for name, direction in cases.items():
        direction = unit(direction) if length == "unit" else direction
        path = write(tmp_path / f"{name}.txt", xyz, direction, form="%.10g")
        same_lines(load_lines(path), xyz, direction, 1e-3)


@pytest.mark.parametrize("separator", [";", " ", "\t", "; "])
def test_decimal_commas(tmp_path, sheet, separator):
    path = write(tmp_path / "a.csv", sheet["xyz"], sheet["direction"], separator=separator)
    path.write_text(path.read_text().replace(".", ","))
    same_lines(load_lines(path), sheet["xyz"], sheet["direction"])
    named = tmp_path / "b.csv"
    named.write_text(separator.join(["X1", "Y1", "Z1", "dx", "dy", "dz"]) + "\n" + path.read_text(), encoding="utf-16")
    same_lines(load_lines(named), sheet["xyz"], sheet["direction"])


def test_names_of_rows_and_counts_are_no_columns(tmp_path, sheet):
    rows = [" ".join(f"{v:.8g}" for v in row) for row in np.c_[sheet["xyz"], sheet["direction"]]]
    texts = {
        "pts": [str(ROWS), *rows],
        "r": ['"x" "y" "z" "dx" "dy" "dz"', *(f'"row{n}" {row}' for n, row in enumerate(rows))],
        "pandas": [",x,y,z,dx,dy,dz", *(f"{n},{row.replace(' ', ',')}" for n, row in enumerate(rows))],
        "windows": ["# Höhe über Null", *rows],
    }
    for name, text in texts.items():
        (tmp_path / name).write_bytes("\r\n".join(text).encode("cp1252"))
        same_lines(load_lines(tmp_path / name), sheet["xyz"], sheet["direction"])


def test_an_array_is_read_like_text(tmp_path, sheet):
    np.save(tmp_path / "lines.npy", np.c_[sheet["xyz"], sheet["direction"]].astype(np.float32))
    np.save(tmp_path / "points.npy", sheet["xyz"])
    np.save(tmp_path / "colours.npy", np.c_[sheet["xyz"], sheet["rgb"]])
    same_lines(load_lines(tmp_path / "lines.npy"), sheet["xyz"], sheet["direction"])
    np.testing.assert_array_equal(load_scene(tmp_path / "points.npy").xyz, sheet["xyz"])
    np.testing.assert_array_equal(l2p.load(tmp_path / "colours.npy").rgb, sheet["rgb"])
    assert kind_of(tmp_path / "lines.npy") is Kind.LINES_ARRAY and kind_of(tmp_path / "points.npy") is Kind.SCENE_ARRAY


def test_columns_that_the_user_names_count_more_than_a_header(tmp_path, sheet):
    path = write(tmp_path / "a.txt", sheet["xyz"], sheet["direction"], sheet["rgb"], header="x y z nx ny nz r g b")
    assert kind_of(path) is Kind.SCENE_TEXT
    lines = load_lines(path, "x,y,z,dx,dy,dz,r,g,b")
    same_lines(lines, sheet["xyz"], sheet["direction"])
    np.testing.assert_array_equal(lines.rgb, sheet["rgb"])
    swapped = l2p.load(path, l2p.LineCloud, columns="dx,dy,dz,x,y,z,-,-,-")
    np.testing.assert_allclose(np.abs(np.sum(swapped.direction * unit(sheet["xyz"]), axis=1)), 1, atol=1e-6)
    for wrong, message in (
        ("x,y,z", "which has 9 columns; expected a name for each"),
        ("x,y,z,a,b,c,-,-,-", "expected names in the order of the columns"),
        ("x,y,-,-,-,-,-,-,-", "expected names in the order of the columns"),
    ):
        with pytest.raises(InputError, match=f"got --columns {wrong}.*{message}"):
            load_lines(path, wrong)
    np.savez(tmp_path / "scene.npz", xyz=sheet["xyz"])
    with pytest.raises(InputError, match=r"got --columns for .*scene\.npz, which is a scene \(npz\)"):
        l2p.load(tmp_path / "scene.npz", columns="x,y,z")


def test_where_nothing_decides_the_user_is_asked(tmp_path, sheet):
    rng = np.random.default_rng(2)
    turned = np.cross(rng.normal(size=(20, 3)), sheet["direction"][:20])
    undecided = {
        "unrelated": np.c_[sheet["xyz"], rng.normal(size=(ROWS, 3)) * [1, 1, 9] + 5],
        "whole": rng.integers(0, 9, (5, 6)),
        "both unit": np.c_[sheet["direction"], unit(rng.normal(size=(ROWS, 3)))],
        "scaled pluecker": np.c_[sheet["moment"], sheet["direction"]] * rng.uniform(2, 3, (ROWS, 1)),
        "few pluecker": np.c_[turned, sheet["direction"][:20]],
        "five": rng.normal(size=(ROWS, 5)),
        "four": rng.normal(size=(ROWS, 4)),
    }
    for name, rows in undecided.items():
        path = write(tmp_path / name, np.asarray(rows, dtype=float))
        for read in (load_lines, load_scene):
            with pytest.raises(InputError, match=f"{name} has .* columns without names, .*; say .*--columns"):
                read(path)


def test_a_few_rows_are_a_point_and_a_direction_and_called_assumed(tmp_path, sheet):
    path = write(tmp_path / "few.txt", sheet["xyz"][:5], sheet["direction"][:5])
    lines = load_lines(path)
    same_lines(lines, sheet["xyz"][:5], sheet["direction"][:5])
    assert taken_for(path, lines) == "few.txt: 5 lines (columns x y z dx dy dz, assumed, as nothing else tells)"


def test_the_ending_of_open3d_tells_normals(tmp_path, sheet):
    path = write(tmp_path / "few.xyzn", sheet["xyz"][:5], sheet["normal"][:5])
    assert taken_for(path, load_scene(path)) == "few.xyzn: 5 points (point cloud, xyz, pts)"


def test_a_ply_with_normals_is_points_and_called_so(tmp_path, sheet):
    header = "ply\nformat ascii 1.0\nelement vertex 400\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")) + "end_header"
    path = write(tmp_path / "map.ply", sheet["xyz"], sheet["normal"], header=header)
    assert taken_for(path, load_scene(path)) == "map.ply: 400 points with normals (point cloud, PLY)"
    with pytest.raises(InputError, match=r"is a point cloud \(PLY\); expected .*hide the points first with l2p lift"):
        load_lines(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x y z r g b\n1.5 2 3 -1 0 9\n", "has colours from -1 to 9; expected 0 to 255"),
        ("x y z w\n1 2 3 1\n1 2 3 0\n", "a point with w = 0 in row 1"),
        ("dx dy dz mx my mz\n1 0 0 1 2 3\n", "1 of 1 lines whose moment is not perpendicular"),
        ("x y z dx dy dz\n", "has no rows of numbers"),
        ("1 2 3 4 5 6\n1 2 3 4 5\n", "line 2: got '1 2 3 4 5'; expected six numbers, as in the first row"),
        (" ".join(["1"] * 65) + "\n", "line 1 has 65 columns; expected at most 64"),
    ],
)
def test_wrong_rows_are_named(tmp_path, text, message):
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(InputError, match=rf"bad\.txt.*{message}"):
        load_scene(tmp_path / "bad.txt") if kind_of(tmp_path / "bad.txt") is Kind.SCENE_TEXT else load_lines(
            tmp_path / "bad.txt"
        )


def test_an_array_of_another_shape_is_refused(tmp_path):
    for array in (np.zeros(6), np.zeros((2, 2, 2)), np.zeros((0, 6)), np.full((3, 6), "x"), np.zeros((3, 6), complex)):
        np.save(tmp_path / "bad.npy", array)
        with pytest.raises(InputError, match=r"bad\.npy is an npy array of type .*; expected numbers of shape"):
            load_lines(tmp_path / "bad.npy")
