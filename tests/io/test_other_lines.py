"""Line clouds of other tools: npz by usual names, without version or scheme."""

from __future__ import annotations

import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.io.kinds import Kind, kind_of
from l2p.io.line_files import load_lines
from l2p.io.taken_for import taken_for
from l2p.maps.lines import LineCloud

ROWS = 60
RNG = np.random.default_rng(0)
XYZ = RNG.normal([3, 0, 1], 1, size=(ROWS, 3))
DIRECTION = RNG.normal(size=(ROWS, 3))
DIRECTION /= np.linalg.norm(DIRECTION, axis=1, keepdims=True)
SLID = XYZ + RNG.normal(size=(ROWS, 1)) * DIRECTION
LONG = 3 * DIRECTION
MOMENT = np.cross(XYZ, DIRECTION)


@pytest.mark.parametrize(
    "arrays",
    [
        {"points": SLID, "directions": LONG},
        {"origins": SLID, "dirs": DIRECTION},
        {"o": SLID.astype(np.float32), "d": DIRECTION.astype(np.float32)},
        {"p": SLID, "d": LONG},
        {"rays_o": SLID, "rays_d": LONG},
        {"xyz": SLID, "directions": DIRECTION},
        {"Start": SLID, "End": SLID - LONG},
        {"p1": XYZ, "p2": XYZ + LONG},
        {"directions": LONG, "moments": 3 * MOMENT},
        {"direction": DIRECTION, "moment": MOMENT},
        {"direction": DIRECTION, "moment": MOMENT, "version": 1},
        {"pluecker": np.c_[DIRECTION, MOMENT]},
        {"plucker": np.c_[MOMENT, DIRECTION]},
        {"lines": np.c_[SLID, DIRECTION]},
        {"lines": np.c_[DIRECTION, SLID]},
        {"segments": np.stack([SLID, SLID + LONG], axis=1)},
    ],
    ids=lambda arrays: " ".join(arrays),
)
def test_usual_arrays_make_the_same_lines(tmp_path, arrays):
    rgb = RNG.integers(0, 256, (ROWS, 3), dtype=np.uint8)
    descriptor = RNG.normal(size=(ROWS, 8)).astype(np.float32)
    path = tmp_path / "other.npz"
    np.savez(path, **arrays, colors=rgb / 255, descriptors=descriptor, names=np.zeros(2))
    lines, expected = load_lines(path), LineCloud.through(XYZ, DIRECTION)
    sign = np.sign(np.sum(lines.direction * expected.direction, axis=1, keepdims=True))
    np.testing.assert_allclose(sign * lines.direction, expected.direction, atol=1e-5)
    np.testing.assert_allclose(sign * lines.moment, expected.moment, atol=1e-5)
    np.testing.assert_array_equal(lines.rgb, rgb)
    np.testing.assert_array_equal(lines.descriptor, descriptor)
    assert lines.scheme == "unknown" and kind_of(path) is Kind.LINES_FOREIGN
    said = "other.npz: 60 lines with colours and descriptors (line cloud of another tool, npz)"
    assert taken_for(path, lines) == said


def test_what_does_not_belong_to_the_lines_is_left_out_and_a_scheme_is_kept(tmp_path):
    few = np.zeros((5, 3), dtype=np.uint8)
    np.savez(tmp_path / "a.npz", points=XYZ, directions=DIRECTION, rgb=few, descriptor=few, scheme=np.array("ppl"))
    lines = l2p.load(tmp_path / "a.npz")
    assert lines.rgb is None and lines.descriptor is None and lines.scheme == "ppl"


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"origins": XYZ}, "holds origins; origins needs directions beside it; expected .*LineCloud.through"),
        ({"directions": DIRECTION}, "directions needs points or moments beside it; .*LineCloud.through"),
        ({"moments": MOMENT}, "moments needs directions beside it"),
        ({"foo": XYZ}, "holds foo; expected direction and moment"),
        ({"points": XYZ, "directions": DIRECTION[:9]}, r"has directions of shape \(9, 3\); expected \(60, 3\)"),
        ({"points": XYZ.T, "directions": DIRECTION.T}, r"has points of shape \(3, 60\); expected \(any, 3\)"),
        ({"points": XYZ, "directions": 0 * DIRECTION}, "60 line.s. with a direction of length 0"),
        ({"directions": DIRECTION, "moments": DIRECTION}, "60 of 60 lines whose moment is not perpendicular"),
        ({"pluecker": 2 * np.c_[DIRECTION, MOMENT]}, "no three are unit vectors.*write them as two arrays"),
        ({"lines": np.c_[XYZ, MOMENT[::-1] + 7]}, "lines has 6 columns without names, .*l2p.LineCloud.through"),
        ({"lines": np.zeros((9, 5))}, r"has lines of shape \(9, 5\); expected \(any, 6\)"),
        ({"lines": np.zeros((9, 5, 2))}, r"has lines of shape \(9, 5, 2\); expected \(any, 2, 3\)"),
        ({"points": XYZ, "directions": np.full((ROWS, 3), "x")}, "directions of type <U1; expected numbers"),
    ],
)
def test_what_is_missing_is_named_with_the_way_out(tmp_path, arrays, message):
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(InputError, match=rf"bad\.npz.*{message}"):
        load_lines(tmp_path / "bad.npz")


def test_a_scene_beside_vague_names_stays_a_scene(tmp_path):
    np.savez(tmp_path / "scene.npz", xyz=XYZ, d=np.zeros(ROWS), m=DIRECTION)
    assert kind_of(tmp_path / "scene.npz") is Kind.SCENE_NPZ
