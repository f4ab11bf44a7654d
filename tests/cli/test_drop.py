"""``--drop-box``, ``--drop-ids``, ``--drop-masks`` of ``l2p lift`` and ``l2p audit``."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import l2p
from l2p.cli.main import main
from l2p.io.colmap import read_model
from l2p.judging.accuracy import spacing
from l2p.maps.region import Box
from l2p.simulator import simulate_model

#: The cheapest attack, where any will do.
CHEAP = ("--method", "tomography", "--fractions", 1, 0.5, "--queries", 2)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A COLMAP model, an npz with its points, a line cloud, a list of ids and a mask."""
    folder = tmp_path_factory.mktemp("files")
    simulate_model("room", 300, 2).save_colmap(folder / "model")
    scene = l2p.load(folder / "model", l2p.Scene)
    assert scene.ids is not None and scene.rgb is not None
    np.savez(folder / "scene.npz", xyz=scene.xyz, rgb=scene.rgb)
    l2p.save(l2p.lift(scene, seed=0), folder / "lines.npz")
    (folder / "ids.txt").write_text("\n".join(map(str, scene.ids[10:40])))
    image = next(iter(read_model(folder / "model").images.values()))
    camera = read_model(folder / "model").cameras[image.camera_id]
    (folder / "masks").mkdir()
    grey = np.full((camera.height, camera.width), 255, np.uint8)
    grey[: camera.height // 2] = 0
    Image.fromarray(grey).save(folder / "masks" / f"{image.name}.png")
    (folder / "white").mkdir()
    Image.fromarray(np.full_like(grey, 255)).save(folder / "white" / f"{image.name}.png")
    return folder


@pytest.fixture
def scene(files) -> l2p.Scene:
    return l2p.load(files / "model", l2p.Scene)


def run(*words: object) -> int:
    return main([str(word) for word in words])


def half(scene: l2p.Scene) -> list[float]:
    """The half of the scene that is farther along x, as six numbers."""
    return [float(np.median(scene.xyz[:, 0])), *scene.xyz.min(axis=0)[1:], *scene.xyz.max(axis=0)]


def test_lift_leaves_out_and_says_how_many(files, scene, tmp_path, capsys):
    words = ("-o", tmp_path / "lines.npz", "--truth", tmp_path / "truth.npz", "--rgb", "--seed", 3)
    assert run("lift", files / "scene.npz", *words, "--drop-box", *half(scene)) == 0
    told = capsys.readouterr()
    drop = Box.of(half(scene)).contains(scene.xyz)
    assert told.out.splitlines()[1] == f"left out: {drop.sum()} of 300 points"
    assert told.err == "", "nothing is looked for beside an npz"
    lines, truth = l2p.load(tmp_path / "lines.npz", l2p.LineCloud), l2p.load(tmp_path / "truth.npz", l2p.Truth)
    assert len(lines) == len(truth) == (~drop).sum()
    assert scene.rgb is not None
    np.testing.assert_array_equal(lines.rgb, scene.rgb[truth.index])
    np.testing.assert_array_equal(truth.xyz, scene.xyz[truth.index])
    assert not Box.of(half(scene)).contains(truth.xyz).any()
    assert truth.spacing == spacing(scene.xyz), "of the whole map"


def test_flags_add_up(files, scene, tmp_path, capsys):
    assert scene.ids is not None
    boxes = [[-np.inf, -np.inf, -np.inf, *np.quantile(scene.xyz, 0.3, axis=0)], half(scene)]
    expected = np.isin(np.arange(300), np.arange(10, 40))
    words: list[object] = ["--drop-ids", files / "ids.txt"]
    for box in boxes:
        expected |= Box.of(box).contains(scene.xyz)
        words += ["--drop-box", *box]
    out = tmp_path / "lines.npz"
    assert (
        run("lift", files / "model", "-o", out, "--truth", tmp_path / "t.npz", *words, "--drop-masks", files / "masks")
        == 0
    )
    told = capsys.readouterr()
    ids = l2p.load(tmp_path / "t.npz", l2p.Truth).ids
    assert ids is not None and not set(ids.tolist()) & set(scene.ids[expected].tolist())
    assert len(ids) < (~expected).sum(), "masks leave out more"
    assert f"left out: {300 - len(ids)} of 300 points (1 of " in told.out and "images have a mask)" in told.out


def test_lift_of_a_model_names_what_would_undo_it(files, tmp_path, capsys):
    assert run("lift", files / "model", "-o", tmp_path / "lines.npz") == 0
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and told.startswith(f"l2p: do not publish beside it, of {files / 'model'}: ")
    for name in ("points3D.bin (the points)", "images.bin (where images see the points)", "../scene.npz (true points)"):
        assert name in told
    assert "lines.npz" not in told and "cameras" not in told


def test_an_audit_proves_what_was_left_out(files, scene, tmp_path, capsys):
    box = half(scene)
    assert run("audit", files / "scene.npz", "-o", tmp_path / "report", *CHEAP, "--drop-box", *box) == 0
    told = " ".join(capsys.readouterr().out.split())
    drop = Box.of(box).contains(scene.xyz)
    assert (
        f"{drop.sum()} points of the map were left out (50 %): " in told and "a published neighbour that near" in told
    )
    figures = json.loads((tmp_path / "report" / "audit.json").read_text())
    assert figures["points"] == 300 and figures["left_out"]["points"] == drop.sum()
    assert len(figures["left_out"]["near"]) == len(figures["trials"]) == 2
    assert figures["trials"][0]["lines"] == (~drop).sum()
    page = (tmp_path / "report" / "index.html").read_text()
    assert "What was left out" in page and "Left out on request" in page
    program, *again = shlex.split(figures["command"])
    assert program == "l2p" and "--drop-box" in again
    assert run(*again, "--force") == 0
    assert json.loads((tmp_path / "report" / "audit.json").read_text())["left_out"] == figures["left_out"]


def test_the_command_of_a_report_has_every_flag(files, tmp_path):
    words = (
        "--drop-ids",
        files / "ids.txt",
        "--drop-masks",
        files / "masks",
        "--drop-box",
        "-inf",
        -1e-3,
        0,
        1,
        2,
        3e5,
    )
    assert run("audit", files / "model", "-o", tmp_path / "report", *CHEAP, *words) == 0
    first = json.loads((tmp_path / "report" / "audit.json").read_text())
    assert "--drop-box -inf -0.001 0 1 2 300000" in first["command"]
    assert run(*shlex.split(first["command"])[1:], "--force") == 0
    assert json.loads((tmp_path / "report" / "audit.json").read_text())["left_out"] == first["left_out"]


def test_without_flags_nothing_is_left_out(files, tmp_path, capsys):
    assert run("audit", files / "scene.npz", "-o", tmp_path / "report", *CHEAP) == 0
    assert "left out" not in capsys.readouterr().out
    figures = json.loads((tmp_path / "report" / "audit.json").read_text())
    assert figures["left_out"] is None and "--drop" not in figures["command"]
    assert "left out" not in (tmp_path / "report" / "index.html").read_text().split("<script")[0].lower()


BAD = [
    (
        ("scene.npz", "--drop-box", 90, 90, 90, 91, 91, 91),
        "holds none of the 300 points; expected a box in scene units",
    ),
    (
        ("scene.npz", "--drop-box", -1e9, -1e9, -1e9, 1e9, 1e9, 1e9),
        "got all 300 points to drop; expected some that stay",
    ),
    (("scene.npz", "--drop-box", 0, 0, 0, 1, 1, "nan"), "got a box from (0.0, 0.0, 0.0) to (1.0, 1.0, nan)"),
    (("scene.npz", "--drop-box", 0, 0, 0, 1, 1), "argument --drop-box: expected 6 arguments"),
    (("scene.npz", "--drop-box", 0, 0, 0, 1, 1, "x"), "argument --drop-box: invalid float value: 'x'"),
    (("scene.npz", "--drop-ids", "ids.txt"), "got point ids ids.txt for a scene without ids"),
    (("model", "--drop-ids", "absent.txt"), "absent.txt: no such file"),
    (("model", "--drop-ids", "masks"), "masks is a folder; expected point ids as text"),
    (("model", "--drop-ids", "scene.npz"), "scene.npz has no point3D_id"),
    (("scene.npz", "--drop-masks", "masks"), "--drop-masks for a scene without images; expected a COLMAP model"),
    (("model", "--drop-masks", "absent"), "absent is not a folder; expected a folder of masks"),
    (("model", "--drop-masks", "model"), "model has no mask of the"),
    (("model", "--drop-masks", "white"), "no image sees a point in a black pixel of its mask in white (1 masks)"),
]


@pytest.mark.parametrize("command", ["lift", "audit"])
@pytest.mark.parametrize(("words", "sentence"), BAD)
def test_errors_are_one_sentence_and_leave_nothing(files, monkeypatch, tmp_path, capsys, command, words, sentence):
    monkeypatch.chdir(files)
    try:
        code = run(command, words[0], "-o", tmp_path / "out.npz", *words[1:])
    except SystemExit as stop:
        code = stop.code
    told = capsys.readouterr()
    assert code == 2 and sentence in told.err and told.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_points_of_a_line_cloud_cannot_be_left_out(files, tmp_path, capsys):
    assert run("audit", files / "lines.npz", "-o", tmp_path / "out", "--drop-box", 0, 0, 0, 1, 1, 1) == 2
    assert "for a line cloud, whose points are unknown; expected it of l2p lift" in capsys.readouterr().err
    with pytest.raises(l2p.InputError, match="which has none; drop them when the map is lifted"):
        l2p.audit(l2p.load(files / "lines.npz", l2p.LineCloud), drop=np.ones(300, dtype=bool))


def test_outputs_are_not_inputs(files, capsys):
    ids = files / "ids.txt"
    before = ids.read_bytes()
    assert run("lift", files / "model", "-o", files / "x.npz", "--truth", ids, "--force", "--drop-ids", ids) == 2
    assert "got" in capsys.readouterr().err and ids.read_bytes() == before
