"""The training run of the inversion network: train, judge it on held-back views, and write its weights."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import Callback

from l2p.images.filling import FILL_NAME, gaussian_fill
from l2p.images.inversion import Inversion
from l2p.images.inversion_file import halved, save_inversion
from l2p.images.picture import draw
from l2p.images.similarity import likeness
from l2p.io.atomic import atomic_file
from l2p.work.progress import terminal_progress
from train.picture_clouds import picture_maps
from train.picture_config import PictureRun
from train.picture_module import Held, PictureModule, held_views
from train.running import MODEL, begin, fit, listed, log, record


def train_pictures(run: PictureRun, folder: Path, command: str, callbacks: Sequence[Callback] = ()) -> Path:
    """Start or continue the run in ``folder``; return the path of the weights.

    Raises
    ------
    FileNotFoundError, InputError
        If a map, its descriptors or photographs are missing, or the run was started with another config.
    """
    begin(folder, run.resolved, run.threads)
    settings, progress = run.fit, terminal_progress()
    places = folder / "recovered"
    maps = picture_maps(settings.maps, settings.fractions, settings.seed, places, progress)
    held = held_views(
        picture_maps(settings.val_maps, settings.fractions[:1], settings.seed, places, progress), settings.val_views
    )
    log.info("%d maps, %d views, %d held back", len(maps), sum(len(each.views) for each in maps), len(held))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        module = PictureModule(Inversion(run.network), settings, maps, held)
    trainer = fit(module, run.resolved, folder, callbacks)
    model = folder / MODEL
    if trainer.is_global_zero:
        network = halved(module.average.cpu().eval())
        scenes = sorted(listed(path) for path in settings.maps)
        facts = {**record(command, module, trainer, run.resolved), "scenes": scenes, "results": results(network, held)}
        save_inversion(model, network, facts, overwrite=True)
        with atomic_file(folder / "results.json", overwrite=True) as file:
            file.write(json.dumps(facts, indent=2, ensure_ascii=False).encode())
        log.info("%s: %d parameters", model, sum(weight.numel() for weight in network.parameters()))
    return model


def results(network: Inversion, held: Sequence[Held]) -> list[dict[str, Any]]:
    """Judge the pictures of held-back views, and the filling between their points."""
    rows = []
    with terminal_progress().task("held-back views", total=len(held)) as advance:
        for each in held:
            made = {"network": draw(network, each.points, each.view), FILL_NAME: gaussian_fill(each.points, each.view)}
            row: dict[str, Any] = {"map": each.map, "view": each.view.name, "points": each.known}
            for name, picture in made.items():
                row[name] = likeness(picture, each.photograph)._asdict()
            rows.append(row)
            advance(1)
    return rows
