"""Lines as tensors in a working frame."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor


class Lines(NamedTuple):
    """Lines as tensors in a working frame: unit ``direction`` and ``moment``, both (lines, 3)."""

    direction: Float[Tensor, "lines 3"]
    moment: Float[Tensor, "lines 3"]

    @property
    def foot(self) -> Float[Tensor, "lines 3"]:
        """o = d x m, the point of each line nearest to the frame's origin."""
        return torch.linalg.cross(self.direction, self.moment)

    def at(self, beta: Float[Tensor, " lines"]) -> Float[Tensor, "lines 3"]:
        """The points o + beta d."""
        return self.foot + beta[:, None] * self.direction

    def rows(self, index: slice | Int[Tensor, " some"]) -> Lines:
        """Some of the lines."""
        return Lines(self.direction[index], self.moment[index])


def picked(column: Shaped[Tensor, "rows ..."], index: Int[Tensor, "some k"]) -> Shaped[Tensor, "some k ..."]:
    """``column[index]``, which torch does in a third of the time this way."""
    return column.index_select(0, index.flatten()).view(*index.shape, *column.shape[1:])


def crosswise(vectors: Float[Tensor, "rows 3"]) -> Float[Tensor, "rows 3"]:
    """The coordinate axis that is most nearly at right angles to each vector."""
    return torch.zeros_like(vectors).scatter_(1, vectors.abs().argmin(dim=1, keepdim=True), 1)
