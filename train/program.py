"""The run: one round after the other, each on what the rounds before really find; then one checkpoint."""

from __future__ import annotations

import json
import logging
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning
import torch
import yaml
from lightning.pytorch.callbacks import Callback, EarlyStopping, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import SIGTERMException

from eval.provenance import commit, machine, versions
from l2p import checkpoint
from l2p.checkpoint import Checkpoint
from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.network import LineTransformer
from train.batches import Batches
from train.clouds import CloudSource
from train.config import CHANGEABLE, Settings
from train.judging import calibrate, figures
from train.lightning_parts import AtomicCheckpoints, FigureTable
from train.module import RoundModule
from train.sources import training_sources, validation_sources
from train.states import State, StateStore

log = logging.getLogger("train")

#: Exit code of a process that was told to end, as shells have it.
_TERMINATED = 128 + signal.SIGTERM
#: Beginnings of Lightning's warnings about what is so on purpose.
_MEANT = (
    "Checkpoint directory .* exists and is not empty",
    "The '.*' does not have many workers",
    "`isinstance\\(treespec, LeafSpec\\)` is deprecated",
)

#: The exported model in the folder of the run.
MODEL = "model.safetensors"


def train_all(settings: Settings, folder: Path, command: str, callbacks: Sequence[Callback] = ()) -> Path:
    """Run, or finish, the run in ``folder``; gives the exported checkpoint.

    Raises
    ------
    FileNotFoundError, InputError
        If a scene is not there, or the run in the folder was started with another config.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _check_config(settings, folder)
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    training, held_back = training_sources(settings.data), validation_sources(settings.data)
    store = StateStore(settings.data.cache, settings.round)
    done = _finished_rounds(folder)
    log.info("%d + %d clouds, %d of %d rounds done", len(training), len(held_back), len(done), settings.rounds)
    for number in range(len(done), settings.rounds):
        networks = [part.networks[0] for part in done]
        before = store.states(training, networks, "clouds to train on")
        judged = store.states(held_back, networks, "clouds held back")
        network, about = _train_round(
            settings, folder, number, Batches(before, judged, settings.fit, number), callbacks
        )
        del before, judged
        after = store.states(held_back, [*networks, network], "clouds held back")
        done.append(_finish_round(folder, number, network, settings, held_back, after, about))
    return _export(settings, folder, command, done[: settings.rounds], training)


def _train_round(
    settings: Settings, folder: Path, number: int, batches: Batches, callbacks: Sequence[Callback]
) -> tuple[LineTransformer, dict[str, Any]]:
    """Train one network, from its last state on disk if there is one."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.fit.seed * 1000 + number)
        module = RoundModule(LineTransformer(settings.network), settings.fit, settings.round.peak)
    place = folder / f"round{number}"
    last = place / "last.ckpt"
    if last.exists():
        log.info("round %d goes on from %s", number, last)
    with _quiet_lightning():
        trainer = _trainer(settings, place, callbacks)
        try:
            trainer.fit(module, batches, ckpt_path=str(last) if last.exists() else None, weights_only=True)
        except SIGTERMException as stop:
            raise SystemExit(_TERMINATED) from stop  # Lightning would have it a success
    about = {"steps": trainer.global_step, "minutes": round(module.seconds / 60, 2)}
    return module.average.cpu().eval(), about


@contextmanager
def _quiet_lightning() -> Iterator[None]:
    """Without advertisements, and without warnings about what is meant: no workers, a folder that is continued."""
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    logger.setLevel(logging.WARNING)
    with warnings.catch_warnings():
        for message in _MEANT:
            warnings.filterwarnings("ignore", message=message)
        try:
            yield
        finally:
            logger.setLevel(level)


def _trainer(settings: Settings, place: Path, callbacks: Sequence[Callback]) -> lightning.Trainer:
    fit = settings.fit
    saving = ModelCheckpoint(
        dirpath=place, filename="last", every_n_train_steps=fit.save_every, enable_version_counter=False
    )
    stopping = [] if fit.patience is None else [EarlyStopping("val/score", patience=fit.patience)]
    return lightning.Trainer(
        **settings.trainer,
        max_steps=fit.steps,
        max_epochs=-1,
        val_check_interval=min(fit.validate_every, fit.steps),
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        gradient_clip_val=1.0,
        use_distributed_sampler=False,
        log_every_n_steps=min(50, fit.save_every),
        logger=[FigureTable(place), TensorBoardLogger(place, name="", version="")],
        plugins=[AtomicCheckpoints()],
        callbacks=[*stopping, *callbacks, saving],
        enable_progress_bar=sys.stderr.isatty(),
        enable_model_summary=False,
        default_root_dir=place,
    )


def _finish_round(
    folder: Path,
    number: int,
    network: LineTransformer,
    settings: Settings,
    sources: Sequence[CloudSource],
    after: Sequence[State],
    about: dict[str, Any],
) -> Checkpoint:
    """Calibrate, judge and keep a round; the file says that it is done."""
    calibration = calibrate(after)
    results = [figures(source, state, calibration) for source, state in zip(sources, after, strict=True)]
    for row in results:
        log.info(
            "round %d %s at %g: median %.3f, within %.3f",
            number,
            row["scene"],
            row["fraction"],
            row["median"],
            row["within"],
        )
    part = Checkpoint([network], settings.round, [calibration], {**about, "results": results})
    checkpoint.save(_round_file(folder, number), part, overwrite=True)
    return part


def _finished_rounds(folder: Path) -> list[Checkpoint]:
    done: list[Checkpoint] = []
    while _round_file(folder, len(done)).exists():
        done.append(checkpoint.read(_round_file(folder, len(done))))
    return done


def _round_file(folder: Path, number: int) -> Path:
    return folder / f"round{number}.safetensors"


def _export(
    settings: Settings, folder: Path, command: str, done: Sequence[Checkpoint], sources: Sequence[CloudSource]
) -> Path:
    """One checkpoint of all rounds, and the facts about it as JSON."""
    facts = {
        "command": command,
        "commit": commit(),
        "machine": machine(),
        "versions": {**versions(), "lightning": lightning.__version__},
        "seed": settings.fit.seed,
        "scenes": sorted({Path(source.scene).name for source in sources}),
        "clouds": len(sources),
        "rounds": [part.facts for part in done],
        "config": settings.resolved,
    }
    networks = [part.networks[0] for part in done]
    model = folder / MODEL
    checkpoint.save(
        model, Checkpoint(networks, settings.round, [part.calibration[0] for part in done], facts), overwrite=True
    )
    with atomic_file(folder / "results.json", overwrite=True) as file:
        file.write(json.dumps(facts, indent=2, ensure_ascii=False).encode())
    log.info("%s: %d parameters", model, sum(p.numel() for network in networks for p in network.parameters()))
    return model


def _check_config(settings: Settings, folder: Path) -> None:
    """A run goes on with the config that it was started with, but for ``CHANGEABLE``."""
    file = folder / "config.yaml"
    if file.exists():
        started = yaml.safe_load(file.read_text(encoding="utf-8"))
        other = [
            key
            for key in {**started, **settings.resolved}
            if key not in CHANGEABLE and started.get(key) != settings.resolved.get(key)
        ]
        if other:
            raise InputError(
                f"{folder} was started with another {', '.join(other)}; give name=ANOTHER, or remove the folder"
            )
    with atomic_file(file, overwrite=True) as out:
        out.write(yaml.safe_dump(settings.resolved, sort_keys=False, allow_unicode=True).encode())
