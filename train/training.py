"""The training run: train, calibrate on held-back clouds, and write one checkpoint."""

from __future__ import annotations

import json
import logging
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import lightning
import torch
import yaml
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback, EarlyStopping, ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import SIGTERMException

from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.checkpoint import Checkpoint
from l2p.attacks.learned.knowledge import LINES_ALONE, knowledges
from l2p.attacks.learned.learned import Learned
from l2p.attacks.learned.network import LineTransformer
from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.judging.provenance import machine, versions
from l2p.programs.commits import commit
from l2p.work.progress import terminal_progress
from train import infonce
from train.clouds import CloudSource, lifted, read
from train.infonce import Embeddings
from train.judging import Judged, calibrate, figures, rounds_of
from train.lightning_parts import AtomicCheckpoints, FigureTable, LossLines, chosen_logger
from train.module import NetworkModule
from train.sources import Sources, validation_sources
from train.start import start_from
from train.train_config import CHANGEABLE, Settings

log = logging.getLogger("train")
# Only rank 0 logs.
log.addFilter(lambda _: rank_zero_only.rank == 0)

#: Exit code after SIGTERM, by the convention of shells.
_TERMINATED = 128 + signal.SIGTERM
#: Patterns of Lightning's warnings that are suppressed: these conditions are intended.
_MEANT = (
    "Checkpoint directory .* exists and is not empty",
    "The '.*' does not have many workers",
    "`isinstance\\(treespec, LeafSpec\\)` is deprecated",
)

#: The exported model in the folder of the run.
MODEL = "model.safetensors"
#: The embeddings of the run, cross-fitted.
EMBEDDINGS = "embeddings.ckpt"


def train_all(settings: Settings, folder: Path, command: str, callbacks: Sequence[Callback] = ()) -> Path:
    """Start or continue the run in ``folder``; return the path of the exported checkpoint.

    Raises
    ------
    FileNotFoundError, InputError
        If a scene is missing, or the run in the folder was started with another config.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _check_config(settings, folder)
    _sweep(folder)
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    log.info("reading the scenes")
    sources, held_back = Sources.of(settings.data), validation_sources(settings.data)
    log.info("%d scenes, %d clouds held back", len(sources.scenes), len(held_back))
    embeddings = _embeddings(settings, folder / EMBEDDINGS, sources, held_back)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.fit.seed)
        network = LineTransformer(settings.network)
        if settings.start is not None:
            start_from(network, Path(settings.start))
        if embeddings is not None:
            network.embedding.load_state_dict(embeddings.whole.state_dict())
            network.embedding.requires_grad_(False)
        module = NetworkModule(network, settings.learned, settings.fit, sources, held_back, embeddings)
    last = folder / "last.ckpt"
    if last.exists():
        _check_state(last)
        log.info("going on from %s", last)
    with _quiet_lightning():
        try:
            trainer = _trainer(settings, folder, callbacks)
        except (MisconfigurationException, ValueError) as error:
            raise InputError(f"got {settings.trainer} for Lightning's trainer, which says: {error}") from error
        try:
            trainer.fit(module, ckpt_path=str(last) if last.exists() else None, weights_only=True)
        except SIGTERMException as stop:
            raise SystemExit(_TERMINATED) from stop  # Lightning would exit with 0
        except SystemExit as stop:
            if trainer.interrupted:  # Lightning turns Ctrl-C into exit code 1, and ignores the next
                signal.signal(signal.SIGINT, signal.default_int_handler)
                raise KeyboardInterrupt from stop
            raise
    model = folder / MODEL
    if trainer.is_global_zero:
        about = {
            "steps": trainer.global_step,
            "minutes": round(module.seconds / 60, 2),
            "processes": trainer.world_size,
        }
        _export(settings, model, command, module.average.cpu(), sources, embeddings, about)
    return model


@contextmanager
def _quiet_lightning() -> Iterator[None]:
    """Suppress advertisements, and warnings about intended conditions: no workers, an existing folder."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.WARNING)
    with warnings.catch_warnings():
        for message in _MEANT:
            warnings.filterwarnings("ignore", message=message)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
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
        logger=[FigureTable(place), *chosen_logger(settings.logger, place)],
        plugins=[AtomicCheckpoints()],
        callbacks=[*stopping, *callbacks, saving, *([] if sys.stderr.isatty() else [LossLines()])],
        enable_progress_bar=sys.stderr.isatty(),
        enable_model_summary=False,
        default_root_dir=place,
    )


def _export(
    settings: Settings,
    model: Path,
    command: str,
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
    facts = {
        "command": command,
        "commit": commit(),
        "machine": machine(),
        "versions": {**versions(), "lightning": lightning.__version__},
        "seed": settings.fit.seed,
        "scenes": sorted({_listed(scene.source) for scene in sources.scenes}),
        **about,
        "results": results,
        "config": settings.resolved,
    }
    checkpoint.save(model, Checkpoint(network, settings.learned, calibration, facts), overwrite=True)
    with atomic_file(model.with_name("results.json"), overwrite=True) as file:
        file.write(json.dumps(facts, indent=2, ensure_ascii=False).encode())
    log.info("%s: %d parameters", model, sum(parameter.numel() for parameter in network.parameters()))


def _listed(source: str) -> str:
    """Name of a scene in the record, with its part and folder: scenes and maps of one place share their name."""
    return source if source.startswith("sim:") else "/".join(Path(source).parts[-3:])


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


def _sweep(folder: Path) -> None:
    """Remove unfinished files of a killed run."""
    if rank_zero_only.rank == 0:
        for left in folder.glob(".l2p-*.tmp"):
            left.unlink(missing_ok=True)


def _check_state(last: Path) -> None:
    try:
        torch.load(last, map_location="cpu", weights_only=True)
    except Exception as error:  # torch and zipfile raise many types on damaged bytes
        raise InputError(f"{last} is damaged; remove it to begin the run again") from error


def _check_config(settings: Settings, folder: Path) -> None:
    """Check that a continued run has the config of its start, except for ``CHANGEABLE``."""
    file = folder / "config.yaml"
    if file.exists():
        try:
            started = yaml.safe_load(file.read_bytes())
        except yaml.YAMLError:
            started = None
        if not isinstance(started, dict):
            raise InputError(f"{file} is no config of a run; give name=ANOTHER, or remove the folder")
        other = [
            key
            for key in {**started, **settings.resolved}
            if key not in CHANGEABLE and started.get(key) != settings.resolved.get(key)
        ]
        if other:
            raise InputError(
                f"{folder} was started with another {', '.join(other)}; give name=ANOTHER, or remove the folder"
            )
    if rank_zero_only.rank == 0:
        with atomic_file(file, overwrite=True) as out:
            out.write(yaml.safe_dump(settings.resolved, sort_keys=False, allow_unicode=True).encode())
