"""The lines of one cloud that pass nearest to each line of another: exact, in blocks, two products of matrices each.

The distance of two lines is their reciprocal product |d_i . m_j + m_i . d_j| over the sine of their angle, so all
distances of a block are one product of six-vectors divided by the root of 1 - (d_i . d_j)^2, which is another. The
blocks are in single precision and choose a few lines; the distances that are returned are in double precision.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.geometry.elements import Lines
from l2p.geometry.pairs import PARALLEL, line_line_distance

#: Pairs of a block, whose distances fit into the cache of a core.
_BLOCK = 1 << 21
#: More lines that a block chooses than are wanted, since it ranks them in single precision.
_SPARE = 4


class NearestLines(NamedTuple):
    """Lines nearest to each line, nearest first; ``distance`` is infinite where a line has fewer than k."""

    index: Int[Tensor, "lines k"]
    distance: Float[Tensor, "lines k"]


def nearest_lines(lines: Lines, others: Lines, k: int, *, itself: bool = True) -> NearestLines:
    """Find, for each line, the k of the others at the least distance.

    Parameters
    ----------
    lines, others : Lines
        In double precision, in a frame whose unit is about the size of the scene.
    k : int
        Columns of the result; fewer if there are fewer others.
    itself : bool
        False if both are one cloud: row i is then no neighbour of row i.

    Notes
    -----
    Lines at an angle whose sine is below :data:`l2p.geometry.pairs.PARALLEL` have no closest point, and their distance
    counts as infinite: half a pair in a million of uniform directions.
    """
    count = len(others.direction)
    k = min(k, count - (not itself))
    if k < 1:
        empty = lines.direction.new_zeros(len(lines.direction), 0)
        return NearestLines(empty.long(), empty)
    spare, step = min(k + _SPARE, count), max(1, _BLOCK // count)
    first = torch.cat(lines, dim=1).float()
    direction = others.direction.float().T.contiguous()
    swapped = torch.cat([others.moment, others.direction], dim=1).float().T.contiguous()
    # Blocks write into it: small results kept between them would pin their freed temporaries in the heap.
    index = torch.empty(len(first), spare, dtype=torch.int64)
    for start in range(0, len(first), step):
        some = first[start : start + step]
        sine2 = torch.mm(some[:, :3], direction).square_().neg_().add_(1)
        near = torch.mm(some, swapped).square_().div_(sine2.clamp_(min=PARALLEL**2))
        # The clamped ones are parallel, up to single precision.
        near.masked_fill_(sine2 <= PARALLEL**2, torch.inf)
        if not itself:
            near[torch.arange(len(some)), torch.arange(start, start + len(some))] = torch.inf
        index[start : start + step] = near.topk(spare, dim=1, largest=False, sorted=False).indices
    distance = line_line_distance(lines, others, index)
    if not itself:
        distance.masked_fill_(index == torch.arange(len(index))[:, None], torch.inf)
    distance, order = distance.sort(dim=1, stable=True)
    return NearestLines(index.gather(1, order[:, :k]), distance[:, :k])
