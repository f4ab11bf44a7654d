"""Tomography: a density from the lines alone, and the most probable position of each line's point in it.

A uniform line cloud is a list-mode emission data set without time of flight: one event per point, all directions
equally likely. The density lambda follows by expectation maximisation (list-mode MLEM, Shepp & Vardi 1982): each line
spreads one unit of mass over the cells that it crosses in proportion to lambda (forward projection), and lambda
becomes the sum of this mass over all lines (back projection). Every point is seen by exactly one line, so the
sensitivity is 1 everywhere and drops out; so does the length of a line inside a cell, which is the same for all
samples of a line.

Resolution follows the data: cells are halved level by level along each line, keeping only the segments with the most
posterior mass (:mod:`l2p.attacks.tomography.octree`), and the density of small cells that few lines support is shrunk
to that of their ancestors (Polya tree). Time and memory are O(lines x segments), whatever the extent of the scene.

Processes that share the lines (:mod:`l2p.work.shards`) each have samples of their own lines and the density of all.
Mass is summed in integers: unlike floating-point sums these do not depend on the order, so the result does not depend
on the number of processes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from l2p.attacks.structure import NO_STRUCTURE, Structure
from l2p.attacks.tomography.octree import Cells, children, interpolate, root, smooth, total
from l2p.attacks.tomography.posterior import Posterior
from l2p.geometry.elements import Lines, picked
from l2p.work.work import ALONE, Work

#: Most line samples per block, and bytes of temporaries per sample.
SAMPLES, _SAMPLE_BYTES = 1 << 20, 60
#: Peak bytes per line: samples, and up to one cell per sample (measured by ``benchmarks/recover.py``).
LINE_BYTES = 8200
#: Mass of a cell below which it counts as empty.
EMPTY = 1e-12
#: Unit of mass in the integer sums: far below the rounding of the summands, and a power of two, so that nothing else
#: is rounded. The sums hold 2^28 lines.
_GRAIN = 2.0**-34
#: Half the side of the box of lines through centres, over the largest distance of two centres, which are the means of
#: two halves of the points; and the density before the first update, (1 + (distance / core)^2)^-fall from their middle.
#: The weight r^2 would fill a larger box, or an even one, at its far end (``docs/experiments.md``, "Rays").
_REACH, _CORE, _FALL = 1.25, 0.5, 3.0
#: Number of cells above which refinement stops: eight times as many would overflow int32.
MOST_CELLS = (1 << 28) - 2


@dataclass(frozen=True)
class TomographyConfig:
    """Settings of the reconstruction; defaults were chosen on training scenes (``docs/experiments.md``).

    Attributes
    ----------
    start : int
        Cells along each side of the box at the first level.
    levels : int
        Most levels; each halves the side of the cells.
    segments : int
        Segments per line that are kept from level to level.
    iterations : int
        EM updates per level; few, since more of them amplify noise (early stopping).
    smoothing : float
        Fraction of a cell's mass that moves to each of its two neighbours along each axis after an update, below 1/3.
    shrinkage : float
        Mass of the prior per parent, added to that of the lines in its children.
    quantile, margin : float
        Half the side of the box is this quantile of the lines' distances from their centre, times the margin.
    crowd : float
        Stop refining when the mean mass of a cell, weighted by mass, is below this.
    """

    start: int = 16
    levels: int = 9
    segments: int = 32
    iterations: int = 4
    smoothing: float = 0.2
    shrinkage: float = 0.7
    quantile: float = 0.97
    margin: float = 2.0
    crowd: float = 0.15


class _Level(NamedTuple):
    """One resolution: its cells after all their ancestors, coarsest first, and each line's samples in the finest.

    ``shape`` is the prior's fraction of each cell in its parent, for each family of lines; ``cell`` is the row of each
    sample's cell, or the number of cells for a sample outside the box. Cells are of all lines, samples of the lines of
    this process. ``depth2`` is the squared distance of the samples from their line's centre, if there are centres.
    """

    cells: list[Cells]
    shape: list[Float[Tensor, "families _"]]
    cell: Int[Tensor, "lines m"]
    beta: Float[Tensor, "lines m"]
    structure: Structure
    depth2: Float[Tensor, "lines m"] | None

    @property
    def families(self) -> int:
        """Number of densities: that of each family of lines, or of all lines."""
        return self.structure.families


def reconstruct(
    lines: Lines, config: TomographyConfig | None = None, work: Work = ALONE, structure: Structure = NO_STRUCTURE
) -> Posterior:
    """Compute the posterior of each line's point, by expectation maximisation from coarse to fine.

    Parameters
    ----------
    lines : Lines
        In the working frame (:class:`l2p.geometry.frame.Frame`), whose axes are those of the grid; any unit.
    work : Work
        The result is for the lines of this process.
    structure : Structure
        What the attack knows of the scheme. Lines through a centre take their density from the other families, times
        r^2. A line through a pair (a, b) has the likelihood lambda(a) lambda(b) |a - b|^2, since the measure of lines
        is |a - b|^2 da db; it is in the map once for each point, and the posterior is the marginal.
    """
    half, level, density = _converged(lines, config or TomographyConfig(), work, structure)
    own = lines.rows(work.own(len(lines.direction)))
    width = 2 * half / level.cells[-1].side
    probability, pair = torch.empty_like(level.beta), None
    for rows in _blocks(level.cell, work):
        probability[rows] = _posterior(level, density, rows)
    if structure.twin is not None:
        probability *= 2
        pair = torch.cat([_pair(level, density, rows) for rows in _blocks(level.cell, work)])
    return Posterior(level.beta, probability, width / own.direction.abs().amax(dim=1), pair)


def _converged(
    lines: Lines, config: TomographyConfig, work: Work = ALONE, structure: Structure = NO_STRUCTURE
) -> tuple[float, _Level, Float[Tensor, "families cells"]]:
    """Half the side of the box, the finest level, and the mass of each of its cells."""
    half, own = _half_side(lines, config, structure), work.own(len(lines.direction))
    lines, structure = lines.rows(own), structure.own(own)
    level = _first_level(lines, half, config.start, work, structure)
    density = _first_density(structure, half, config.start, level.beta)
    with work.task("tomography", total=config.levels * config.iterations) as advance:
        for depth in range(config.levels):
            if depth > 0:
                level = _refined(lines, half, level, density, config.segments, work)
                density = density.index_select(1, level.cells[-1].parent) * level.shape[-1]
            for _ in range(config.iterations):
                density = _update(level, density, config, work)
                advance(1)
            # Other processors may round the sum differently, but all ranks must stop at the same level.
            if float(work.shards.first(_crowd(density))) < config.crowd or density.shape[1] > MOST_CELLS:
                break
    return half, level, density


def _half_side(lines: Lines, config: TomographyConfig, structure: Structure = NO_STRUCTURE) -> float:
    """Half the side of the box."""
    if structure.center is not None and structure.families > 1:
        # Lines through centres amid the points are near the centres, however large the scene is.
        return _REACH * structure.span
    # torch.quantile refuses more than 2^24 values.
    distance = lines.moment.norm(dim=1).sort().values
    half = float(distance[min(len(distance) - 1, int(config.quantile * len(distance)))]) * config.margin
    return half if half > 0 else 1.0


def _first_density(structure: Structure, half: float, side: int, like: Tensor) -> Float[Tensor, "families cells"]:
    """Density before the first update: even, or, with the weight r^2 of lines through centres, around the centres."""
    density = like.new_ones(structure.families, side**3)
    if structure.center is None or structure.families == 1:
        return density
    middle = (torch.arange(side, device=like.device) + 0.5) * (2 * half / side) - half
    place = torch.stack(torch.meshgrid(middle, middle, middle, indexing="ij"), dim=-1).view(-1, 3)
    away2 = (place - structure.center.mean(dim=0)).square().sum(dim=1) / (_CORE * structure.span) ** 2
    return density * (1 + away2) ** -_FALL


def _first_level(
    lines: Lines, half: float, side: int, work: Work = ALONE, structure: Structure = NO_STRUCTURE
) -> _Level:
    """Make all cells of the box; samples are where a line crosses the mid-planes of slabs along its dominant axis."""
    axis = lines.direction.abs().argmax(dim=1, keepdim=True)
    plane = (torch.arange(side, device=axis.device) + 0.5) * (2 * half / side) - half
    beta = (plane - lines.foot.gather(1, axis)) / lines.direction.gather(1, axis)
    cell = torch.empty_like(beta, dtype=torch.int32)
    for rows in _blocks(beta, work):
        place = _places(lines.rows(rows), half, side, beta[rows])
        inside = ((place >= 0) & (place < side)).all(dim=0)
        i, j, k = place.clamp(0, side - 1)
        cell[rows] = ((i * side + j) * side + k).masked_fill(~inside, side**3).int()
    shape = [beta.new_ones(structure.families, 0)]
    return _Level([root(side, beta.device)], shape, cell, beta, structure, structure.depth2(lines, beta))


def _refined(
    lines: Lines, half: float, level: _Level, density: Float[Tensor, "families cells"], segments: int, work: Work
) -> _Level:
    """Halve the most probable segments of each line, and the cells that they cross."""
    keep = min(segments, level.cell.shape[1])
    above = level.cells[-1]
    quarter = (half / above.side / 2) / lines.direction.abs().amax(dim=1, keepdim=True)
    beta = level.beta.new_empty(len(level.beta), 2 * keep)
    code = torch.empty_like(beta, dtype=torch.int32)
    for rows in _blocks(level.cell, work):
        # Sorted along the line, whatever the order of equal values.
        best = torch.topk(_posterior(level, density, rows), keep, dim=1, sorted=False).indices.sort(dim=1).values
        middle = level.beta[rows].gather(1, best)
        beta[rows] = torch.stack([middle - quarter[rows], middle + quarter[rows]], dim=2).flatten(1)
        parent = level.cell[rows].gather(1, best).repeat_interleave(2, dim=1)
        place = _places(lines.rows(rows), half, 2 * above.side, beta[rows])
        code[rows] = above.octants(parent.flatten(), place.flatten(1)).view(parent.shape)
    cells, row = children(above, code, work.fitting(SAMPLES, _SAMPLE_BYTES), work.shards)
    inherited = density.index_select(1, cells.parent)
    shape = torch.stack([interpolate(each / 8, cells) for each in inherited]) / inherited.clamp_min(EMPTY)
    structure, ancestors = level.structure, [*level.cells[:-1], above.without_neighbors()]
    return _Level([*ancestors, cells], [*level.shape, shape], row, beta, structure, structure.depth2(lines, beta))


def _places(lines: Lines, half: float, side: int, beta: Float[Tensor, "lines m"]) -> Int[Tensor, "3 lines m"]:
    """Cell indices of samples along the three axes."""
    foot = lines.foot
    place = [foot[:, axis, None] + beta * lines.direction[:, axis, None] for axis in range(3)]
    # Far samples of the first level must not overflow.
    return torch.stack([((x + half) * (side / (2 * half))).floor().clamp(-2, side + 1).int() for x in place])


def _update(
    level: _Level, density: Float[Tensor, "families cells"], config: TomographyConfig, work: Work = ALONE
) -> Float[Tensor, "families cells"]:
    """Do one EM update: forward projection, back projection, then the prior."""
    updated = []
    for number, mass in enumerate(_back_projection(level, density, work)):
        shape = [each[number] for each in level.shape]
        smoothed = smooth(mass, level.cells[-1], config.smoothing)
        updated.append(_shrink(smoothed, level.cells, shape, config.shrinkage))
    return torch.stack(updated)


def _back_projection(
    level: _Level, density: Float[Tensor, "families cells"], work: Work = ALONE
) -> Float[Tensor, "families cells"]:
    """Sum the mass that the lines of each family spread, in any order: MLEM with a sensitivity of 1."""
    # Apple's GPUs cannot sum 64-bit integers.
    whole = density.dtype if density.device.type == "mps" else torch.int64
    families, cells = density.shape
    mass = torch.zeros(families * (cells + 1), dtype=whole, device=density.device)
    for rows in _blocks(level.cell, work):
        spread = (_posterior(level, density, rows) / _GRAIN).to(whole)
        place = level.cell[rows].long()
        if level.structure.family is not None:
            place += (cells + 1) * level.structure.family[rows, None]
        mass.scatter_add_(0, place.flatten(), spread.flatten())
    work.shards.sum(mass)
    return mass.view(families, -1)[:, :-1].to(density.dtype) * _GRAIN


def _posterior(level: _Level, density: Float[Tensor, "families cells"], rows: slice) -> Float[Tensor, "rows m"]:
    """Probability of each sample of the lines: the density there over the line's forward projection."""
    along = _along(level, density, rows)
    if level.structure.twin is not None:
        along = along * _of_partner(along, level.beta[rows])
    projection = along.sum(dim=1, keepdim=True)
    return along / projection.clamp_min(torch.finfo(along.dtype).tiny)


def _of_partner(along: Float[Tensor, "rows m"], beta: Float[Tensor, "rows m"]) -> Float[Tensor, "rows m"]:
    """Sum over the partner's position b of lambda(b) |a - b|^2, at each position a: a quadratic polynomial of a."""
    share = along / along.sum(dim=1, keepdim=True).clamp_min(torch.finfo(along.dtype).tiny)
    middle = (share * beta).sum(dim=1, keepdim=True)
    apart2 = (beta - middle).square()
    return apart2 + (share * apart2).sum(dim=1, keepdim=True)


def _pair(level: _Level, density: Float[Tensor, "families cells"], rows: slice) -> Float[Tensor, "rows 2"]:
    """Positions a < b of greatest lambda(a) lambda(b) |a - b|^2; of equal ones the first."""
    along, beta = _along(level, density, rows), level.beta[rows]
    best, first, second = (beta.new_full((len(beta),), value) for value in (-1.0, 0.0, 0.0))
    for shift in range(1, beta.shape[1]):
        gain = along[:, :-shift] * along[:, shift:] * (beta[:, :-shift] - beta[:, shift:]).square()
        most, place = gain.max(dim=1, keepdim=True)
        better = most[:, 0] > best
        best = torch.where(better, most[:, 0], best)
        first = torch.where(better, beta.gather(1, place)[:, 0], first)
        second = torch.where(better, beta.gather(1, place + shift)[:, 0], second)
    return torch.stack([first, second], dim=1)


def _along(level: _Level, density: Float[Tensor, "families cells"], rows: slice) -> Float[Tensor, "rows m"]:
    """Density at each sample: of all lines, or of the other families, times r^2."""
    cell, structure = level.cell[rows], level.structure
    if structure.family is None or level.depth2 is None:
        return picked(_padded(density[0]), cell)
    others = torch.stack([_padded(density.sum(dim=0) - own) for own in density])
    place = cell + others.shape[1] * structure.family[rows, None]
    return picked(others.flatten(), place) * level.depth2[rows]


def _padded(density: Float[Tensor, " cells"]) -> Float[Tensor, " cells_and_outside"]:
    """Append 0 to the density of the cells, for samples outside the box."""
    return torch.cat([density, density.new_zeros(1)])


def _shrink(
    mass: Float[Tensor, " cells"], cells: list[Cells], shape: list[Float[Tensor, " _"]], strength: float
) -> Float[Tensor, " cells"]:
    """Shrink by a Polya tree: divide each parent's shrunk mass among its children by their mass plus the prior's.

    The prior has mass ``strength`` per parent, and the shape of the interpolated density of the level before.
    """
    if len(cells) == 1 or strength == 0:
        return mass
    parent = cells[-1].parent
    parents = total(mass, cells[-1], cells[-2])
    gain = _shrink(parents, cells[:-1], shape[:-1], strength) / (parents + strength)
    return gain.index_select(0, parent) * (mass + strength * shape[-1])


def _crowd(density: Float[Tensor, "families cells"]) -> Float[Tensor, ""]:
    """Mean mass of a cell, weighted by mass."""
    return density.square().sum() / density.sum().clamp_min(torch.finfo(density.dtype).tiny)


def _blocks(samples: Shaped[Tensor, "lines m"], work: Work) -> Iterator[slice]:
    """Slices of lines, each with at most about ``SAMPLES`` samples."""
    lines, each = samples.shape
    rows = max(1, work.fitting(SAMPLES, _SAMPLE_BYTES) // max(each, 1))
    for begin in range(0, lines, rows):
        yield slice(begin, min(begin + rows, lines))
