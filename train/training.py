"""The training run: train, calibrate on held-back clouds, and write one checkpoint."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from lightning.pytorch.callbacks import Callback

from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.checkpoint import Checkpoint
from l2p.attacks.learned.knowledge import LINES_ALONE, knowledges
from l2p.attacks.learned.learned import Learned
from l2p.attacks.learned.network import LineTransformer
from l2p.io.atomic import atomic_file
from l2p.work.progress import terminal_progress
from train import infonce
from train.clouds import CloudSource, lifted, read
from train.infonce import Embeddings
from train.judging import Judged, calibrate, figures, rounds_of
from train.module import NetworkModule
from train.running import MODEL, begin, fit, listed, log, record
from train.sources import Sources, validation_sources
from train.start import start_from
from train.train_config import Settings

#: The embeddings of the run, cross-fitted.
EMBEDDINGS = "embeddings.ckpt"


def train_all(settings: Settings, folder: Path, command: str, callbacks: Sequence[Callback] = ()) -> Path:
    """Start or continue the run in ``folder``; return the path of the exported checkpoint.

    Raises
    ------
    FileNotFoundError, InputError
        If a scene is missing, or the run in the folder was started with another config.
    """
    begin(folder, settings.resolved, settings.threads)
    log.info("reading the scenes")
    sources, held_back = Sources.of(settings.data), validation_sources(settings.data)
    log.info("%d scenes, %d clouds held back", len(sources.scenes), len(held_back))
    embeddings = _embeddings(settings, folder / EMBEDDINGS, sources, held_back)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.fit.seed)
        network = LineTransformer(settings.network)
        before = [] if settings.start is None else start_from(network, Path(settings.start))
        if embeddings is not None:
            network.embedding.load_state_dict(embeddings.whole.state_dict())
            network.embedding.requires_grad_(False)
        module = NetworkModule(network, settings.learned, settings.fit, sources, held_back, embeddings)
    trainer = fit(module, settings.resolved, folder, callbacks)
    model = folder / MODEL
    if trainer.is_global_zero:
        about = {**record(command, module, trainer, settings.resolved), "before": before}
        _export(settings, model, module.average.cpu(), sources, embeddings, about)
    return model


def _export(
    settings: Settings,
    model: Path,
    network: LineTransformer,
    sources: Sources,
    embeddings: Embeddings | None,
    about: dict[str, Any],
) -> None:
    """Calibrate and judge the network on the held-back clouds; write the checkpoint, and its facts as JSON."""
    held_back = validation_sources(settings.data)
    attack = Learned(network, settings.learned)
    judged: list[list[Judged]] = []
    names: list[str] = []
    with terminal_progress().task("held-back clouds", total=len(held_back)) as advance:
        for source in held_back:
            cloud = lifted(source, attack, embeddings)
            judged.append(rounds_of(cloud, attack))
            names.append(attack.knowledge(cloud.elements))
            advance(1)
    calibration = {}
    for known in knowledges(network.config):
        # A run without such maps has nothing to calibrate it on; that of lines alone is closest.
        name = known if known in names else LINES_ALONE
        own = [part for part, of in zip(judged, names, strict=True) if of == name]
        rounds = cast("list[Sequence[Judged]]", list(zip(*own, strict=True)))
        calibration[known] = [calibrate(part, network.config.radii) for part in rounds]
    results = [
        figures(source, name, part, calibration[name][-1], network.config.one)
        for source, part, name in zip(held_back, judged, names, strict=True)
    ]
    for row in results:
        log.info("%(scene)s at %(fraction)g with %(known)s: median %(median)s, within %(within)s", row)
    facts = {**about, "scenes": sorted({listed(scene.source) for scene in sources.scenes}), "results": results}
    checkpoint.save(model, Checkpoint(network, settings.learned, calibration, facts), overwrite=True)
    with atomic_file(model.with_name("results.json"), overwrite=True) as file:
        file.write(json.dumps(facts, indent=2, ensure_ascii=False).encode())
    log.info("%s: %d parameters", model, sum(parameter.numel() for parameter in network.parameters()))


def _embeddings(
    settings: Settings, file: Path, sources: Sources, held_back: Sequence[CloudSource]
) -> Embeddings | None:
    """Load the embeddings of the run, or train them on its scenes, also those held back: their likeness is
    cross-fitted. None if the network does not use any."""
    if not settings.network.appearance:
        return None
    if not file.exists():
        scenes = {one.source: read(one.source) for one in sources.scenes if one.names}
        scenes |= {one.scene: read(one.scene) for one in held_back if one.known}
        seed, progress = settings.fit.seed, terminal_progress()
        found = infonce.fitted(scenes, settings.network, settings.embedding, seed, progress)
        infonce.save(found, file)
    return infonce.load(file, settings.network)
