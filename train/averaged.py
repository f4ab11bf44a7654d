"""What every training shares: AdamW, the schedule of its rate, the moving average of the weights, the clock."""

from __future__ import annotations

import copy
import itertools
import time
from collections.abc import Iterable
from typing import Any

import lightning
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor, nn

from train.train_config import ScheduleSettings

#: Final learning rate, as a fraction of the largest.
_LAST_RATE = 0.02
#: Steps in the decay of the moving average, 1 - 1 / (1 + steps / this), which is smaller at first.
_FORGET = 10.0


class AveragedModule(lightning.LightningModule):
    """Module of the trained ``network`` and its moving ``average``, which is validated and exported."""

    network: nn.Module
    average: nn.Module

    def __init__(self, network: nn.Module, schedule: ScheduleSettings) -> None:
        super().__init__()
        self.network, self.schedule = network, schedule
        self.average = copy.deepcopy(network).requires_grad_(False)
        self._seconds_before, self._began = 0.0, time.monotonic()
        self.done = 0.0

    @property
    def seconds(self) -> float:
        """Seconds of training, over all starts."""
        return self._seconds_before + time.monotonic() - self._began

    def trained(self) -> list[nn.Parameter]:
        """Return the weights that are trained."""
        return [weight for weight in self.network.parameters() if weight.requires_grad]

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return AdamW."""
        schedule = self.schedule
        return torch.optim.AdamW(self.trained(), lr=schedule.learning_rate, weight_decay=schedule.weight_decay)

    def train_dataloader(self) -> Iterable[int]:
        """Return an endless count: the module makes the batches, and the trainer stops."""
        return itertools.count()

    def on_train_start(self) -> None:
        """Start the clock."""
        self._began = time.monotonic()

    def on_train_batch_start(self, batch: int, batch_idx: int) -> None:
        """Set the learning rate: warm-up, then linear decay to almost 0, by steps or minutes."""
        share = self.global_step / self.schedule.steps
        if self.schedule.minutes is not None:
            share = max(share, self.seconds / 60 / self.schedule.minutes)
        # All ranks must stop at the same step.
        self.done = share if self.trainer.world_size == 1 else self.trainer.strategy.broadcast(share)
        warm = min(1.0, (self.global_step + 1) / max(self.schedule.warmup, 1))
        rate = self.schedule.learning_rate * warm * max(_LAST_RATE, 1 - self.done)
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        for group in optimizer.param_groups:
            group["lr"] = rate
        self.log("train/rate", rate, batch_size=1)

    def optimizer_step(self, *arguments: Any, **named: Any) -> None:
        """Step, then update the average, before any callback saves both."""
        super().optimizer_step(*arguments, **named)
        step = self.global_step
        keep = min(self.schedule.averaging, 1 - 1 / (1 + step / _FORGET))
        with torch.no_grad():
            for slow, fast in zip(self.average.parameters(), self.network.parameters(), strict=True):
                slow.lerp_(fast, 1 - keep)

    def on_train_batch_end(self, outputs: Any, batch: int, batch_idx: int) -> None:
        """Stop when the steps or minutes are used up."""
        if self.done >= 1:
            self.trainer.should_stop = True

    def log_sums(self, names: tuple[str, ...], figures: Tensor) -> None:
        """Log contributions to means, summed: ranks may have judged different numbers of clouds."""
        named: dict[str, Tensor] = dict(zip(names, figures, strict=True))
        self.log_dict(named, batch_size=1, sync_dist=True, reduce_fx="sum")

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save the clock."""
        checkpoint["seconds"] = self.seconds

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the clock."""
        self._seconds_before = checkpoint["seconds"]
