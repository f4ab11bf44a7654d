"""What every run of a training shares: its folder, Lightning's trainer, and how it is continued."""

from __future__ import annotations

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
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback, EarlyStopping, ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import SIGTERMException

from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.judging.provenance import machine, versions
from l2p.programs.commits import commit
from train.averaged import AveragedModule
from train.lightning_parts import AtomicCheckpoints, FigureTable, LossLines, chosen_logger
from train.train_config import CHANGEABLE, ScheduleSettings

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

#: The exported model in the folder of a run.
MODEL = "model.safetensors"


def begin(folder: Path, resolved: dict[str, Any], threads: int | None) -> None:
    """Make the folder of a run, or check that it was started with the same config; remove unfinished files.

    Raises
    ------
    InputError
        If the run in the folder was started with another config.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _check_config(resolved, folder)
    _sweep(folder)
    if threads is not None:
        torch.set_num_threads(threads)


def fit(
    module: AveragedModule,
    resolved: dict[str, Any],
    folder: Path,
    callbacks: Sequence[Callback] = (),
) -> lightning.Trainer:
    """Train the module, from the last state in the folder if there is one; return the trainer.

    The keys ``trainer`` and ``logger`` of the resolved config are Lightning's.

    Raises
    ------
    InputError
        If the state is damaged, or the trainer does not take its settings.
    """
    last = folder / "last.ckpt"
    if last.exists():
        _check_state(last)
        log.info("going on from %s", last)
    with _quiet_lightning():
        try:
            trainer = _trainer(module.schedule, resolved, folder, callbacks)
        except (MisconfigurationException, ValueError) as error:
            raise InputError(f"got {resolved['trainer']} for Lightning's trainer, which says: {error}") from error
        try:
            trainer.fit(module, ckpt_path=str(last) if last.exists() else None, weights_only=True)
        except SIGTERMException as stop:
            raise SystemExit(_TERMINATED) from stop  # Lightning would exit with 0
        except SystemExit as stop:
            if trainer.interrupted:  # Lightning turns Ctrl-C into exit code 1, and ignores the next
                signal.signal(signal.SIGINT, signal.default_int_handler)
                raise KeyboardInterrupt from stop
            raise
    return trainer


def record(
    command: str, module: AveragedModule, trainer: lightning.Trainer, resolved: dict[str, Any]
) -> dict[str, Any]:
    """Return the facts of a finished run that any model has."""
    return {
        "command": command,
        "commit": commit(),
        "machine": machine(),
        "versions": {**versions(), "lightning": lightning.__version__},
        "seed": module.schedule.seed,
        "steps": trainer.global_step,
        "minutes": round(module.seconds / 60, 2),
        "processes": trainer.world_size,
        "config": resolved,
    }


def listed(source: str) -> str:
    """Name of a scene in the record, with its part and folder: scenes and maps of one place share their name."""
    return source if source.startswith("sim:") else "/".join(Path(source).parts[-3:])


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


def _trainer(
    schedule: ScheduleSettings, resolved: dict[str, Any], place: Path, callbacks: Sequence[Callback]
) -> lightning.Trainer:
    saving = ModelCheckpoint(
        dirpath=place, filename="last", every_n_train_steps=schedule.save_every, enable_version_counter=False
    )
    stopping = [] if schedule.patience is None else [EarlyStopping("val/score", patience=schedule.patience)]
    return lightning.Trainer(
        **resolved["trainer"],
        max_steps=schedule.steps,
        max_epochs=-1,
        val_check_interval=min(schedule.validate_every, schedule.steps),
        check_val_every_n_epoch=None,
        num_sanity_val_steps=0,
        gradient_clip_val=1.0,
        use_distributed_sampler=False,
        log_every_n_steps=min(50, schedule.save_every),
        logger=[FigureTable(place), *chosen_logger(resolved["logger"], place)],
        plugins=[AtomicCheckpoints()],
        callbacks=[*stopping, *callbacks, saving, *([] if sys.stderr.isatty() else [LossLines()])],
        enable_progress_bar=sys.stderr.isatty(),
        enable_model_summary=False,
        default_root_dir=place,
    )


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


def _check_config(resolved: dict[str, Any], folder: Path) -> None:
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
            key for key in {**started, **resolved} if key not in CHANGEABLE and started.get(key) != resolved.get(key)
        ]
        if other:
            raise InputError(
                f"{folder} was started with another {', '.join(other)}; give name=ANOTHER, or remove the folder"
            )
    if rank_zero_only.rank == 0:
        with atomic_file(file, overwrite=True) as out:
            out.write(yaml.safe_dump(resolved, sort_keys=False, allow_unicode=True).encode())
