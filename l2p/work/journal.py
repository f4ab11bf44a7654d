"""What is kept of the rounds of an attack that are done, so that a run that was ended goes on from there."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from l2p.errors import InputError
from l2p.work.shards import ALONE, Shards


class Kept(NamedTuple):
    """What is known of all lines after so many rounds, by name: the rounds after them need no more."""

    rounds: int
    parts: dict[str, np.ndarray]


class Journal:
    """Keeps nothing; :class:`l2p.io.state_files.StateFile` writes to a file."""

    def begin(self, about: dict[str, Any]) -> None:
        """Begin a run on these lines with this method and its settings, or refuse to go on from that of another."""

    def last(self) -> Kept | None:
        """What the run goes on from, if it was begun before."""
        return None

    def keep(self, kept: Kept) -> None:
        """Keep what is known after a round, in place of what was known before."""


@dataclass(frozen=True)
class Rounds:
    """Who does the rounds of an attack, and where is kept what they find.

    Attributes
    ----------
    shards : Shards
        The processes that share the lines.
    journal : Journal
        Of the first process; the others are told what is in it.
    """

    shards: Shards = ALONE
    journal: Journal = field(default_factory=Journal)

    def last(self, like: dict[str, Tensor]) -> tuple[int, dict[str, Tensor]]:
        """How many rounds are done, and what was kept after the last: tensors like those given, or these if none."""
        kept = self.journal.last() if self.shards.rank == 0 else None
        some = next(iter(like.values()))
        done = int(self.shards.first(torch.tensor(kept.rounds if kept else 0, device=some.device)))
        if not done:
            return 0, like
        told = {name: torch.empty_like(part) for name, part in like.items()}
        if kept is not None:
            if {name: part.shape for name, part in kept.parts.items()} != {
                name: part.shape for name, part in like.items()
            }:
                raise InputError(
                    "the state of the run does not fit its lines, so it is damaged; remove it to begin again"
                )
            told = {name: torch.as_tensor(kept.parts[name]).to(part) for name, part in like.items()}
        return done, {name: self.shards.first(part) for name, part in told.items()}

    def keep(self, rounds: int, parts: dict[str, Tensor]) -> None:
        """Keep what is known of all lines after so many rounds."""
        if self.shards.rank == 0:
            self.journal.keep(Kept(rounds, {name: part.cpu().numpy() for name, part in parts.items()}))
