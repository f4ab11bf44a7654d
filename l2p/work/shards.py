"""Lines distributed over processes (ranks), on one machine or several.

Every rank has all lines and all estimates, and works on a range of the lines. Results that depend on all lines are
summed (the density of the tomography) or gathered (the estimates). Both are equal to the bit for any number of ranks:
sums are of integers, and ranges are whole blocks of ``BLOCK`` lines, since the last digit of a matrix product may
depend on its size.

The ranks are those of ``torch.distributed``; :mod:`l2p.work.processes` joins them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from l2p.errors import InputError, LostProcessError

#: Lines per block: the batch of the network (:class:`l2p.attacks.learned.learned.LearnedConfig`).
BLOCK = 256


class Shards:
    """A single process that works on all lines; :class:`Processes` distributes them.

    Attributes
    ----------
    rank : int
        Rank of this process; rank 0 reads and writes the files.
    processes : int
        Number of processes.
    sent : int
        Bytes of the tensors that this process has sent to others, each counted once.
    """

    rank = 0
    processes = 1
    sent = 0

    def own(self, count: int) -> slice:
        """Range of this rank among ``count`` lines."""
        return slice(0, count)

    def check(self, count: int) -> None:
        """InputError if there are too few lines for all ranks."""

    def gather(self, part: Shaped[Tensor, "own ..."], count: int) -> Shaped[Tensor, "lines ..."]:
        """Return the rows of all ranks, in order."""
        return part

    def collect(self, part: Shaped[Tensor, "own ..."], count: int) -> Shaped[Tensor, "lines ..."]:
        """Return the rows of all ranks, in order, on rank 0; no rows on the others."""
        return part

    def sum(self, whole: Int[Tensor, "..."]) -> None:
        """Sum over all ranks, in place."""

    def either(self, whole: Bool[Tensor, "..."]) -> None:
        """Logical or over all ranks, in place."""

    def first(self, whole: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
        """Return the tensor of rank 0; the others pass one of the same shape, to be filled."""
        return whole

    def first_json(self, value: Any, device: torch.device) -> Any:
        """Return the plain value of rank 0; the others pass None."""
        content = json.dumps(value).encode() if self.rank == 0 else b""
        size = int(self.first(torch.tensor(len(content), device=device)))
        sent = torch.frombuffer(bytearray(content or bytes(size)), dtype=torch.uint8).to(device)
        return json.loads(bytes(self.first(sent).cpu().numpy()))


class Processes(Shards):
    """The ranks of a process group.

    Parameters
    ----------
    distributed : module
        ``torch.distributed`` with its default group open, or an object with the same functions.
    """

    def __init__(self, distributed: Any) -> None:
        self.rank = distributed.get_rank()
        self.processes = distributed.get_world_size()
        self.sent = 0
        self._distributed = distributed

    def own(self, count: int) -> slice:
        """Range of this rank: the same number of blocks for each rank, fewer for the last ones."""
        rows = self._rows(count)
        return slice(min(self.rank * rows, count), min((self.rank + 1) * rows, count))

    def check(self, count: int) -> None:
        """InputError if there are too few lines for all ranks."""
        if (self.processes - 1) * self._rows(count) >= count:
            most = -(-count // self._rows(count))
            raise InputError(
                f"got {self.processes} processes for {count} lines; expected at most {most}, since each takes whole "
                f"blocks of {BLOCK} lines"
            )

    def _rows(self, count: int) -> int:
        return -(-count // (BLOCK * self.processes)) * BLOCK

    def gather(self, part: Shaped[Tensor, "own ..."], count: int) -> Shaped[Tensor, "lines ..."]:
        """Return the rows of all ranks, in order."""
        rows = self._rows(count)
        whole = part.new_empty(self.processes * rows, *part.shape[1:])
        self._call(self._distributed.all_gather, part, list(whole.split(rows)), self._padded(part, rows))
        return whole[:count]

    def collect(self, part: Shaped[Tensor, "own ..."], count: int) -> Shaped[Tensor, "lines ..."]:
        """Return the rows of all ranks, in order, on rank 0; no rows on the others."""
        rows = self._rows(count)
        whole = part.new_empty(0 if self.rank else self.processes * rows, *part.shape[1:])
        places = None if self.rank else list(whole.split(rows))
        self._call(self._distributed.gather, part if self.rank else part[:0], self._padded(part, rows), places)
        return whole[:count]

    def sum(self, whole: Int[Tensor, "..."]) -> None:
        """Sum over all ranks, in place."""
        self._call(self._distributed.all_reduce, whole, whole)

    def either(self, whole: Bool[Tensor, "..."]) -> None:
        """Logical or over all ranks, in place."""
        word = whole.view(torch.uint8)
        self._call(self._distributed.all_reduce, word, word, self._distributed.ReduceOp.MAX)

    def first(self, whole: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
        """Return the tensor of rank 0; the others pass one of the same shape, to be filled."""
        whole = whole.contiguous()
        self._call(self._distributed.broadcast, whole.flatten()[:0] if self.rank else whole, whole, 0)
        return whole

    def _padded(self, part: Shaped[Tensor, "own ..."], rows: int) -> Shaped[Tensor, "rows ..."]:
        """Pad to ``rows`` rows: the last ranks have fewer."""
        return torch.cat([part, part.new_zeros(rows - len(part), *part.shape[1:])]) if len(part) < rows else part

    def _call(self, operation: Callable[..., Any], sent: Tensor, *words: Any) -> None:
        self.sent += sent.numel() * sent.element_size()
        try:
            operation(*words)
        except RuntimeError as error:
            raise LostProcessError(
                f"process {self.rank} of {self.processes} has lost another one; start again with --resume to go on "
                "from the last finished round"
            ) from error
