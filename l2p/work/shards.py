"""Lines shared out over processes, on one machine or several: who has which, and how they put together what they find.

Every process knows all lines and all estimates, and works on a run of the lines of its own. What each line needs of all
others is summed up (the density of the tomography) or gathered (the estimates). Both give the same bits whatever the
number of processes: sums are of integers, and runs are of whole blocks of ``BLOCK`` lines. A product of matrices may
depend on their size in the last digit, so blocks have to be the same blocks.

The processes are those of ``torch.distributed``; :mod:`l2p.work.processes` brings them together.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from l2p.errors import InputError, LostProcessError

#: Lines in a block: those that the network judges at a time (:class:`l2p.attacks.learned.learned.LearnedConfig`).
BLOCK = 256


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

    def gather(self, part: Shaped[Tensor, "own ..."], count: int) -> Shaped[Tensor, "lines ..."]:
        """The rows of all processes, in order."""
        return part

    def collect(self, part: Shaped[Tensor, "own ..."], count: int) -> Shaped[Tensor, "lines ..."]:
        """The rows of all processes, in order, at the first one; none at the others."""
        return part

    def sum(self, whole: Int[Tensor, "..."]) -> None:
        """Add the numbers of all processes, in place."""

    def either(self, whole: Bool[Tensor, "..."]) -> None:
        """What is true for any process, in place."""

    def first(self, whole: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
        """Return the tensor of the first process; the others pass one of the same shape to fill."""
        return whole

    def first_json(self, value: Any, device: torch.device) -> Any:
        """Return the plain value of the first process; the others pass None."""
        content = json.dumps(value).encode() if self.rank == 0 else b""
        size = int(self.first(torch.tensor(len(content), device=device)))
        sent = torch.frombuffer(bytearray(content or bytes(size)), dtype=torch.uint8).to(device)
        return json.loads(bytes(self.first(sent).cpu().numpy()))


class Processes(Shards):
    """The processes of a group.

    Parameters
    ----------
    distributed : module
        ``torch.distributed`` with its default group open, or what does the same.
    """

    def __init__(self, distributed: Any) -> None:
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

    def gather(self, part: Shaped[Tensor, "own ..."], count: int) -> Shaped[Tensor, "lines ..."]:
        """The rows of all processes, in order."""
        rows = self._rows(count)
        whole = part.new_empty(self.processes * rows, *part.shape[1:])
        self._call(self._distributed.all_gather, part, list(whole.split(rows)), self._padded(part, rows))
        return whole[:count]

    def collect(self, part: Shaped[Tensor, "own ..."], count: int) -> Shaped[Tensor, "lines ..."]:
        """The rows of all processes, in order, at the first one; none at the others."""
        rows = self._rows(count)
        whole = part.new_empty(0 if self.rank else self.processes * rows, *part.shape[1:])
        places = None if self.rank else list(whole.split(rows))
        self._call(self._distributed.gather, part if self.rank else part[:0], self._padded(part, rows), places)
        return whole[:count]

    def sum(self, whole: Int[Tensor, "..."]) -> None:
        """Add the numbers of all processes, in place."""
        self._call(self._distributed.all_reduce, whole, whole)

    def either(self, whole: Bool[Tensor, "..."]) -> None:
        """What is true for any process, in place."""
        word = whole.view(torch.uint8)
        self._call(self._distributed.all_reduce, word, word, self._distributed.ReduceOp.MAX)

    def first(self, whole: Shaped[Tensor, "..."]) -> Shaped[Tensor, "..."]:
        """What the first process has; the others give a tensor of the same shape to fill."""
        whole = whole.contiguous()
        self._call(self._distributed.broadcast, whole.flatten()[:0] if self.rank else whole, whole, 0)
        return whole

    def _padded(self, part: Shaped[Tensor, "own ..."], rows: int) -> Shaped[Tensor, "rows ..."]:
        """The last process has fewer rows than the others."""
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
