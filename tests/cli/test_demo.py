"""The demonstration from end to end, small."""

from __future__ import annotations

import numpy as np
import pytest

import l2p
from l2p.attacks.settings import DEFAULT_METHOD
from l2p.cli import demo
from l2p.cli.main import main
from l2p.maps.scene import Scene
from l2p.maps.truth import Truth


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("demo") / "out"
    demo.run(path, points=400, seed=3)
    return path


def test_files_are_all_there(folder):
    assert {path.name for path in folder.iterdir()} == set(demo.FILES)


def test_files_agree(folder):
    scene, truth = l2p.load(folder / demo.MODEL, Scene), l2p.load(folder / demo.TRUTH, Truth)
    recovery = l2p.load(folder / demo.RECOVERY, l2p.Recovery)
    lines = l2p.load(folder / demo.LINES, l2p.LineCloud)
    np.testing.assert_array_equal(scene.xyz[truth.index], truth.xyz)
    assert len(scene) == len(lines) == len(recovery) == len(l2p.load(folder / demo.CLOUD, Scene)) == 400


def test_the_default_method_is_shown(folder):
    assert l2p.load(folder / demo.RECOVERY, l2p.Recovery).info["method"] == DEFAULT_METHOD


def test_truth_and_model_make_a_recovered_model(folder, tmp_path):
    words = ["recover", str(folder / demo.LINES), "-o", str(tmp_path / "model"), "--method", "tomography"]
    assert main([*words, "--model", str(folder / demo.MODEL), "--truth", str(folder / demo.TRUTH)]) == 0
    assert len(l2p.load(tmp_path / "model", Scene)) == 400


def test_line_cloud_has_no_colours(folder):
    assert l2p.load(folder / demo.LINES, l2p.LineCloud).rgb is None


def test_picture_is_a_png(folder):
    assert (folder / demo.PICTURE).read_bytes().startswith(b"\x89PNG")


def test_earlier_output_is_kept(folder):
    with pytest.raises(l2p.InputError, match="exists"):
        demo.run(folder, points=400, seed=3)


def test_earlier_output_is_replaced_on_demand(folder, capsys):
    demo.run(folder, points=300, seed=3, overwrite=True)
    assert len(l2p.load(folder / demo.TRUTH, Truth)) == 300
    table = capsys.readouterr().out
    assert "median error" in table and DEFAULT_METHOD in table


def test_foreign_folder_is_never_replaced(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(l2p.InputError, match=r"letter\.txt"):
        demo.run(tmp_path, points=300, seed=3, overwrite=True)
    assert (tmp_path / "letter.txt").read_text() == "dear"
