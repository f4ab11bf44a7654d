"""One parameter for the processes, the memory, the progress display and the journal of an attack."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import TypeVar

import torch
from jaxtyping import Shaped
from torch import Tensor

from l2p.errors import InputError
from l2p.work.journal import Journal, Saved
from l2p.work.memory import fitting
from l2p.work.progress import NO_PROGRESS, Progress
from l2p.work.shards import Shards
from l2p.work.threads import over_blocks

Result = TypeVar("Result")


@dataclass(frozen=True)
class Work:
    """Execution of an attack; the recovered points do not depend on it.

    Attributes
    ----------
    shards : Shards
        Processes that share the lines.
    journal : Journal
        Journal in which rank 0 saves finished rounds.
    progress : Progress
        Display of the progress.
    room : int or None
        Bytes for the temporaries of blocks; None for no limit.
    """

    shards: Shards = field(default_factory=Shards)
    journal: Journal = field(default_factory=Journal)
    progress: Progress = NO_PROGRESS
    room: int | None = None

    def own(self, count: int) -> slice:
        """Range of this process among ``count`` lines."""
        return self.shards.own(count)

    def gather(self, part: Shaped[Tensor, "own ..."], count: int) -> Shaped[Tensor, "lines ..."]:
        """Return the rows of all processes, in order."""
        return self.shards.gather(part, count)

    def task(self, name: str, total: int) -> AbstractContextManager[Callable[[int], None]]:
        """Open a task of ``total`` steps in the progress display."""
        return self.progress.task(name, total)

    def fitting(self, most: int, each: float) -> int:
        """Items of ``each`` bytes per block: ``most``, or fewer if the room is smaller."""
        return fitting(most, each, self.room)

    def over_blocks(
        self,
        function: Callable[[slice, Work], Result],
        count: int,
        size: int,
        device: torch.device | None = None,
        row_bytes: float = 0,
    ) -> Iterator[tuple[slice, Result]]:
        """Apply ``function(block, work)`` to blocks of rows on all cores (:func:`l2p.work.threads.over_blocks`).

        The ``work`` passed to ``function`` has the block's part of the room.
        """

        def within(block: slice, room: int | None) -> Result:
            return function(block, replace(self, room=room))

        return over_blocks(within, count, size, device, row_bytes, self.room)

    def resumed(
        self, columns: Mapping[str, tuple[int, ...]], like: Shaped[Tensor, "lines ..."]
    ) -> tuple[int, dict[str, Tensor] | None]:
        """Load the last saved round: its number and tensors; (0, None) for a fresh run.

        Parameters
        ----------
        columns : mapping
            Name of each saved tensor and its shape per line.
        like : (lines, ...)
            Tensor with the length, dtype and device of the saved ones.

        Raises
        ------
        InputError
            If the saved tensors have other names or shapes.
        """
        saved = self.journal.last() if self.shards.rank == 0 else None
        rounds = int(self.shards.first(torch.tensor(saved.rounds if saved else 0, device=like.device)))
        if not rounds:
            return 0, None
        state = {name: like.new_empty(len(like), *shape) for name, shape in columns.items()}
        if saved is not None:
            shapes = {name: tuple(value.shape) for name, value in state.items()}
            if {name: value.shape for name, value in saved.state.items()} != shapes:
                raise InputError(
                    "the state of the run does not fit its lines, so it is damaged; remove it to begin again"
                )
            state = {name: torch.as_tensor(saved.state[name]).to(like) for name in columns}
        return rounds, {name: self.shards.first(value) for name, value in state.items()}

    def save(self, rounds: int, state: Mapping[str, Tensor]) -> None:
        """Save the tensors of all lines after ``rounds`` rounds."""
        if self.shards.rank == 0:
            self.journal.save(Saved(rounds, {name: value.cpu().numpy() for name, value in state.items()}))


#: Default of the parameter ``work``: one process, silent, no limit on memory, nothing saved.
ALONE = Work()
