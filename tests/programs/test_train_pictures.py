"""The training of pictures: through the real config, on one tiny simulated map with photographs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("hydra", reason="the training program needs the extra train: pip install 'l2p[train]'")
pytest.importorskip("lightning", reason="the training program needs the extra train: pip install 'l2p[train]'")

import lightning
from hydra import compose, initialize_config_dir
from lightning.pytorch.callbacks import Callback
from PIL import Image
from safetensors.torch import load_file

from l2p.errors import InputError
from l2p.images.inversion import Inversion
from l2p.images.inversion_file import load_inversion
from l2p.images.projection import Marks
from l2p.io.colmap import read_model
from l2p.simulator import simulate_model
from l2p.work.progress import NO_PROGRESS
from train.picture_clouds import PictureMap, picture_maps
from train.picture_config import PictureRun, picture_run_of
from train.picture_module import PictureModule, joined, partly, picture_loss, thinned
from train.picture_training import train_pictures
from train.train_config import CONFIGS

COMMAND = "python -m train --config-name pictures"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A model with descriptors and photographs."""
    place = tmp_path_factory.mktemp("maps") / "room"
    simulate_model("room", 300, 3).save_colmap(place)
    model, rng = read_model(place), np.random.default_rng(0)
    ids = np.array(sorted(model.point3D_ids()), dtype=np.uint64)
    descriptor = rng.integers(200, size=(len(ids), 128), dtype=np.uint8)
    np.savez(place / "descriptors.npz", point3D_id=ids, descriptor=descriptor)
    (place / "images").mkdir()
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        noise = rng.integers(256, size=(camera.height // 4, camera.width // 4, 3), dtype=np.uint8)
        Image.fromarray(noise).save(place / "images" / image.name)
    return place


def settings(folder: Path, *overrides: str) -> PictureRun:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        words = ["experiment=debug_pictures", f"maps=[{folder}]", f"val_maps=[{folder}]", *overrides]
        return picture_run_of(compose("pictures", words))


@pytest.fixture(scope="module")
def trained(folder, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("run")
    assert train_pictures(settings(folder), run, COMMAND) == run / "model.safetensors"
    return run


def test_a_run_leaves_weights_with_their_record(trained):
    network, facts = load_inversion(trained / "model.safetensors")
    assert network.config.widths == (8, 8, 8)
    assert facts["steps"] == 6 and facts["command"] == COMMAND and facts["config"]["crop"] == 32
    assert facts == json.loads((trained / "results.json").read_text())
    assert [row["points"] for row in facts["results"]] == ["true", "lines", "all"]
    assert all(0 < row["network"]["ssim"] < 1 and row["filled"]["psnr"] > 0 for row in facts["results"])
    assert "val/ssim" in (trained / "figures.csv").read_text()


class StopAt(Callback):
    """Ends a run after some steps, as a kill after its last state."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: object) -> None:
        trainer.should_stop |= trainer.global_step >= self.step


def test_a_resumed_run_ends_with_the_same_weights(folder, trained, tmp_path):
    train_pictures(settings(folder), tmp_path, COMMAND, [StopAt(4)])
    found = {file: file.stat().st_mtime_ns for file in (tmp_path / "recovered").iterdir()}
    train_pictures(settings(folder), tmp_path, COMMAND)
    left, right = (load_file(run / "model.safetensors") for run in (tmp_path, trained))
    for name, value in left.items():
        assert torch.equal(value, right[name]), name
    assert {file: file.stat().st_mtime_ns for file in found} == found  # points are recovered once


def test_points_are_where_the_photograph_shows_them_in_every_crop(folder, tmp_path):
    """Also mirrored and tinted: with points of the colours of a painted photograph, each pixel has its point's."""
    run = settings(folder, "recovered=0", "absent=0", "crop=64")
    one = picture_maps([str(folder)], [1.0], 0, tmp_path, NO_PROGRESS)[0]
    view, photograph = one.views[0]
    painted = np.random.default_rng(1).integers(256, size=photograph.shape, dtype=np.uint8)
    pixel, _ = view.seen(one.scene.xyz)
    seen = np.isfinite(pixel[:, 0])
    assert one.scene.rgb is not None
    rgb = one.scene.rgb.copy()
    rgb[seen] = painted[pixel[seen, 1].astype(int), pixel[seen, 0].astype(int)]
    other = PictureMap(one.path, replace(one.scene, rgb=rgb), [])
    other.__dict__["views"] = [(view, painted)]
    module, points = PictureModule(Inversion(run.network), run.fit, [other], []), 0
    for seed in range(24):
        crop = module._crop(np.random.default_rng(seed))
        row, column = crop.marks.place // 64, crop.marks.place % 64
        assert bool((crop.inside[0, row, column] == 1).all())
        torch.testing.assert_close(crop.photograph[:, row, column].T, crop.marks.color)
        points += len(row)
    assert points > 30


def test_parts_of_a_batch_keep_their_pixels(rng):
    parts = [
        Marks(
            torch.arange(count),
            torch.rand(count, 3),
            torch.ones(count, dtype=torch.bool),
            torch.zeros(count, 128),
            torch.zeros(count, dtype=torch.bool),
            torch.ones(count),
            torch.ones(count),
        )
        for count in (3, 5)
    ]
    together = joined(parts, 100)
    assert together.place.tolist() == [0, 1, 2, 100, 101, 102, 103, 104]
    assert torch.equal(together.color, torch.cat([part.color for part in parts]))


def test_shares_and_absence_are_as_told(folder, tmp_path, rng):
    one = picture_maps([str(folder)], [1.0], 0, tmp_path, NO_PROGRESS)[0]
    sizes = [len(thinned(one.true, rng, 0.1).xyz) for _ in range(50)]
    assert min(sizes) >= 30 and max(sizes) <= 300 and len(set(sizes)) > 20
    assert partly(one.scene, rng, 0.0).names == ("rgb", "descriptor")
    assert partly(one.scene, rng, 1.0).names == ()


def test_what_is_outside_of_the_photograph_does_not_count():
    picture, photograph = torch.rand(1, 3, 32, 32), torch.rand(1, 3, 32, 32)
    inside = torch.zeros(1, 1, 32, 32)
    inside[..., :20] = 1
    loss, figures = picture_loss(picture, photograph, inside)
    other = picture.clone()
    other[..., 20:] = 0.5
    assert torch.equal(picture_loss(other, photograph, inside)[0], loss)
    expected = (picture - photograph)[..., :20].abs().mean()
    torch.testing.assert_close(figures["value"], expected)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("val_maps=[]", "got no val_maps; expected at least one COLMAP model"),
        ("recovered=2", "got recovered 2.0; expected a chance in"),
        ("fractions=[0]", "got fraction 0"),
        ("fractions=[]", "got no fractions"),
        ("crop=30", "got crop 30; expected a multiple of 4"),
        ("steps=0", "got steps 0; expected at least 1"),
    ],
)
def test_wrong_settings_are_refused(folder, override, said):
    with pytest.raises(InputError, match=said):
        settings(folder, override)


def test_a_map_without_photographs_is_refused(tmp_path, folder):
    import shutil

    bare = tmp_path / "bare"
    shutil.copytree(folder, bare, ignore=shutil.ignore_patterns("images"))
    one = picture_maps([str(bare)], [1.0], 0, tmp_path / "found", NO_PROGRESS)[0]
    with pytest.raises(InputError, match="has no photographs; expected a folder images or thumbs beside the model"):
        _ = one.views
