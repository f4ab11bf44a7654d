"""Tomography: a density from the lines alone, and the most likely place of each line's point in it.

A uniform line cloud is a list-mode emission data set without time of flight: one event per point, all directions
equally likely. The density lambda follows by expectation maximisation (list-mode MLEM, Shepp & Vardi 1982): each line
spreads one unit of mass over the cells that it crosses in proportion to lambda (forward projection), and lambda
becomes the sum of what the lines spread (back projection). A point anywhere is seen by exactly one line, so the
sensitivity is 1 everywhere and drops out; so does the length of a line inside a cell, which is the same for all
samples of a line.

Resolution follows the data: the grid is sparse and its cells are halved level by level along each line, keeping only
the segments with the most posterior mass; the density of small cells that few lines support is shrunk to that of
their ancestors (Polya tree). Time and memory are O(lines x segments), whatever the extent of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.geometry import Lines
from l2p.progress import NO_PROGRESS, Progress

#: Line samples in one block of work (times about 40 bytes of temporaries).
SAMPLES = 1 << 22
#: Exchange between neighbours that turns the even spreading of a parent's mass into trilinear interpolation.
TRILINEAR = 0.25


@dataclass(frozen=True)
class TomographyConfig:
    """Settings of the reconstruction.

    Attributes
    ----------
    start : int
        Cells along each side of the box at the first level, a power of two.
    levels : int
        Most levels, each with cells of half the side.
    segments : int
        Segments of each line that are kept from level to level.
    iterations : int
        EM updates at each level. Few: more of them sharpen noise (early stopping).
    smoothing : float
        Share of a cell's mass that moves to each of its two neighbours along each axis after an update, below 1/3.
    shrinkage : float
        Mass of the prior, a parent's density spread evenly, against that of the lines in the children.
    quantile, margin : float
        The half side of the box is this quantile of the lines' distances from their centre, times the margin.
    crowd : float
        Stop refining when cells hold less mass than this, averaged over the mass.
    """

    start: int = 32
    levels: int = 8
    segments: int = 48
    iterations: int = 4
    smoothing: float = 0.2
    shrinkage: float = 1.0
    quantile: float = 0.97
    margin: float = 1.0
    crowd: float = 0.15


class Posterior(NamedTuple):
    """Where on each line its point may be: samples along it and their probabilities, which sum to 1.

    A line that misses the box has probability 0 everywhere. ``step`` is the distance of neighbouring samples on the
    line, ``log_density`` the logarithm of the mass per unit volume at the samples.
    """

    beta: Float[Tensor, "lines m"]
    probability: Float[Tensor, "lines m"]
    log_density: Float[Tensor, "lines m"]
    step: Float[Tensor, " lines"]


class _Cells(NamedTuple):
    """The cells of one resolution that some line still crosses.

    ``key`` is (i side + j) side + k, sorted. ``adjacent`` holds, for each axis, the rows of the pairs of cells that
    share a face; ``parent`` the row of each cell in the next coarser level (empty at the coarsest).
    """

    side: int
    key: Int[Tensor, " cells"]
    adjacent: list[tuple[Int[Tensor, " pairs"], Int[Tensor, " pairs"]]]
    parent: Int[Tensor, " cells"]


class _Level(NamedTuple):
    """One resolution: its cells and all their ancestors, finest first, and each line's samples in the finest.

    ``cell`` is the row of each sample's cell, the number of cells for a sample outside the box.
    """

    cells: list[_Cells]
    cell: Int[Tensor, "lines m"]
    beta: Float[Tensor, "lines m"]

    @property
    def side(self) -> int:
        return self.cells[0].side


def reconstruct(lines: Lines, config: TomographyConfig | None = None, progress: Progress = NO_PROGRESS) -> Posterior:
    """The posterior of each line's point, by expectation maximisation from coarse to fine.

    Parameters
    ----------
    lines : Lines
        In the working frame (centred; the unit does not matter).
    """
    config = config or TomographyConfig()
    lines = _upright(lines)
    distance = lines.moment.norm(dim=1)
    half = float(_quantile(distance, config.quantile)) * config.margin
    half = half if half > 0 else 1.0
    beta = _first_samples(lines, half, config.start)
    level: _Level | None = None
    density = None
    with progress.task("tomography", total=config.levels * config.iterations) as advance:
        for depth in range(config.levels):
            side = config.start << depth
            before, level = level, _level(lines, half, side, beta, depth)
            density = _inherited(level, before, density)
            for _ in range(config.iterations):
                density = _update(level, density, config)
                advance(1)
            if depth == config.levels - 1 or _crowd(density) < config.crowd:
                break
            beta = _split(lines, half, side, level, density, config.segments)
    assert level is not None and density is not None
    probability = _posterior(level, density, slice(0, len(level.cell)))
    step = (2 * half / level.side) / lines.direction.abs().amax(dim=1)
    volume = (2 * half / level.side) ** 3
    log_density = torch.log(_padded(density)[level.cell] / volume + 1e-12)
    return Posterior(level.beta, probability, log_density, step)


def _upright(lines: Lines) -> Lines:
    """The lines in axes of their own, so that the grid turns with the scene.

    Principal axes of the feet, far ones damped; each points to where the feet are skewed. The positions along the
    lines are the same in both frames.
    """
    foot = lines.foot.double()
    foot = foot / (1 + foot.square().sum(dim=1, keepdim=True)).sqrt()
    axes = torch.linalg.eigh(foot.T @ foot).eigenvectors
    skew = (foot @ axes).pow(3).sum(dim=0)
    axes = axes * torch.where(skew < 0, -1.0, 1.0)
    # A mirror image of the lines would have another moment; keep the axes right-handed.
    axes[:, 2] *= torch.linalg.det(axes).sign()
    axes = axes.to(lines.direction.dtype)
    return Lines(lines.direction @ axes, lines.moment @ axes)


def _quantile(values: Float[Tensor, " lines"], share: float) -> Float[Tensor, ""]:
    # torch.quantile refuses more than 2^24 values.
    rank = min(len(values) - 1, int(share * len(values)))
    return values.sort().values[rank]


def _first_samples(lines: Lines, half: float, side: int) -> Float[Tensor, "lines m"]:
    """Where each line crosses the middle planes of the slabs of cells along its dominant axis."""
    axis = lines.direction.abs().argmax(dim=1, keepdim=True)
    plane = (torch.arange(side, device=axis.device) + 0.5) * (2 * half / side) - half
    return (plane - lines.foot.gather(1, axis)) / lines.direction.gather(1, axis)


def _keys(lines: Lines, half: float, side: int, beta: Float[Tensor, "lines m"]) -> Int[Tensor, "lines m"]:
    """The cell of each sample as one integer, (i side + j) side + k; -1 outside the box."""
    key = torch.zeros_like(beta, dtype=torch.int64)
    inside = torch.ones_like(beta, dtype=torch.bool)
    foot = lines.foot
    for axis in range(3):
        place = foot[:, axis, None] + beta * lines.direction[:, axis, None]
        index = ((place + half) * (side / (2 * half))).floor()
        inside &= (index >= 0) & (index < side)
        key = key * side + index.nan_to_num(0, 0, 0).clamp(0, side - 1).long()
    return key.masked_fill(~inside, -1)


def _level(lines: Lines, half: float, side: int, beta: Float[Tensor, "lines m"], depth: int) -> _Level:
    found = [torch.empty(0, dtype=torch.int64, device=beta.device)]
    for rows in _blocks(*beta.shape):
        found.append(_keys(lines.rows(rows), half, side, beta[rows]).unique())
    key = torch.cat(found).unique()
    key = key[key >= 0]
    cell = torch.empty(beta.shape, dtype=torch.int32, device=beta.device)
    for rows in _blocks(*beta.shape):
        own = _keys(lines.rows(rows), half, side, beta[rows])
        cell[rows] = torch.searchsorted(key, own).masked_fill(own < 0, len(key)).int()
    return _Level(_pyramid(key, side, depth), cell, beta)


def _pyramid(key: Int[Tensor, " cells"], side: int, depth: int) -> list[_Cells]:
    """The cells and, level by level, their ancestors."""
    levels = []
    for _ in range(depth):
        above, parent = _parent(key, side).unique(return_inverse=True)
        levels.append(_Cells(side, key, _adjacent(key, side), parent))
        key, side = above, side // 2
    return [*levels, _Cells(side, key, _adjacent(key, side), key[:0])]


def _parent(key: Int[Tensor, " cells"], side: int) -> Int[Tensor, " cells"]:
    i, j, k = key // (side * side), key // side % side, key % side
    return (i // 2 * (side // 2) + j // 2) * (side // 2) + k // 2


def _adjacent(key: Int[Tensor, " cells"], side: int) -> list[tuple[Int[Tensor, " pairs"], Int[Tensor, " pairs"]]]:
    """Along each axis, the pairs of rows of cells that share a face."""
    pairs = []
    for stride in (side * side, side, 1):
        last = key // stride % side == side - 1
        wanted = key + stride
        row = torch.searchsorted(key, wanted).clamp_max(max(len(key) - 1, 0))
        here = torch.nonzero((key[row] == wanted) & ~last).flatten() if len(key) else row
        pairs.append((here, row[here]))
    return pairs


def _update(level: _Level, density: Float[Tensor, " cells"], config: TomographyConfig) -> Float[Tensor, " cells"]:
    """One EM update: forward projection, back projection, then the prior."""
    mass = torch.zeros(len(density) + 1, device=density.device)
    for rows in _blocks(*level.cell.shape):
        mass.index_add_(0, level.cell[rows].flatten(), _posterior(level, density, rows).flatten())
    return _shrink(_smooth(mass[:-1], level.cells[0], config.smoothing), level.cells, config.shrinkage)


def _posterior(level: _Level, density: Float[Tensor, " cells"], rows: slice) -> Float[Tensor, "rows m"]:
    """Probability of each sample of the lines: the density there over the line's forward projection."""
    along = _padded(density)[level.cell[rows]]
    projection = along.sum(dim=1, keepdim=True)
    return along / projection.clamp_min(torch.finfo(along.dtype).tiny)


def _inherited(
    level: _Level, before: _Level | None, density: Float[Tensor, " parents"] | None
) -> Float[Tensor, " cells"]:
    """The density to start a level with: that of the level before, interpolated; even for the first level."""
    cells = level.cells[0]
    if before is None or density is None:
        return torch.ones(len(cells.key), device=level.beta.device)
    coarse = before.cells[0].key
    parent = _parent(cells.key, cells.side)
    row = torch.searchsorted(coarse, parent).clamp_max(len(coarse) - 1)
    # A half segment may lie in a cell whose parent no sample of the level before fell into.
    known = coarse[row] == parent
    return _interpolate(torch.where(known, density[row], density.mean()) / 8, cells)


def _padded(density: Float[Tensor, " cells"]) -> Float[Tensor, " cells_and_outside"]:
    """Density by row of the cells, and 0 for the row of samples outside the box."""
    return torch.cat([density, density.new_zeros(1)])


def _smooth(mass: Float[Tensor, " cells"], cells: _Cells, share: float) -> Float[Tensor, " cells"]:
    """A kernel of weights (share, 1 - 2 share, share) along each axis.

    What goes to cells that no line crosses is gone: mass that stands alone is worth less than mass among its like.
    """
    for here, there in cells.adjacent:
        blurred = (1 - 2 * share) * mass
        blurred[here] += share * mass[there]
        blurred[there] += share * mass[here]
        mass = blurred
    return mass


def _interpolate(above: Float[Tensor, " cells"], cells: _Cells) -> Float[Tensor, " cells"]:
    """Parents' densities, given evenly spread over their children, made trilinear; the sum stays."""
    for here, there in cells.adjacent:
        flow = TRILINEAR * (above[there] - above[here])
        above = above.clone()
        above[here] += flow
        above[there] -= flow
    return above


def _shrink(mass: Float[Tensor, " cells"], cells: list[_Cells], strength: float) -> Float[Tensor, " cells"]:
    """Polya tree: a parent's own shrunk mass, divided among its children by their mass plus that of the prior.

    The prior has mass ``strength`` in each parent and the shape of the parents' density, interpolated.
    """
    if len(cells) == 1 or strength == 0:
        return mass
    parent = cells[0].parent
    total = mass.new_zeros(len(cells[1].key)).index_add_(0, parent, mass)
    above = _shrink(total, cells[1:], strength)[parent]
    shape = _interpolate(above, cells[0]) / (8 * above).clamp_min(torch.finfo(mass.dtype).tiny)
    return above * (mass + strength * shape) / (total[parent] + strength)


def _crowd(density: Float[Tensor, " cells"]) -> float:
    """Mass of the cell that a unit of mass is in, on average."""
    return float(density.square().sum() / density.sum().clamp_min(torch.finfo(density.dtype).tiny))


def _split(
    lines: Lines, half: float, side: int, level: _Level, density: Float[Tensor, " cells"], segments: int
) -> Float[Tensor, "lines m"]:
    """The most probable segments of each line, each cut in two."""
    keep = min(segments, level.cell.shape[1])
    beta = level.beta.new_empty(len(level.beta), 2 * keep)
    step = (2 * half / side) / lines.direction.abs().amax(dim=1, keepdim=True)
    for rows in _blocks(*level.cell.shape):
        best = torch.topk(_posterior(level, density, rows), keep, dim=1, sorted=False).indices.sort(dim=1).values
        middle = level.beta[rows].gather(1, best)
        beta[rows] = torch.stack([middle - step[rows] / 4, middle + step[rows] / 4], dim=2).flatten(1)
    return beta


def _blocks(lines: int, samples: int) -> Iterator[slice]:
    rows = max(1, SAMPLES // max(samples, 1))
    for begin in range(0, lines, rows):
        yield slice(begin, min(begin + rows, lines))


def modes(posterior: Posterior) -> tuple[Float[Tensor, " lines"], Float[Tensor, " lines"]]:
    """The most probable position on each line and its probability."""
    probability, best = posterior.probability.max(dim=1)
    return posterior.beta.gather(1, best[:, None])[:, 0].masked_fill(probability == 0, 0), probability


def mass_within(
    posterior: Posterior, beta: Float[Tensor, " lines"], radius: float | Float[Tensor, " lines"]
) -> Float[Tensor, " lines"]:
    """Posterior probability that a line's point lies within ``radius`` of ``beta``: how sure the estimate is."""
    reach = torch.as_tensor(radius, device=beta.device, dtype=beta.dtype).expand_as(beta)
    near = (posterior.beta - beta[:, None]).abs() <= reach[:, None]
    return (posterior.probability * near).sum(dim=1).clamp(0, 1)
