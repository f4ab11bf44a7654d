"""Pictures in an audit: which there are, of whose points, and who may see them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from toy import SEES

import l2p
from l2p.auditing.seen import pictures_of, places_of
from l2p.cli.main import main
from l2p.errors import InputError
from l2p.images.inversion_file import load_inversion
from l2p.images.picture import draw
from l2p.images.picture_points import points_of
from l2p.io.colmap import read_model
from l2p.simulator import simulate_model


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """A model of which every second photograph is there."""
    folder = tmp_path_factory.mktemp("seen") / "model"
    simulate_model("room", 300, 2).save_colmap(folder)
    (folder / "images").mkdir()
    reconstruction = read_model(folder)
    for image in sorted(reconstruction.images.values(), key=lambda image: image.name)[::2]:
        camera = reconstruction.cameras[image.camera_id]
        gray = np.full((camera.height // 4, camera.width // 4, 3), 90, dtype=np.uint8)
        Image.fromarray(gray).save(folder / "images" / image.name)
    return folder


@pytest.fixture(scope="module")
def found(model) -> l2p.Audit:
    scene = l2p.load(model, l2p.Scene)
    audit = l2p.audit(scene, [1, 0.5], method=SEES)
    return replace(audit, pictures=pictures_of(audit.trials, scene, places_of(model, 4)))


def test_there_is_a_picture_of_the_true_points_and_of_every_attack(model, found):
    scene, (network, _) = l2p.load(model, l2p.Scene), load_inversion()
    assert len(found.pictures) == 4
    for seen in found.pictures:
        first, *attacks = seen.shots
        assert first.fraction is None and first.used == ("rgb",)
        np.testing.assert_array_equal(first.image, draw(network, points_of(scene), seen.place.view))
        assert [(shot.fraction, shot.used) for shot in attacks] == [(t.fraction, t.used) for t in found.trials]
        with_photograph = seen.place.photograph is not None
        assert all((shot.like is not None) == with_photograph for shot in seen.shots)
    assert {seen.place.photograph is None for seen in found.pictures} == {True, False}


def test_points_have_the_colours_of_their_lines_and_attackers_see_what_they_may(model, found):
    """An attacker who sees lines alone draws the same, whatever the colours are."""
    scene = l2p.load(model, l2p.Scene)
    assert scene.rgb is not None
    other = replace(scene, rgb=255 - scene.rgb)
    places = [seen.place for seen in found.pictures[:1]]
    changed = pictures_of(found.trials, other, places)[0].shots
    for before, after in zip(found.pictures[0].shots, changed, strict=True):
        assert np.array_equal(before.image, after.image) == (before.used == ())
    plain = pictures_of(found.trials[:1], scene, places, ignored=["rgb"])[0].shots[0]
    assert plain.used == ()


def test_points_that_were_left_out_are_in_no_picture(model, found):
    scene = l2p.load(model, l2p.Scene)
    drop = np.zeros(len(scene), dtype=bool)
    drop[::2] = True
    places = [found.pictures[0].place]
    shot = pictures_of([], scene, places, drop=drop)[0].shots[0]
    kept = pictures_of([], scene.rows(~drop), places)[0].shots[0]
    np.testing.assert_array_equal(shot.image, kept.image)


def test_the_page_shows_them_and_a_shared_one_does_not(found, tmp_path):
    l2p.save_report(found, tmp_path / "report")
    page = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    photographs = sum(seen.place.photograph is not None for seen in found.pictures)
    assert page.count("data:image/jpeg;base64,") == photographs + sum(len(seen.shots) for seen in found.pictures)
    assert "What an attacker sees" in page and "No pictures are shown" not in page
    told = json.loads((tmp_path / "report" / "audit.json").read_text())["pictures"]
    assert [each["view"] for each in told] == [seen.place.view.name for seen in found.pictures]
    l2p.save_report(found, tmp_path / "shared", share=True)
    shared = (tmp_path / "shared" / "index.html").read_text(encoding="utf-8")
    assert "data:image/jpeg" not in shared and found.pictures[0].place.view.name not in shared
    assert "pictures" not in json.loads((tmp_path / "shared" / "audit.json").read_text())


def test_the_command_takes_a_number_of_views(model, tmp_path, capsys):
    words = ["audit", str(model), "-o", str(tmp_path / "report"), "--method", "tomography", "--fractions", "1"]
    assert main([*words, "--queries", "0", "--views", "1"]) == 0
    content = json.loads((tmp_path / "report" / "audit.json").read_text())
    assert len(content["pictures"]) == 1 and "--views 1" in content["command"]
    capsys.readouterr()
    assert main([*words, "--force", "--views", "7"]) == 2
    assert "got 7 views; expected 0 to 6" in capsys.readouterr().err


def test_views_need_a_model(tmp_path, capsys):
    np.savez(tmp_path / "scene.npz", xyz=np.random.default_rng(0).normal(size=(300, 3)))
    words = ["audit", str(tmp_path / "scene.npz"), "-o", str(tmp_path / "report"), "--views", "2"]
    assert main(words) == 2
    assert "got views of a map that is no COLMAP model" in capsys.readouterr().err


def test_a_folder_that_lacks_a_photograph_is_refused_if_it_was_given(model, tmp_path):
    with pytest.raises(FileNotFoundError, match="give the folder of the model's photographs"):
        places_of(model, 1, tmp_path)
    with pytest.raises(InputError, match="got 7 views; expected 0 to 6"):
        places_of(model, 7)
    assert places_of(model, 0) == []
