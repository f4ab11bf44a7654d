"""A sparse grid of cubes that is refined where it is needed: every cell is one of the eight halves of a parent.

Rows of cells are ordered by parent, then by octant (4 x half along the first axis + 2 x second + third), so that
finding children, parents and neighbours takes gathers alone, no sorting and no search.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.work.shards import Shards

#: Exchange between neighbours that turns the even spreading of a parent's mass into trilinear interpolation.
TRILINEAR = 0.25


class Cells(NamedTuple):
    """The cells of one resolution, ``side`` of them along each side of the box if all were there.

    ``after`` and ``before`` are the rows of each cell's neighbours along the three axes, the number of cells where
    there is none. ``code`` is 8 x the parent's row among the cells of the coarser resolution + the octant; it is empty
    at the coarsest resolution, where all cells are there. ``place`` holds the indices of each cell along the axes.
    """

    side: int
    place: Int[Tensor, "3 placed"]
    after: Int[Tensor, "3 placed"]
    before: Int[Tensor, "3 placed"]
    code: Int[Tensor, " octants"]

    @property
    def count(self) -> int:
        """The number of cells that are there."""
        return len(self.code) or self.side**3

    @property
    def parent(self) -> Int[Tensor, " octants"]:
        """The row of each cell's parent."""
        return self.code >> 3

    def without_neighbors(self) -> Cells:
        """The family tree alone, which is all that ancestors are needed for."""
        nobody = self.place.new_empty(3, 0)  # not a view, which would keep all places
        return self._replace(place=nobody, after=nobody, before=nobody)

    def octants(self, row: Int[Tensor, " samples"], place: Int[Tensor, "3 samples"]) -> Int[Tensor, " samples"]:
        """Where samples of the finer resolution fall: ``8 parent + octant``, -1 for a sample outside the box.

        ``row`` is the cell that the sample comes from. Its parent is that cell, or the neighbour that it has moved
        to; a sample that has moved where no cell is stays at the border of its own.
        """
        count = self.count
        outside = row == count
        row = row.masked_fill(outside, 0)
        corner = self.place.index_select(1, row)
        for axis in range(3):
            step = torch.div(place[axis], 2, rounding_mode="floor") - corner[axis]
            for neighbor, moved in ((self.after, step > 0), (self.before, step < 0)):
                sample = torch.nonzero(moved).flatten()
                there = neighbor[axis].index_select(0, row.index_select(0, sample))
                found = there < count
                row[sample[found]] = there[found]
            corner[axis] = self.place[axis].index_select(0, row)
        half = (place - 2 * corner).clamp_(0, 1)
        code = 8 * row + 4 * half[0] + 2 * half[1] + half[2]
        return code.masked_fill_(outside, -1)


def root(side: int, device: torch.device) -> Cells:
    """All cells of a coarse grid."""
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
    """The halves of cells that samples fall in, ``code`` being their octants, and the row of each sample's cell.

    The samples of all processes make the cells; rows are those of the own ones. A sample outside the box gets the
    number of cells. ``code`` is overwritten; ``samples`` bounds the temporaries.
    """
    parents = above.count
    occupied = torch.zeros(8 * parents, dtype=torch.bool, device=code.device)
    for part in code.view(-1).split(samples):
        occupied[part[part >= 0]] = True
    (shards or Shards()).either(occupied)
    octant = torch.nonzero(occupied).flatten().int()
    del occupied
    count = len(octant)
    # A parent that is not there has no children; neither has the octant -1.
    child = torch.full((8 * parents + 8,), count, dtype=torch.int32, device=code.device)
    child[octant] = torch.arange(count, dtype=torch.int32, device=code.device)
    for part in code.view(-1).split(samples):
        part.copy_(child.index_select(0, part.remainder(8 * parents + 8)))
    parent = octant >> 3
    place = above.place.index_select(1, parent).mul_(2)
    after, before = torch.empty_like(place), torch.empty_like(place)
    for begin in range(0, count, samples):
        part = slice(begin, begin + samples)
        for axis in range(3):
            half = octant[part] >> (2 - axis) & 1
            place[axis, part] += half
            for rows, beyond, inner in ((after, above.after, 0), (before, above.before, 1)):
                # The other half of the same parent, or the near half of the parent beyond.
                other = torch.where(half == inner, parent[part], beyond[axis].index_select(0, parent[part]))
                rows[axis, part] = child.index_select(0, 8 * other + (octant[part] & 7 ^ 4 >> axis))
    return Cells(2 * above.side, place, after, before, octant), code


def total(mass: Float[Tensor, " cells"], cells: Cells, above: Cells) -> Float[Tensor, " parents"]:
    """The mass of the children of each parent."""
    return mass.new_zeros(above.count).index_add_(0, cells.parent, mass)


def smooth(mass: Float[Tensor, " cells"], cells: Cells, share: float) -> Float[Tensor, " cells"]:
    """A kernel of weights (share, 1 - 2 share, share) along each axis.

    What goes to cells that are not there is gone: mass that stands alone is worth less than mass among its like.
    """
    for axis in range(3):
        padded = torch.cat([mass, mass.new_zeros(1)])
        beside = padded.index_select(0, cells.after[axis]) + padded.index_select(0, cells.before[axis])
        mass = (1 - 2 * share) * mass + share * beside
    return mass


def interpolate(above: Float[Tensor, " cells"], cells: Cells) -> Float[Tensor, " cells"]:
    """Parents' densities, given evenly spread over their children, made trilinear; the sum stays."""
    count = len(above)
    for axis in range(3):
        flow = torch.zeros_like(above)
        for neighbor in (cells.after[axis], cells.before[axis]):
            # A neighbour that is not there gives and takes nothing.
            there = torch.where(neighbor < count, above.index_select(0, neighbor.clamp_max(count - 1)), above)
            flow += there - above
        above = above + TRILINEAR * flow
    return above
