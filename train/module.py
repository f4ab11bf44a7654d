"""Training of the network: optimiser, schedule, moving average of the weights, the pool of clouds, figures."""

from __future__ import annotations

import copy
import itertools
import logging
import math
import signal
import time
from collections.abc import Iterable, Sequence
from typing import Any

import lightning
import torch
import torch.distributed
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor, nn
from torch.utils.data import DataLoader

from l2p.attacks.learned.learned import Learned
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import Judgement, LineTransformer
from train.clouds import CloudSource, lifted
from train.infonce import Embeddings
from train.judging import rounds_of
from train.losses import losses
from train.pool import Pool
from train.sources import Sources
from train.train_config import FitSettings

log = logging.getLogger("train")

#: Final learning rate, as a fraction of the largest.
_LAST_RATE = 0.02
#: Steps in the decay of the moving average, 1 - 1 / (1 + steps / this), which is smaller at first.
_FORGET = 10.0
#: Names of the validation figures.
_FIGURES = ("val/score", "val/median", "val/within")


class NetworkModule(lightning.LightningModule):
    """Module of the trained ``network`` and its moving ``average``, which is validated and exported.

    ``probe`` predicts the error from the states, so that they carry information to the next round; it is not exported.
    """

    def __init__(
        self,
        network: LineTransformer,
        config: LearnedConfig,
        fit: FitSettings,
        sources: Sources,
        held_back: Sequence[CloudSource],
        embeddings: Embeddings | None = None,
    ) -> None:
        super().__init__()
        self.embeddings = embeddings
        self.network = network
        self.average = copy.deepcopy(network).requires_grad_(False)
        self.probe = nn.Linear(network.config.state, 1)
        # The attack uses the average, in evaluation mode; the pool does not use its weights.
        self.attack, self.fit = Learned(self.average, config), fit
        self.sources, self.held_back = sources, held_back
        self.pool: Pool | None = None
        self._pools_before: list[dict[str, Any]] = []
        self._seconds_before, self._began = 0.0, time.monotonic()
        self.done = 0.0

    @property
    def seconds(self) -> float:
        """Seconds of training, over all starts."""
        return self._seconds_before + time.monotonic() - self._began

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return AdamW on all weights but the average."""
        weights = [weight for weight in self.network.parameters() if weight.requires_grad]
        weights += self.probe.parameters()
        return torch.optim.AdamW(weights, lr=self.fit.learning_rate, weight_decay=self.fit.weight_decay)

    def train_dataloader(self) -> Iterable[int]:
        """Return an endless count: the pool makes the batches, and the trainer stops."""
        return itertools.count()

    def val_dataloader(self) -> DataLoader[int]:
        """Return the numbers of the held-back clouds of this rank, padded beyond the last cloud so that all ranks have
        equally many."""
        ranks = self.trainer.world_size
        most = math.ceil(len(self.held_back) / ranks) * ranks
        return DataLoader(range(self.global_rank, most, ranks), batch_size=None)  # type: ignore[arg-type]

    def on_train_start(self) -> None:
        """Make the pool, or restore that of the continued run."""
        if self.trainer.world_size > 1:
            # Lightning's SIGTERM handler issues a collective and deadlocks.
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        self._began = time.monotonic()
        log.info("lifting the first %d line clouds", self.fit.clouds)
        rank, ranks = self.global_rank, self.trainer.world_size
        self.pool = Pool(self.sources, self.attack, self.fit.clouds, self.fit.seed, rank, ranks, self.embeddings)
        if rank < len(self._pools_before):
            self.pool.load_state_dict(self._pools_before[rank])

    def on_train_batch_start(self, batch: int, batch_idx: int) -> None:
        """Set the learning rate: warm-up, then linear decay to almost 0, by steps or minutes."""
        share = self.global_step / self.fit.steps
        if self.fit.minutes is not None:
            share = max(share, self.seconds / 60 / self.fit.minutes)
        # All ranks must stop at the same step.
        self.done = share if self.trainer.world_size == 1 else self.trainer.strategy.broadcast(share)
        warm = min(1.0, (self.global_step + 1) / max(self.fit.warmup, 1))
        rate = self.fit.learning_rate * warm * max(_LAST_RATE, 1 - self.done)
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        for group in optimizer.param_groups:
            group["lr"] = rate
        self.log("train/rate", rate, batch_size=1)

    def training_step(self, batch: int, batch_idx: int) -> Tensor:
        """Compute the loss of the next lines of the pool's clouds, and save the network's outputs in the pool."""
        assert self.pool is not None
        sample, rows = self.pool.draw(max(1, self.fit.lines_per_batch // self.fit.clouds))
        # The pool is on the CPU, which prepares the batches.
        sample = sample.to(self.device)
        judgement = self.network(sample.edges)
        probe = self.probe(judgement.state).squeeze(1)
        found = losses(sample, judgement, probe, self.attack.config, self.network.config.radii)
        self.pool.keep(rows, found.moved.cpu(), Judgement(*(part.cpu() for part in judgement)))
        figures = {name: value for name, value in found._asdict().items() if name not in ("moved", "error")}
        figures |= {"median": found.error.median(), "within": (found.error <= 1).float().mean()}
        self.log_dict({f"train/{name}": value for name, value in figures.items()}, batch_size=1)
        self.log("loss", found.total.detach(), prog_bar=True, logger=False, batch_size=1)
        return found.total

    def optimizer_step(self, *arguments: Any, **named: Any) -> None:
        """Step, then update the average, before any callback saves both."""
        super().optimizer_step(*arguments, **named)
        step = self.global_step
        keep = min(self.fit.averaging, 1 - 1 / (1 + step / _FORGET))
        with torch.no_grad():
            for slow, fast in zip(self.average.parameters(), self.network.parameters(), strict=True):
                slow.lerp_(fast, 1 - keep)

    def on_train_batch_end(self, outputs: Any, batch: int, batch_idx: int) -> None:
        """Stop when the steps or minutes are used up."""
        if self.done >= 1:
            self.trainer.should_stop = True

    def validation_step(self, batch: int, batch_idx: int) -> None:
        """Run all rounds of the averaged network on a held-back cloud; all clouds have equal weight."""
        figures = torch.zeros(len(_FIGURES))
        if batch < len(self.held_back):
            error = rounds_of(lifted(self.held_back[batch], self.attack, self.embeddings, self.device), self.attack)[
                -1
            ].error
            # Clamped, so that an error of 0 does not give an infinite score.
            score = error.median().clamp_min(1e-3).log()
            figures = torch.stack([score, error.median(), (error <= 1).float().mean()]) / len(self.held_back)
        # Contributions to the mean, summed: ranks may have judged different numbers of clouds.
        named: dict[str, Tensor] = dict(zip(_FIGURES, figures, strict=True))
        self.log_dict(named, batch_size=1, sync_dist=True, reduce_fx="sum")

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save the clock and the pools of all ranks."""
        assert self.pool is not None
        pools = [self.pool.state_dict()]
        if self.trainer.world_size > 1:
            pools = [{} for _ in range(self.trainer.world_size)]
            torch.distributed.all_gather_object(pools, self.pool.state_dict())
        checkpoint["seconds"], checkpoint["pools"] = self.seconds, pools

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the clock and the pools."""
        self._seconds_before, self._pools_before = checkpoint["seconds"], checkpoint["pools"]
