"""What an attack knows of the scheme beyond single lines: lines through pairs of points, lines through centres."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.geometry.elements import Lines


class Structure(NamedTuple):
    """Relations among the elements of an attack; None where a scheme has none.

    Attributes
    ----------
    twin : (elements,) int64 or None
        The other point on the same line, where lines pass through pairs of points; each line is there twice.
    family : (elements,) int64 or None
        Row of ``center``, for lines that pass through one of a few centres. Lines of one family meet in their centre
        only, so they do not vote for one another.
    center : (families, 3) or None
        Centres, in the working frame.
    """

    twin: Int[Tensor, " elements"] | None = None
    family: Int[Tensor, " elements"] | None = None
    center: Float[Tensor, "families 3"] | None = None

    @property
    def families(self) -> int:
        """Number of families: 1 if all lines may vote for one another."""
        return 1 if self.center is None else len(self.center)

    @property
    def span(self) -> float:
        """Largest distance of two centres."""
        assert self.center is not None
        return float(torch.cdist(self.center, self.center).max())

    def sorted(self, row: Int[Tensor, " elements"]) -> Structure:
        """Structure of elements in another order; ``row`` is the former place of each."""
        twin = None if self.twin is None else row.argsort()[self.twin[row]]
        return Structure(twin, None if self.family is None else self.family[row], self.center)

    def own(self, some: slice) -> Structure:
        """Structure for the tomography of some elements, which needs their families only."""
        return self if self.family is None else self._replace(family=self.family[some])

    def depth2(self, lines: Lines, beta: Float[Tensor, "lines m"]) -> Float[Tensor, "lines m"] | None:
        """Squared distance r^2 of positions from the centre of their line; None without centres.

        Points in a solid angle fill r^2 dr, which is the density of the line given the point, up to a constant.
        """
        if self.family is None or self.center is None:
            return None
        along = ((self.center[self.family] - lines.foot) * lines.direction).sum(dim=1)
        return (beta - along[:, None]).square()


#: Independent lines, one for each point.
NO_STRUCTURE = Structure()
