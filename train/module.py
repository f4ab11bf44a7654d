"""Training of one round's network: optimiser, schedule, moving average of the weights, figures."""

from __future__ import annotations

import copy
import time
from typing import Any

import lightning
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor, nn

from l2p.features import STATE
from l2p.network import LineTransformer
from l2p.peak import PeakConfig
from train.config import FitSettings
from train.losses import Losses, Sample, losses

#: Share of the learning rate that is left at the end.
_LAST_RATE = 0.02
#: The moving average forgets faster in the first steps: 1 - 1 / (1 + steps / this).
_FORGET = 10.0


class RoundModule(lightning.LightningModule):
    """``network`` is trained, ``average`` follows it and is what is validated and shipped.

    ``probe`` reads the error from the states, so that they carry something to the next round; it stays here.
    """

    def __init__(self, network: LineTransformer, fit: FitSettings, peak: PeakConfig) -> None:
        super().__init__()
        self.network = network
        self.average = copy.deepcopy(network).requires_grad_(False)
        self.probe = nn.Linear(STATE, 1)
        self.fit = fit
        self.peak = peak
        self._seconds_before, self._began = 0.0, time.monotonic()

    @property
    def seconds(self) -> float:
        """Time spent in this round's training, over all starts."""
        return self._seconds_before + time.monotonic() - self._began

    @property
    def done(self) -> float:
        """Share of the steps, or of the minutes if there are fewer of them, that is done."""
        share = self.global_step / self.fit.steps
        return share if self.fit.minutes is None else max(share, self.seconds / 60 / self.fit.minutes)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """AdamW on everything but the average."""
        weights = [*self.network.parameters(), *self.probe.parameters()]
        return torch.optim.AdamW(weights, lr=self.fit.learning_rate, weight_decay=self.fit.weight_decay)

    def on_train_start(self) -> None:
        """Preparation is not training."""
        self._began = time.monotonic()

    def on_train_batch_start(self, batch: Sample, batch_idx: int) -> None:
        """Warm up, then fall in a line to almost nothing; the schedule follows steps or minutes."""
        warm = min(1.0, (self.global_step + 1) / max(self.fit.warmup, 1))
        rate = self.fit.learning_rate * warm * max(_LAST_RATE, 1 - self.done)
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        for group in optimizer.param_groups:
            group["lr"] = rate
        self.log("train/rate", rate, batch_size=1)

    def training_step(self, batch: Sample, batch_idx: int) -> Tensor:
        """The loss of one sample."""
        found = self._losses(self.network, batch)
        self._log_figures("train", found)
        return found.total

    def optimizer_step(self, *arguments: Any, **named: Any) -> None:
        """Step, then let the average follow: before any callback saves both."""
        super().optimizer_step(*arguments, **named)
        step = self.global_step
        keep = min(self.fit.averaging, 1 - 1 / (1 + step / _FORGET))
        with torch.no_grad():
            for slow, fast in zip(self.average.parameters(), self.network.parameters(), strict=True):
                slow.lerp_(fast, 1 - keep)

    def on_train_batch_end(self, outputs: Any, batch: Sample, batch_idx: int) -> None:
        """Stop when the time is over."""
        if self.done >= 1:
            self.trainer.should_stop = True

    def validation_step(self, batch: Sample, batch_idx: int) -> None:
        """Figures of the averaged network on a held-back cloud; each cloud counts the same."""
        self._log_figures("val", self._losses(self.average, batch))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the clock."""
        checkpoint["seconds"] = self.seconds

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on with the clock."""
        self._seconds_before = checkpoint["seconds"]

    def _losses(self, network: LineTransformer, batch: Sample) -> Losses:
        judgement = network(batch.edges)
        probe = self.probe(judgement.state).squeeze(1)
        return losses(batch, judgement, network.log_spread, probe, self.peak)

    def _log_figures(self, stage: str, found: Losses) -> None:
        figures = {name: value for name, value in found._asdict().items() if name != "error"}
        figures |= {"median": found.error.median(), "within": (found.error <= 1).float().mean()}
        figures["score"] = found.affinity + found.position
        figures = {f"{stage}/{name}": value for name, value in figures.items()}
        # Validation: the mean over all clouds, on all ranks the same, since early stopping looks at it.
        self.log_dict(figures, batch_size=1, prog_bar=False, sync_dist=stage == "val")
