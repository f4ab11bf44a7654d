"""Points as text, and how many digits a PLY has."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

import l2p
from l2p.io.ply import loses_digits
from l2p.io.recovery_files import save_recovery
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene

POINTS = np.random.default_rng(0).normal(size=(40, 3)) * [1e-7, 1, 1e9]
RGB = np.random.default_rng(1).integers(0, 256, (40, 3), dtype=np.uint8)


def recovery_of(rgb: np.ndarray | None = RGB) -> Recovery:
    kept = np.arange(40) % 3 > 0
    return Recovery(POINTS, np.linspace(0, 1, 40, dtype=np.float32), np.zeros(40), rgb, kept=kept)


def test_coordinates_come_back_equal_to_the_bit(tmp_path: Path) -> None:
    recovery = recovery_of()
    kept = recovery.kept
    for ending in ("xyz", "txt", "csv"):
        l2p.save(recovery, tmp_path / f"out.{ending}")
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "out.xyz"), POINTS[kept])
    table = np.loadtxt(tmp_path / "out.txt")
    np.testing.assert_array_equal(table[:, :3], POINTS[kept])
    np.testing.assert_array_equal(table[:, 3:6], RGB[kept])
    np.testing.assert_allclose(table[:, 6], recovery.confidence[kept], rtol=1e-5)
    with (tmp_path / "out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["x", "y", "z", "red", "green", "blue", "confidence"]
    np.testing.assert_array_equal([[float(row[axis]) for axis in "xyz"] for row in rows], POINTS[kept])


def test_there_are_no_columns_of_what_there_is_not(tmp_path: Path) -> None:
    l2p.save(recovery_of(rgb=None), tmp_path / "out.csv")
    assert (tmp_path / "out.csv").read_text().splitlines()[0] == "x,y,z,confidence"
    l2p.save(Scene(POINTS), tmp_path / "scene.txt")
    assert (tmp_path / "scene.txt").read_text().splitlines()[0] == "# x y z"
    with pytest.raises(l2p.InputError, match=r"out\.csv exists"):
        l2p.save(recovery_of(), tmp_path / "out.csv")


@pytest.mark.parametrize(
    ("shift", "scale", "far", "double"),
    [(0, 1, None, False), (0, 1e-6, None, False), (10, 1, None, False), (5e6, 100, None, True), (0, 1, 1e5, True)],
)
def test_a_ply_has_single_precision_unless_it_would_lose_digits(tmp_path: Path, shift, scale, far, double) -> None:
    xyz = np.random.default_rng(2).normal(size=(300, 3)) * scale + shift
    if far is not None:
        xyz[7] *= far
    assert loses_digits(xyz) == double
    l2p.save(Scene(xyz), tmp_path / "scene.ply")
    vertex = PlyData.read(str(tmp_path / "scene.ply"))["vertex"].data
    assert vertex["x"].dtype == (np.float64 if double else np.float32)
    back, size = l2p.load(tmp_path / "scene.ply").xyz, np.ptp(np.delete(xyz, 7, axis=0))
    assert np.abs(back - xyz).max() <= 1e-6 * size
    flat = np.zeros(300)
    save_recovery(Recovery(xyz, flat.astype(np.float32), flat), tmp_path / "out.ply", double=not double)
    vertex = PlyData.read(str(tmp_path / "out.ply"))["vertex"].data
    assert vertex["x"].dtype == (np.float32 if double else np.float64)
