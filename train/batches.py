"""The stream of batches: which lines of which cloud step s takes depends on the seed and s alone.

So a resumed run goes on with the batches that it would have had, and nothing about them has to be stored.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import lightning
import numpy as np
import torch
from torch.utils.data import DataLoader, IterableDataset

from train.config import FitSettings
from train.losses import Sample
from train.states import State


class SampleStream(IterableDataset[Sample]):
    """Samples of the steps from ``begin`` on; clouds are drawn in proportion to the square root of their lines."""

    def __init__(self, states: Sequence[State], lines: int, seed: tuple[int, ...], begin: int, end: int) -> None:
        self.states = states
        self.lines = lines
        self.seed = seed
        self.begin = begin
        self.end = end
        weight = np.sqrt([len(state.candidates) for state in states])
        self.weight = weight / weight.sum()

    def __iter__(self) -> Iterator[Sample]:
        for step in range(self.begin, self.end):
            rng = np.random.default_rng([*self.seed, step])
            state = self.states[rng.choice(len(self.states), p=self.weight)]
            count = len(state.candidates)
            yield state.sample(torch.as_tensor(rng.choice(count, min(self.lines, count), replace=False)))


class Batches(lightning.LightningDataModule):
    """Training samples, and a fixed sample of each held-back cloud."""

    def __init__(self, training: Sequence[State], held_back: Sequence[State], fit: FitSettings, number: int) -> None:
        super().__init__()
        self.training = training
        self.held_back = held_back
        self.fit = fit
        self.number = number

    def train_dataloader(self) -> DataLoader[Sample]:
        """The rest of the stream: Lightning has restored the step when it asks."""
        assert self.trainer is not None
        seed = (self.fit.seed, self.number, self.trainer.global_rank)
        begin = self.trainer.global_step
        stream = SampleStream(self.training, self.fit.lines_per_batch, seed, begin, self.fit.steps)
        return DataLoader(stream, batch_size=None)

    def val_dataloader(self) -> DataLoader[Sample]:
        """One sample a cloud, the same each time."""
        samples = []
        for state in self.held_back:
            rng, count = np.random.default_rng(self.fit.seed), len(state.candidates)
            rows = rng.choice(count, min(self.fit.validate_lines, count), replace=False)
            samples.append(state.sample(torch.as_tensor(np.sort(rows))))
        return DataLoader(samples, batch_size=None)  # type: ignore[arg-type]
