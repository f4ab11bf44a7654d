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
        """Foot o = d x m, the point of each line nearest to the frame's origin."""
        return torch.linalg.cross(self.direction, self.moment)

    def at(self, beta: Float[Tensor, " lines"]) -> Float[Tensor, "lines 3"]:
        """Points o + beta d."""
        return self.foot + beta[:, None] * self.direction

    def rows(self, index: slice | Int[Tensor, " some"]) -> Lines:
        """Select lines."""
        return Lines(self.direction[index], self.moment[index])


def picked(column: Shaped[Tensor, "rows ..."], index: Int[Tensor, "some k"]) -> Shaped[Tensor, "some k ..."]:
    """Return ``column[index]``, in a third of the time of torch's indexing."""
    return column.index_select(0, index.flatten()).view(*index.shape, *column.shape[1:])


def crosswise(vectors: Float[Tensor, "rows 3"]) -> Float[Tensor, "rows 3"]:
    """Coordinate axis most nearly perpendicular to each vector."""
    return torch.zeros_like(vectors).scatter_(1, vectors.abs().argmin(dim=1, keepdim=True), 1)
