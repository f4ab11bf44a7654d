"""What an audit says of a region: its figures are those of a slow loop, however the region is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from toy import SEES, telling_scene

import l2p
from l2p.auditing import report
from l2p.auditing.words import region, sentences
from l2p.cli.main import main
from l2p.errors import InputError
from l2p.maps.region import Box
from l2p.simulator import simulate_model

CHEAP = ("--method", "tomography", "--fractions", "1", "0.5")


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    return telling_scene(240)


@pytest.fixture(scope="module")
def inside(scene) -> np.ndarray:
    return Box.of([0, 0, -9, 9, 9, 9]).contains(scene.xyz)


@pytest.fixture(scope="module")
def found(scene, inside) -> l2p.Audit:
    return l2p.audit(scene, [1, 0.3], seed=5, method=SEES, region=inside)


def test_figures_are_those_of_a_slow_loop(found, scene, inside):
    asked = found.region
    assert asked is not None and asked.points == inside.sum() and len(asked.trials) == len(found.trials) == 8
    for trial, got in zip(found.trials, asked.trials, strict=True):
        assert trial.truth is not None
        own = [
            float(np.linalg.norm(trial.recovery.xyz[row] - trial.truth.xyz[row])) / found.spacing
            for row, point in enumerate(trial.truth.index)
            if inside[point]
        ]
        assert got.published == len(own)
        assert got.within == pytest.approx(np.mean([error <= 1 for error in own]))
        assert got.median == pytest.approx(np.median(own))


def test_a_region_changes_nothing_else(found, scene):
    other = l2p.audit(scene, [1, 0.3], seed=5, method=SEES)
    assert other.region is None and [each.within for each in other.trials] == [each.within for each in found.trials]


def test_words_page_and_json_say_it(found, tmp_path):
    said = region(found)
    assert said in sentences(found) and "in the region" in said and "come back within 1" in said
    assert "The region" in report.report_page(found).decode()
    assert json.loads(json.dumps(report.figures_of(found)))["region"]["points"] == found.region.points


def test_a_region_of_which_nothing_is_published(scene):
    one = np.zeros(len(scene), dtype=bool)
    one[0] = True
    audits = [l2p.audit(scene, [0.05], seed=seed, method=SEES, region=one) for seed in range(4)]
    empty = next(audit for audit in audits if audit.region is not None and not audit.region.trials[0].published)
    assert region(empty).endswith("none of them is published.")
    assert b"The region" in report.report_page(empty)


@pytest.mark.parametrize("wrong", [np.zeros(240, dtype=bool), np.ones(3, dtype=bool)], ids=["no point", "other rows"])
def test_wrong_regions_are_refused(scene, wrong):
    with pytest.raises(InputError, match="got a region of"):
        l2p.audit(scene, [1], method=SEES, region=wrong)


def test_a_line_cloud_has_no_region(scene, inside):
    with pytest.raises(InputError, match="whose points are unknown"):
        l2p.audit(l2p.lift(scene, seed=0), method=SEES, region=inside)


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_boxes_ids_and_masks_name_the_same_region(tmp_path: Path, capsys):
    from PIL import Image

    model = simulate_model("room", 300, 2)
    model.save_colmap(tmp_path / "model")
    scene = l2p.load(tmp_path / "model", l2p.Scene)
    image = 3
    seen = np.unique(model.view_point[model.view_camera == image])
    mask = np.zeros((model.cameras.height, model.cameras.width), dtype=np.uint8)
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / f"frame{image:05d}.jpg.png")
    assert scene.ids is not None
    (tmp_path / "ids.txt").write_text(" ".join(str(each) for each in scene.ids[seen]))
    counts = []
    for number, flags in enumerate(
        (("--region-ids", tmp_path / "ids.txt"), ("--region-masks", tmp_path / "masks")),
    ):
        output = tmp_path / f"report{number}"
        assert run("audit", tmp_path / "model", "-o", output, *CHEAP, "--queries", 0, *flags) == 0
        figures = json.loads((output / "audit.json").read_text())
        counts.append(figures["region"])
        assert str(flags[0]) in figures["command"]
    assert counts[0] == counts[1] and counts[0]["points"] == len(seen)
    assert "in the region" in capsys.readouterr().out
    box = (*scene.xyz.min(axis=0), *scene.xyz.max(axis=0))
    words = ("audit", tmp_path / "model", "-o", tmp_path / "all", *CHEAP, "--queries", 0, "--region-box", *box)
    assert run(*words) == 0
    assert json.loads((tmp_path / "all" / "audit.json").read_text())["region"]["points"] == len(scene)


def test_a_line_cloud_with_a_region_is_refused_by_the_command(tmp_path, capsys):
    l2p.save(l2p.lift(l2p.simulate("room", 200).xyz, seed=0), tmp_path / "lines.npz")
    box = ("--region-box", 0, 0, 0, 1, 1, 1)
    assert run("audit", tmp_path / "lines.npz", "-o", tmp_path / "report", *box) == 2
    assert "--region-" in capsys.readouterr().err
