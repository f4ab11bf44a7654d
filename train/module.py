"""Training of the network of the learned attack: the pool of clouds, the loss, figures."""

from __future__ import annotations

import logging
import math
import signal
from collections.abc import Sequence
from typing import Any

import torch
import torch.distributed
from torch import Tensor, nn
from torch.utils.data import DataLoader

from l2p.attacks.learned.learned import Learned
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import Judgement, LineTransformer
from train.averaged import AveragedModule
from train.clouds import CloudSource, lifted
from train.infonce import Embeddings
from train.judging import rounds_of
from train.losses import losses
from train.pool import Pool
from train.sources import Sources
from train.train_config import FitSettings

log = logging.getLogger("train")

#: Names of the validation figures.
_FIGURES = ("val/score", "val/median", "val/within")


class NetworkModule(AveragedModule):
    """Module of the trained ``network`` and its moving ``average``, which is validated and exported.

    ``probe`` predicts the error from the states, so that they carry information to the next round; it is not exported.
    """

    network: LineTransformer
    average: LineTransformer

    def __init__(
        self,
        network: LineTransformer,
        config: LearnedConfig,
        fit: FitSettings,
        sources: Sources,
        held_back: Sequence[CloudSource],
        embeddings: Embeddings | None = None,
    ) -> None:
        super().__init__(network, fit)
        self.embeddings = embeddings
        self.probe = nn.Linear(network.config.state, 1)
        # The attack uses the average, in evaluation mode; the pool does not use its weights.
        self.attack, self.fit = Learned(self.average, config), fit
        self.sources, self.held_back = sources, held_back
        self.pool: Pool | None = None
        self._pools_before: list[dict[str, Any]] = []

    def trained(self) -> list[nn.Parameter]:
        """Return all weights but those of the average."""
        return [*super().trained(), *self.probe.parameters()]

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
        super().on_train_start()
        log.info("lifting the first %d line clouds", self.fit.clouds)
        rank, ranks = self.global_rank, self.trainer.world_size
        self.pool = Pool(self.sources, self.attack, self.fit.clouds, self.fit.seed, rank, ranks, self.embeddings)
        if rank < len(self._pools_before):
            self.pool.load_state_dict(self._pools_before[rank])

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
        self.log_sums(_FIGURES, figures)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save the clock and the pools of all ranks."""
        assert self.pool is not None
        pools = [self.pool.state_dict()]
        if self.trainer.world_size > 1:
            pools = [{} for _ in range(self.trainer.world_size)]
            torch.distributed.all_gather_object(pools, self.pool.state_dict())
        super().on_save_checkpoint(checkpoint)
        checkpoint["pools"] = pools

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the clock and the pools."""
        super().on_load_checkpoint(checkpoint)
        self._pools_before = checkpoint["pools"]
