"""Parts for Lightning: atomic checkpoints, an append-only table of figures, other loggers, and lines with the loss."""

from __future__ import annotations

import csv
import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers.logger import Logger

from l2p.errors import InputError
from l2p.io.atomic import atomic_file

log = logging.getLogger("train")

#: Value of a key of a logger that stands for the folder of the run.
FOLDER = "FOLDER"


class AtomicCheckpoints(TorchCheckpointIO):
    """Checkpoints replaced by renaming: a kill leaves the old or the new one."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        """Write a checkpoint to ``path``."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path, overwrite=True) as file:
            torch.save(checkpoint, file)


class FigureTable(Logger):
    """``figures.csv`` with columns step, figure, value.

    A resumed run appends to it; if a step is repeated after a kill, its last rows count.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.file = folder / "figures.csv"

    @property
    def name(self) -> str:
        """Empty: the folder identifies the run."""
        return ""

    @property
    def version(self) -> str:
        """Empty: the folder identifies the run."""
        return ""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Add a row for each figure."""
        self.file.parent.mkdir(parents=True, exist_ok=True)
        _without_torn_row(self.file)
        # A kill may leave an empty file.
        fresh = not self.file.exists() or not self.file.stat().st_size
        with self.file.open("a", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            if fresh:
                writer.writerow(["step", "figure", "value"])
            writer.writerows([step, name, f"{value:.6g}"] for name, value in metrics.items() if name != "epoch")

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Do nothing: hyperparameters are in config.yaml."""


class LossLines(Callback):
    """A line in the log with step and loss: soon, then every minute; for where there is no bar."""

    def __init__(self, every: float = 60.0) -> None:
        self.every = every
        self._next = self._began = 0.0

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Start the clock."""
        self._next = self._began = time.monotonic()

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log the loss of this step, if it is time."""
        now = time.monotonic()
        if now < self._next or not trainer.is_global_zero:
            return
        # After the first step, the double time each, up to a minute.
        self._next = now + min(max(now - self._began, 1.0), self.every)
        loss = float(outputs["loss"] if isinstance(outputs, Mapping) else outputs)
        log.info("step %d of at most %d: loss %.4f", trainer.global_step, trainer.max_steps, loss)


def chosen_logger(config: Mapping[str, Any], folder: Path) -> list[Logger]:
    """Make the logger of ``configs/train/logger/``, besides ``figures.csv``; none without ``_target_``.

    Raises
    ------
    InputError
        If its package is not installed, or it cannot be made so.
    """
    if not config.get("_target_"):
        return []
    given = {key: str(folder) if value == FOLDER else value for key, value in config.items()}
    try:
        return [instantiate(given)]
    except (InstantiationException, ModuleNotFoundError, TypeError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(
            f"got logger {config['_target_']}, which says: {reason}; install its package, or give logger=none"
        ) from error


def _without_torn_row(file: Path) -> None:
    """Remove a last row cut by a kill; the next row would be appended to it."""
    if not file.exists():
        return
    with file.open("r+b") as table:
        content = table.read()
        if content and not content.endswith(b"\n"):
            table.truncate(content.rfind(b"\n") + 1)
