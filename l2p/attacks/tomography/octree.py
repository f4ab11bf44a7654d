"""A sparse octree: cubic cells, refined where samples fall; every cell is an octant of its parent.

Cells are ordered by parent, then by octant (4 x half along the first axis + 2 x second + third), so that children,
parents and neighbours are found by gathers, without sorting or searching.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.work.shards import Shards

#: Fraction of their difference that neighbours exchange, so that a density constant per parent becomes trilinear.
TRILINEAR = 0.25


class Cells(NamedTuple):
    """Octree cells of one resolution; the full grid would have ``side`` cells along each axis.

    ``place`` holds the indices of each cell along the axes, ``after`` and ``before`` the rows of its neighbours along
    them, or the number of cells where there is none. ``code`` is 8 x row of the parent in the coarser level + octant;
    it is empty at the coarsest level, which has all cells.
    """

    side: int
    place: Int[Tensor, "3 placed"]
    after: Int[Tensor, "3 placed"]
    before: Int[Tensor, "3 placed"]
    code: Int[Tensor, " octants"]

    @property
    def count(self) -> int:
        """Number of cells."""
        return len(self.code) or self.side**3

    @property
    def parent(self) -> Int[Tensor, " octants"]:
        """Row of each cell's parent in the coarser level."""
        return self.code >> 3

    def without_neighbors(self) -> Cells:
        """Drop positions and neighbours; only the rows of the parents remain."""
        none = self.place.new_empty(3, 0)  # not a view, which would hold the memory of all rows
        return self._replace(place=none, after=none, before=none)

    def octants(self, row: Int[Tensor, " samples"], place: Int[Tensor, "3 samples"]) -> Int[Tensor, " samples"]:
        """Octant of each sample, ``8 parent + octant``; -1 for a sample outside the box.

        Parameters
        ----------
        row : (samples,)
            Cell of the sample in this level; the number of cells for a sample outside the box.
        place : (3, samples)
            Indices of the sample in the finer grid. Its parent is the cell ``row`` or a neighbour of it; if this
            neighbour does not exist, the sample is clamped to its cell.
        """
        count = self.count
        outside = row == count
        row = row.masked_fill(outside, 0)
        corner = self.place.index_select(1, row)
        for axis in range(3):
            step = torch.div(place[axis], 2, rounding_mode="floor") - corner[axis]
            for neighbor, moved in ((self.after, step > 0), (self.before, step < 0)):
                sample = torch.nonzero(moved).flatten()
                target = neighbor[axis].index_select(0, row.index_select(0, sample))
                exists = target < count
                row[sample[exists]] = target[exists]
            corner[axis] = self.place[axis].index_select(0, row)
        half = (place - 2 * corner).clamp_(0, 1)
        code = 8 * row + 4 * half[0] + 2 * half[1] + half[2]
        return code.masked_fill_(outside, -1)


def root(side: int, device: torch.device) -> Cells:
    """All cells of a grid with ``side`` cells along each axis."""
    line = torch.arange(side, dtype=torch.int32, device=device)
    place = torch.stack(torch.meshgrid(line, line, line, indexing="ij")).flatten(1)
    row = torch.arange(side**3, dtype=torch.int32, device=device)
    stride = torch.tensor([[side * side], [side], [1]], dtype=torch.int32, device=device)
    after = torch.where(place < side - 1, row + stride, side**3)
    before = torch.where(place > 0, row - stride, side**3)
    return Cells(side, place, after, before, row[:0])


def children(
    above: Cells, code: Int[Tensor, "lines m"], samples: int, shards: Shards | None = None
) -> tuple[Cells, Int[Tensor, "lines m"]]:
    """Refine cells: return the octants that contain samples, and the row of each sample's new cell.

    Parameters
    ----------
    above : Cells
        The coarser level.
    code : (lines, m)
        Octants of this process's samples, from :meth:`Cells.octants`. Overwritten by the returned rows; a sample
        outside the box gets the number of cells.
    samples : int
        Samples per block; limits the temporaries.
    shards : Shards
        Processes whose samples together define the cells.
    """
    parents = above.count
    occupied = torch.zeros(8 * parents, dtype=torch.bool, device=code.device)
    for block in code.view(-1).split(samples):
        occupied[block[block >= 0]] = True
    (shards or Shards()).either(occupied)
    codes = torch.nonzero(occupied).flatten().int()
    del occupied
    count = len(codes)
    # Row of each octant; ``count`` for absent octants, for those of an absent parent, and for the code -1.
    child = torch.full((8 * parents + 8,), count, dtype=torch.int32, device=code.device)
    child[codes] = torch.arange(count, dtype=torch.int32, device=code.device)
    for block in code.view(-1).split(samples):
        block.copy_(child.index_select(0, block.remainder(8 * parents + 8)))
    parent = codes >> 3
    place = above.place.index_select(1, parent).mul_(2)
    after, before = torch.empty_like(place), torch.empty_like(place)
    for begin in range(0, count, samples):
        block = slice(begin, begin + samples)
        for axis in range(3):
            half = (codes[block] >> (2 - axis)) & 1
            place[axis, block] += half
            for rows, neighbor, inner in ((after, above.after, 0), (before, above.before, 1)):
                # The neighbour is the other half of the same parent, or the near half of the parent's neighbour. Either
                # way its octant differs in the bit of this axis.
                other = torch.where(half == inner, parent[block], neighbor[axis].index_select(0, parent[block]))
                mirrored = (codes[block] & 7) ^ (4 >> axis)
                rows[axis, block] = child.index_select(0, 8 * other + mirrored)
    return Cells(2 * above.side, place, after, before, codes), code


def total(mass: Float[Tensor, " cells"], cells: Cells, above: Cells) -> Float[Tensor, " parents"]:
    """Sum the mass of the children of each parent."""
    return mass.new_zeros(above.count).index_add_(0, cells.parent, mass)


def smooth(mass: Float[Tensor, " cells"], cells: Cells, share: float) -> Float[Tensor, " cells"]:
    """Convolve with the weights (share, 1 - 2 share, share) along each axis.

    Mass smoothed into absent cells is dropped on purpose: it penalises isolated cells.
    """
    for axis in range(3):
        padded = torch.cat([mass, mass.new_zeros(1)])
        beside = padded.index_select(0, cells.after[axis]) + padded.index_select(0, cells.before[axis])
        mass = (1 - 2 * share) * mass + share * beside
    return mass


def interpolate(above: Float[Tensor, " cells"], cells: Cells) -> Float[Tensor, " cells"]:
    """Make densities that are constant per parent trilinear; the sum does not change."""
    count = len(above)
    for axis in range(3):
        flow = torch.zeros_like(above)
        for neighbor in (cells.after[axis], cells.before[axis]):
            # There is no exchange with absent neighbours.
            beside = torch.where(neighbor < count, above.index_select(0, neighbor.clamp_max(count - 1)), above)
            flow += beside - above
        above = above + TRILINEAR * flow
    return above
