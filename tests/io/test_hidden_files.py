"""Files of pairs, planes and permuted points: what they hold, and damaged ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.io.hidden_files import load_hidden, load_permuted, load_planes, save_hidden
from l2p.io.kinds import Kind, kind_of
from l2p.io.line_files import load_lines

GOOD: dict[str, dict[str, Any]] = {
    "planes": {"normal": np.eye(3), "offset": np.arange(3.0)},
    "permuted": {"permuted": np.arange(9.0).reshape(3, 3)},
    "lines": {"direction": np.eye(3), "moment": np.roll(np.eye(3), 1, axis=0)},
}


def written(path: Path, kind: str, **changes: Any) -> Path:
    arrays = {**GOOD[kind], "scheme": np.array("own"), "version": np.array(1), **changes}
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


@pytest.mark.parametrize(
    ("scheme", "names"),
    [
        ("planes", ["normal", "offset"]),
        ("permuted", ["permuted"]),
        ("ppl", ["direction", "moment"]),
    ],
)
def test_a_file_holds_what_the_format_says_and_nothing_else(tmp_path: Path, scheme: str, names: list[str]) -> None:
    points = np.random.default_rng(0).normal(size=(40, 3))
    rgb, descriptor = np.zeros((40, 3), np.uint8), np.ones((40, 8), np.float32)
    save_hidden(l2p.lift(points, 0, scheme=scheme), tmp_path / "bare.npz")
    save_hidden(l2p.lift(points, 0, scheme=scheme, rgb=rgb, descriptor=descriptor), tmp_path / "rich.npz")
    second = ["second_rgb", "second_descriptor"] if scheme == "ppl" else []
    with np.load(tmp_path / "bare.npz") as bare, np.load(tmp_path / "rich.npz") as rich:
        assert list(bare) == [*names, "scheme", "version"]
        assert list(rich) == [*names, "rgb", "descriptor", "descriptor_kind", *second, "scheme", "version"]
        assert bare["version"] == rich["version"] == 1


def test_kinds_are_not_mixed_up(tmp_path: Path) -> None:
    paths = {kind: written(tmp_path / f"{kind}.npz", kind) for kind in GOOD}
    assert [kind_of(path) for path in paths.values()] == [Kind.PLANES, Kind.PERMUTED, Kind.LINES_NPZ]
    readers = {"planes": load_planes, "permuted": load_permuted, "lines": load_lines}
    for kind, path in paths.items():
        assert len(readers[kind](path)) == len(load_hidden(path)) == 3
        for other, reader in readers.items():
            if other != kind:
                with pytest.raises(InputError, match=rf"{kind}.npz is a .* \(npz\); expected a .*l2p lift"):
                    reader(path)
        with pytest.raises(InputError, match=r"is a .*; expected a scene"):
            l2p.load(path, l2p.Scene)
        with pytest.raises(InputError, match=r"is a .*; expected a recovery|is a .*; expected"):
            l2p.load(path, l2p.Recovery)
    np.savez(tmp_path / "scene.npz", xyz=np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"scene.npz is a scene \(npz\); expected a line cloud or another hidden map"):
        load_hidden(tmp_path / "scene.npz")


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        ("planes", {"normal": np.eye(3) * 2}, r"normal of length other than 1"),
        ("planes", {"normal": np.eye(3)[:2]}, r"offset of shape \(3,\); expected \(2\)"),
        ("planes", {"offset": np.array([0, np.nan, 0])}, r"offset that is NaN or infinite"),
        ("planes", {"normal": np.zeros((0, 3)), "offset": np.zeros(0)}, r"is empty; expected at least one point"),
        ("planes", {"version": np.array(9)}, r"has version 9; this l2p reads up to 1"),
        ("planes", {"scheme": None}, r"has no scheme"),
        ("planes", {"rgb": np.zeros((2, 3), np.uint8)}, r"rgb of shape \(2, 3\); expected \(3, 3\)"),
        ("permuted", {"permuted": np.full((3, 3), np.inf)}, r"xyz that is NaN, infinite"),
        ("permuted", {"permuted": np.zeros((3, 2))}, r"permuted of shape \(3, 2\)"),
        ("permuted", {"permuted": np.full((3, 3), None)}, r"holds Python objects"),
        ("lines", {"second_rgb": np.zeros((3, 3), np.uint8)}, r"got rgb of the second points and nothing of the first"),
        ("lines", {"second_descriptor": np.zeros((2, 8))}, r"second_descriptor of shape \(2, 8\); expected \(3, any\)"),
        ("lines", {"second_rgb": np.zeros((3, 3), np.int64)}, r"second_rgb of type int64; expected uint8"),
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path: Path, kind: str, changes: dict[str, Any], message: str) -> None:
    path = written(tmp_path / "bad.npz", kind, **changes)
    with pytest.raises(InputError, match=message) as caught:
        load_hidden(path)
    assert "bad.npz" in str(caught.value)


@pytest.mark.parametrize("ending", ["ply", "obj", "txt"])
@pytest.mark.parametrize("scheme", ["planes", "permuted"])
def test_planes_and_permuted_points_go_to_npz_only(tmp_path: Path, ending: str, scheme: str) -> None:
    cloud = l2p.lift(np.random.default_rng(0).normal(size=(40, 3)), 0, scheme=scheme)
    with pytest.raises(InputError, match=rf"ends with '.{ending}'; expected .* to end with .npz"):
        l2p.save(cloud, tmp_path / f"map.{ending}")
    assert not list(tmp_path.iterdir())
