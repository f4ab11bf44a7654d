"""Density of the points of a map on a cubic grid, as elements of each class of appearance see it.

Expectation maximisation over list-mode data: each element of a map spreads one unit of mass over the cells through
which its set passes, in proportion to the density there; the masses, blurred, are the next density. An element sees the
masses of the others weighted by the likelihood ratio of their appearances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.alike import Classes

#: Part of the mean density that every cell keeps, so that no cell is lost for ever.
_FLOOR = 1e-3

#: Yields blocks of elements: their rows, the cells of each (flat index), and the weight of each cell, 0 for none.
Spread = Callable[[], Iterator[tuple[slice, Int[Tensor, "rows cells"], Float[Tensor, "rows cells"]]]]


def share(
    density: Float[Tensor, "classes cells"],
    label: Int[Tensor, " rows"],
    cell: Int[Tensor, "rows own"],
    weight: Float[Tensor, "rows own"],
) -> tuple[Int[Tensor, "rows own"], Float[Tensor, "rows own"]]:
    """Flat index of the class and cell of each element's cells, and the probability of each; they sum to 1 or 0."""
    index = label[:, None] * density.shape[1] + cell
    mass = density.view(-1)[index] * weight
    return index, mass / mass.sum(dim=1, keepdim=True).clamp_min(1e-30)


def maximised(
    density: Float[Tensor, "classes cells"], classes: Classes, side: int, spread: Spread
) -> Float[Tensor, "classes cells"]:
    """One step of expectation maximisation on a grid of side^3 cells."""
    mass = torch.zeros(density.numel())
    for rows, cell, weight in spread():
        index, part = share(density, classes.label[rows], cell, weight)
        mass.index_add_(0, index.view(-1), part.view(-1))
    around = blurred(mass.view(-1, side, side, side)).reshape(density.shape)
    seen = classes.ratio @ around / len(classes.label)
    return seen + _FLOOR * seen.mean(dim=1, keepdim=True).clamp_min(1e-30)


def flat(classes: Classes, side: int) -> Float[Tensor, "classes cells"]:
    """The first density: equal everywhere."""
    return torch.ones(len(classes.ratio), side**3)


def blurred(grid: Float[Tensor, "classes side side side"]) -> Float[Tensor, "classes side side side"]:
    """Blur by (1, 2, 1) / 4 along each axis; the outermost cells are repeated beyond the border."""
    for axis in (1, 2, 3):
        line = grid.movedim(axis, 0)
        before, after = torch.cat([line[:1], line[:-1]]), torch.cat([line[1:], line[-1:]])
        grid = (0.5 * line + 0.25 * (before + after)).movedim(0, axis)
    return grid


def finer(density: Float[Tensor, "classes cells"], side: int, factor: int) -> Float[Tensor, "classes more"]:
    """The same density on a grid whose cells are ``factor`` times as small."""
    grid = density.view(len(density), 1, side, side, side)
    return torch.nn.functional.interpolate(grid, scale_factor=factor, mode="trilinear").reshape(len(density), -1)
