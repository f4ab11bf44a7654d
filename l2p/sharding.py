"""Lines shared out over processes, on one machine or several: who has which, and how they put together what they find.

Every process knows all lines and all estimates, and works on a run of the lines of its own. What each line needs of all
others is summed up (the density of the tomography) or gathered (the estimates). Both give the same bits whatever the
number of processes: sums are of integers, and runs begin at whole ``BLOCK`` lines, so that blocks of lines, whose matrix
products may depend on their size in the last digit, are the same blocks.

The processes are those of ``torch.distributed``, as ``torchrun`` starts them; they talk by gloo, on GPUs by NCCL.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from l2p.errors import InputError, LostProcessError

#: Lines in a block: those that the network judges at a time (:class:`l2p.learned.LearnedConfig`).
BLOCK = 64
#: How long a process waits for the others: far longer than they are apart in their work.
PATIENCE = timedelta(minutes=30)
#: Name at the store of the processes under which the first one that has something to say of the end of all says so.
_TOLD = "l2p/told"


class Shards:
    """One process that has all lines; :class:`Processes` share them.

    Attributes
    ----------
    rank : int
        Number of this process; the first, 0, reads and writes the files.
    processes : int
        How many there are.
    sent : int
        Bytes of the tensors that this process has sent on to others, each counted once.
    """

    rank = 0
    processes = 1
    sent = 0

    def own(self, count: int) -> slice:
        """The rows of this process, of ``count`` lines."""
        return slice(0, count)

    def check(self, count: int) -> None:
        """Refuse lines that are too few to go round."""

    def gather(self, part: Shaped[Tensor, "own *shape"], count: int) -> Shaped[Tensor, "lines *shape"]:
        """The rows of all processes, in order."""
        return part

    def collect(self, part: Shaped[Tensor, "own *shape"], count: int) -> Shaped[Tensor, "lines *shape"]:
        """The rows of all processes, in order, at the first one; none at the others."""
        return part

    def sum(self, whole: Int[Tensor, "*shape"]) -> None:
        """Add the numbers of all processes, in place."""

    def either(self, whole: Bool[Tensor, "*shape"]) -> None:
        """What is true for any process, in place."""

    def first(self, whole: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
        """What the first process has; the others give a tensor of the same shape to fill."""
        return whole


#: The default of every function that takes ``shards``.
ALONE = Shards()


class Processes(Shards):
    """The processes of the default group of ``torch.distributed``, which has to be open."""

    def __init__(self) -> None:
        from torch import distributed

        self.rank = distributed.get_rank()
        self.processes = distributed.get_world_size()
        self.sent = 0
        self._distributed = distributed

    def own(self, count: int) -> slice:
        """The rows of this process: as many blocks for each, fewer for the last."""
        rows = self._rows(count)
        return slice(min(self.rank * rows, count), min((self.rank + 1) * rows, count))

    def check(self, count: int) -> None:
        """Refuse lines that are too few to go round."""
        if (self.processes - 1) * self._rows(count) >= count:
            most = -(-count // self._rows(count))
            raise InputError(
                f"got {self.processes} processes for {count} lines; expected at most {most}, since each takes whole "
                f"blocks of {BLOCK} lines"
            )

    def _rows(self, count: int) -> int:
        return -(-count // (BLOCK * self.processes)) * BLOCK

    def gather(self, part: Shaped[Tensor, "own *shape"], count: int) -> Shaped[Tensor, "lines *shape"]:
        """The rows of all processes, in order."""
        rows = self._rows(count)
        whole = part.new_empty(self.processes * rows, *part.shape[1:])
        self._call(self._distributed.all_gather, part, list(whole.split(rows)), self._padded(part, rows))
        return whole[:count]

    def collect(self, part: Shaped[Tensor, "own *shape"], count: int) -> Shaped[Tensor, "lines *shape"]:
        """The rows of all processes, in order, at the first one; none at the others."""
        rows = self._rows(count)
        whole = part.new_empty(0 if self.rank else self.processes * rows, *part.shape[1:])
        places = None if self.rank else list(whole.split(rows))
        self._call(self._distributed.gather, part[:0] if self.rank == 0 else part, self._padded(part, rows), places)
        return whole[:count]

    def sum(self, whole: Int[Tensor, "*shape"]) -> None:
        """Add the numbers of all processes, in place."""
        self._call(self._distributed.all_reduce, whole, whole)

    def either(self, whole: Bool[Tensor, "*shape"]) -> None:
        """What is true for any process, in place."""
        word = whole.view(torch.uint8)
        self._call(self._distributed.all_reduce, word, word, self._distributed.ReduceOp.MAX)

    def first(self, whole: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
        """What the first process has; the others give a tensor of the same shape to fill."""
        whole = whole.contiguous()
        self._call(self._distributed.broadcast, whole[:0] if self.rank and whole.dim() else whole, whole, 0)
        return whole

    def _padded(self, part: Shaped[Tensor, "own *shape"], rows: int) -> Shaped[Tensor, "rows *shape"]:
        """The last process has fewer rows than the others."""
        return torch.cat([part, part.new_zeros(rows - len(part), *part.shape[1:])]) if len(part) < rows else part

    def _call(self, operation: Callable[..., Any], sent: Tensor, *words: Any) -> None:
        self.sent += sent.numel() * sent.element_size()
        try:
            operation(*words)
        except RuntimeError as error:
            raise LostProcessError(
                f"process {self.rank} of {self.processes} has lost another one, which ended before its work was done"
            ) from error
