"""Recoveries keep the order of the lines in npz, and colour and confidence in PLY."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData

import l2p
from l2p.errors import InputError
from l2p.io.recovery_files import confidence_colours, load_recovery, save_recovery
from l2p.io.scene_files import load_scene
from l2p.maps.recovery import Recovery


def recovery_of(count: int = 12, colours: bool = True) -> Recovery:
    rng = np.random.default_rng(0)
    return Recovery(
        xyz=rng.normal(size=(count, 3)),
        confidence=rng.random(count, dtype=np.float32),
        beta=rng.normal(size=count),
        rgb=rng.integers(0, 256, size=(count, 3), dtype=np.uint8) if colours else None,
        neighbors=rng.integers(-1, count, size=(count, 4)),
        affinity=rng.random((count, 4), dtype=np.float32),
        kept=rng.random(count) < 0.5,
        info={"method": "heuristic", "settings": {"rounds": 3}, "seconds": 1.5},
        calibrated=True,
    )


def bare(recovery: Recovery) -> Recovery:
    return Recovery(recovery.xyz, recovery.confidence, recovery.beta)


def test_npz_keeps_everything_but_the_clock(tmp_path):
    recovery = recovery_of()
    l2p.save(recovery, tmp_path / "out.npz")
    again = l2p.load(tmp_path / "out.npz", Recovery)
    for name in ("xyz", "confidence", "beta", "rgb", "neighbors", "affinity", "kept"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recovery, name), strict=True)
    assert again.info == {"method": "heuristic", "settings": {"rounds": 3}}
    assert again.calibrated is True
    l2p.save(replace(recovery, calibrated=False), tmp_path / "ranks.npz")
    assert load_recovery(tmp_path / "ranks.npz").calibrated is False


@pytest.mark.parametrize(("method", "calibrated"), [("learned", True), ("heuristic", False), ("mine", False)])
def test_version_1_knew_one_calibrated_method(tmp_path, method, calibrated):
    l2p.save(replace(recovery_of(), info={"method": method}), tmp_path / "new.npz")
    with np.load(tmp_path / "new.npz") as archive:
        arrays = {name: archive[name] for name in archive.files if name != "calibrated"}
    np.savez(tmp_path / "old.npz", **arrays | {"version": np.array(1)})  # type: ignore[arg-type]
    assert load_recovery(tmp_path / "old.npz").calibrated is calibrated
    np.savez(tmp_path / "cut.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"cut.npz has no calibrated"):
        load_recovery(tmp_path / "cut.npz")


def test_the_same_recovery_gives_the_same_bytes_however_long_it_took(tmp_path):
    save_recovery(recovery_of(), tmp_path / "a.npz")
    save_recovery(replace(recovery_of(), info=recovery_of().info | {"seconds": 99.0}), tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_what_is_unknown_is_left_out(tmp_path):
    save_recovery(bare(recovery_of()), tmp_path / "out.npz")
    again = load_recovery(tmp_path / "out.npz")
    assert again.rgb is again.neighbors is again.affinity is again.kept is None
    assert again.info == {}


def test_ply_holds_the_kept_points_with_colour_and_confidence(tmp_path):
    recovery = recovery_of()
    save_recovery(recovery, tmp_path / "out.ply")
    vertex = PlyData.read(str(tmp_path / "out.ply"))["vertex"].data
    np.testing.assert_array_equal(vertex["confidence"], recovery.confidence[recovery.kept])
    np.testing.assert_array_equal(vertex["x"], recovery.xyz[recovery.kept, 0].astype(np.float32))
    assert vertex.dtype["confidence"] == np.float32
    assert recovery.rgb is not None
    np.testing.assert_array_equal(load_scene(tmp_path / "out.ply").rgb, recovery.rgb[recovery.kept])


def test_ply_without_colours_shows_the_confidence(tmp_path):
    recovery = bare(recovery_of())
    save_recovery(recovery, tmp_path / "out.ply")
    np.testing.assert_array_equal(load_scene(tmp_path / "out.ply").rgb, confidence_colours(recovery.confidence))


def test_colours_of_confidence_get_lighter():
    colours = confidence_colours(np.linspace(0, 1, 11)).astype(int)
    assert colours[0].tolist() == [68, 1, 84]
    assert colours[-1].tolist() == [253, 231, 37]
    assert (np.diff(colours @ [0.2126, 0.7152, 0.0722]) > 0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": np.array(9)}, "version 9"),
        ({"xyz": np.full((12, 3), np.nan)}, "points that are NaN, infinite or beyond 1e30"),
        ({"beta": np.zeros(5)}, r"beta of shape \(5,\); expected \(12\)"),
        ({"confidence": np.full(12, 1.5)}, r"confidences outside \[0, 1\]"),
        ({"confidence": np.full(12, np.nan)}, r"confidences outside \[0, 1\]"),
        ({"affinity": np.zeros((12, 2))}, r"affinity of shape \(12, 2\); expected \(12, 4\)"),
        ({"kept": np.ones(12)}, "kept of type float64; expected booleans"),
        ({"info": np.array("{")}, "info that is not JSON"),
        ({"info": np.array("3")}, "info that is a int; expected a JSON object"),
        ({"info": np.array({"a": 1}, dtype=object)}, "holds Python objects"),
        ({"rgb": np.zeros((12, 3))}, "rgb of type float64"),
        ({"element": np.arange(12) - 1}, "element -1"),
        ({"calibrated": np.array(1)}, "calibrated of type int64; expected booleans"),
    ],
)
def test_a_wrong_npz_is_named_and_explained(tmp_path, changes, message):
    recovery = recovery_of()
    l2p.save(recovery, tmp_path / "bad.npz")
    with np.load(tmp_path / "bad.npz") as archive:
        arrays = dict(archive) | changes
    np.savez(tmp_path / "bad.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=f"bad.npz.*{message}"):
        load_recovery(tmp_path / "bad.npz")


def test_what_is_no_recovery(tmp_path):
    save_recovery(recovery_of(), tmp_path / "out.ply")
    with pytest.raises(InputError, match=r"out\.ply is a point cloud .*a PLY does not keep the order of the lines"):
        load_recovery(tmp_path / "out.ply")
    with pytest.raises(FileNotFoundError):
        load_recovery(tmp_path / "missing.npz")
    with pytest.raises(InputError, match=r"ends with '\.pcd'; expected a recovery to end with \.npz, .*or \.csv"):
        save_recovery(recovery_of(), tmp_path / "out.pcd")
