"""What an attack is: anything that places a point on each line; and the order that lines decide themselves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.work.journal import Rounds
from l2p.work.progress import NO_PROGRESS, Progress
from l2p.work.shards import ALONE, Shards


class Estimate(NamedTuple):
    """A position on each line, in the working frame, and what it rests on.

    ``confidence`` is in [0, 1], 0 where a line had no vote and was placed next to the centre. ``neighbors`` is -1 and
    ``affinity`` 0 where a line has fewer than k neighbours.
    """

    beta: Float[Tensor, " lines"]
    confidence: Float[Tensor, " lines"]
    neighbors: Int[Tensor, "lines k"]
    affinity: Float[Tensor, "lines k"]


@runtime_checkable
class Method(Protocol):
    """Anything that places a point on each line; all attacks, bounds and users' own methods share this call."""

    def locate(self, lines: Lines, frame: Frame, progress: Progress = NO_PROGRESS) -> Estimate:
        """Place the points, in the working frame; ``frame`` leads to scene units for those that know the truth."""
        ...

    def settings(self) -> dict[str, Any]:
        """Plain values that say what was run, for the record."""
        ...


@runtime_checkable
class MethodInRounds(Method, Protocol):
    """A method that several processes can share, and that can go on from a round."""

    def locate_in_rounds(self, lines: Lines, frame: Frame, progress: Progress, rounds: Rounds) -> Estimate:
        """Place the points as ``locate`` does; the first process has the answer, the others that of their own lines."""
        ...


def own_order(lines: Lines) -> Int[Tensor, " lines"]:
    """The lines sorted by their coordinates."""
    key = torch.cat([lines.direction, lines.moment], dim=1).cpu().numpy()
    return torch.as_tensor(np.lexsort(key.T), device=lines.direction.device)


def in_own_order(lines: Lines, locate: Callable[[Lines], Estimate], shards: Shards = ALONE) -> Estimate:
    """What ``locate`` makes of the lines in an order that they decide themselves, in the order that they came in.

    Sums, and choices between equals, depend on the order; see :mod:`l2p.geometry.frame`. Of several processes, the
    first one has the answer, the others nothing.
    """
    order = own_order(lines)
    found = Estimate(*(shards.collect(part, len(order)) for part in locate(lines.rows(order))))
    if shards.rank > 0:
        return found
    place = order.argsort()
    near = found.neighbors[place]
    named = order[near.clamp_min(0).long()].to(near.dtype).masked_fill(near < 0, -1)
    return Estimate(found.beta[place], found.confidence[place], named, found.affinity[place])
