"""Plugins for Lightning: atomic checkpoints, and an append-only table of figures."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.loggers.logger import Logger

from l2p.io.atomic import atomic_file


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


def _without_torn_row(file: Path) -> None:
    """Remove a last row cut by a kill; the next row would be appended to it."""
    if not file.exists():
        return
    with file.open("r+b") as table:
        content = table.read()
        if content and not content.endswith(b"\n"):
            table.truncate(content.rfind(b"\n") + 1)
