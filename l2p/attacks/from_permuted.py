"""Recovery of permuted coordinates: which coordinate of a stored point is not its own, and what its own is.

A stored point keeps two coordinates, so the true point is on one of the three axis-parallel lines through it. If its
coordinate along axis a is not its own, the stored value is that of a random other point: the likelihood of the axis is
the share of points with such a value. Expectation maximisation over the cells of the three lines
(:mod:`l2p.attacks.density_grid`) gives the density of the points, and each point is where most of its mass is.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.alike import Classes, appearances_of, classes_of, most_alike_of
from l2p.attacks.density_grid import finer, flat, maximised, share
from l2p.errors import InputError
from l2p.maps.permuted import PermutedCloud
from l2p.maps.recovery import Recovery
from l2p.work.progress import NO_PROGRESS, Progress

#: Points per block.
_BLOCK = 1024
#: Share of the values of an axis that lie beyond each end of the grid, and the margin of the grid.
_BEYOND, _MARGIN = 0.005, 0.02


@dataclass(frozen=True)
class PermutedConfig:
    """Settings of the attack on permuted coordinates.

    Attributes
    ----------
    side : int
        Cells along each axis at first; twice as many later, and without appearances four times as many in the end (a
        grid for each class of appearance would take too long).
    steps : int
        Steps of expectation maximisation at each resolution.
    classes : int
        Classes of appearance.
    strength : float
        Power of the likelihood ratio of two appearances.
    window : int
        Length, in cells, of the piece of a line whose mass is maximised and is the confidence.
    nearest : int
        Neighbours by likeness whose stored coordinates vote in the baseline; 0: no baseline.
    """

    side: int = 32
    steps: int = 8
    classes: int = 16
    strength: float = 2.0
    window: int = 3
    nearest: int = 0

    def __post_init__(self) -> None:
        if min(self.side, self.steps, self.classes, self.window) < 1 or self.window % 2 == 0 or self.nearest < 0:
            raise InputError(f"got {self}; expected positive numbers and an odd window")


class Box(NamedTuple):
    """The grid: its lowest corner and its extent, scene units."""

    low: Float[np.ndarray, "3"]
    extent: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, xyz: Float[np.ndarray, "points 3"]) -> Box:
        """The box of most stored values; each axis has its own extent."""
        low, high = np.quantile(xyz, (_BEYOND, 1 - _BEYOND), axis=0)
        extent = high - low
        extent = np.where(extent > 0, extent, extent.max() or 1.0)
        return cls(low - _MARGIN * extent, (1 + 2 * _MARGIN) * extent)

    def bins(self, xyz: Float[np.ndarray, "points 3"], side: int) -> Int[Tensor, "points 3"]:
        """Bin of each coordinate; those beyond the box are in its outermost bins."""
        return torch.as_tensor(np.clip((xyz - self.low) / self.extent * side, 0, side - 1).astype(np.int64))


def recover_permuted(
    cloud: PermutedCloud, config: PermutedConfig | None = None, progress: Progress = NO_PROGRESS
) -> Recovery:
    """Recover one point per stored point.

    Parameters
    ----------
    cloud : PermutedCloud
    config : PermutedConfig, optional
    progress : Progress

    Returns
    -------
    Recovery
        In the order of the stored points, each with two of its coordinates; ``beta`` is 0. The confidence, which only
        ranks, is the mass of the piece of line around the point.

    Raises
    ------
    InputError
        If there are fewer than two points, or the baseline has no appearances.
    """
    config, began = config or PermutedConfig(), time.perf_counter()
    if len(cloud) < 2:
        raise InputError(f"got {len(cloud)} stored point(s); expected at least two, as they swap in pairs")
    appearances = appearances_of(cloud.appearance)
    with torch.inference_mode():
        if config.nearest:
            if appearances is None:
                raise InputError("got the baseline for a map without appearances; expected colours or descriptors")
            xyz, confidence = voted(cloud.xyz, most_alike_of(appearances, config.nearest).numpy())
        else:
            classes = classes_of(appearances, len(cloud), config.classes, config.strength)
            xyz, confidence = _densest(cloud.xyz, classes, config, progress)
    info = {
        "method": "vote of the points most alike" if config.nearest else "density of permuted points",
        "settings": asdict(config),
        "used": [] if appearances is None else list(appearances.of),
        "device": "cpu",
        "seconds": time.perf_counter() - began,
    }
    return Recovery(xyz, confidence.astype(np.float32), np.zeros(len(cloud)), rgb=cloud.rgb, info=info)


def line_cells(bins: Int[Tensor, "rows 3"], side: int) -> Int[Tensor, "rows cells"]:
    """Cells of the three axis-parallel lines through each point, side * axis + bin along it, flat in the grid."""
    stride = torch.tensor([side * side, side, 1])
    own = bins * stride
    rest = own.sum(dim=1, keepdim=True) - own
    return (rest[:, :, None] + stride[:, None] * torch.arange(side)).flatten(1)


def axis_weights(bins: Int[Tensor, "points 3"], side: int) -> Float[Tensor, "points 3"]:
    """Share of the points with a value in the bin of each stored coordinate: the likelihood that it was swapped in."""
    counts = torch.stack([torch.bincount(bins[:, axis], minlength=side) for axis in range(3)])
    return torch.stack([counts[axis][bins[:, axis]] for axis in range(3)], dim=1) / len(bins)


def _densest(
    stored: Float[np.ndarray, "points 3"], classes: Classes, config: PermutedConfig, progress: Progress
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " points"]]:
    """The centre of mass of the window of most mass on the three lines of each point, and that mass."""
    box, side, count = Box.of(stored), config.side, len(stored)
    density, bins = flat(classes, side), box.bins(stored, side)
    levels = 3 if len(classes.ratio) == 1 else 2
    with progress.task("density of permuted points", levels * config.steps * count) as advance:
        for level in range(levels):
            if level:
                density, side = finer(density, side, 2), 2 * side
            bins = box.bins(stored, side)
            weight = axis_weights(bins, side)

            spread = partial(_spread, bins, weight, side, advance)
            for _ in range(config.steps):
                density = maximised(density, classes, side, spread)
    xyz, confidence = stored.copy(), np.zeros(count)
    weight, half = axis_weights(bins, side), config.window // 2
    for begin in range(0, count, _BLOCK):
        rows = slice(begin, min(begin + _BLOCK, count))
        spread_weight = weight[rows].repeat_interleave(side, dim=1)
        mass = share(density, classes.label[rows], line_cells(bins[rows], side), spread_weight)[1]
        lines = torch.nn.functional.pad(mass.view(-1, 3, side), (half, half)).unfold(2, config.window, 1)
        window = lines.sum(dim=3)
        most, place = window.flatten(1).max(dim=1)
        axis, middle = place // side, place % side
        own = torch.arange(len(place))
        step = torch.arange(-half, half + 1)
        moved = (lines[own, axis, middle] * step).sum(dim=1) / most.clamp_min(1e-30)
        value = (middle + 0.5 + moved).double().numpy() / side
        along = axis.numpy()
        xyz[np.arange(rows.start, rows.stop), along] = box.low[along] + box.extent[along] * value
        confidence[rows] = most.clamp(0, 1).numpy()
    return xyz, confidence


def _spread(
    bins: Int[Tensor, "points 3"], weight: Float[Tensor, "points 3"], side: int, advance: Callable[[int], None]
) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """The cells of the lines of all points, in blocks."""
    for begin in range(0, len(bins), _BLOCK):
        rows = slice(begin, min(begin + _BLOCK, len(bins)))
        yield rows, line_cells(bins[rows], side), weight[rows].repeat_interleave(side, dim=1)
        advance(rows.stop - rows.start)


def voted(
    stored: Float[np.ndarray, "points 3"], others: Int[np.ndarray, "points k"]
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " points"]]:
    """The baseline: stored points of the elements most alike vote for the coordinate that is not a point's own.

    Each of them keeps two coordinates. For each axis, those within a twentieth of the box in the other two coordinates
    vote with 1, in one of them with 1/2; the densest place of their values wins, and the axis of most votes there.
    """
    extent = Box.of(stored).extent
    xyz, confidence = stored.copy(), np.zeros(len(stored))
    for begin in range(0, len(stored), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        near = stored[others[rows]] / extent
        close = np.exp(-0.5 * ((near - stored[rows, None] / extent) / 0.05) ** 2)
        best = np.full(len(near), -1.0)
        for axis in range(3):
            one, two = (close[:, :, each] for each in range(3) if each != axis)
            vote = one * two + 0.25 * (one + two)
            apart = near[:, :, None, axis] - near[:, None, :, axis]
            votes = (np.exp(-0.5 * (apart / 0.03) ** 2) * vote[:, None]).sum(axis=2)
            place = votes.argmax(axis=1)
            own = np.arange(len(near))
            better = votes[own, place] > best
            best = np.where(better, votes[own, place], best)
            block = stored[rows].copy() if axis == 0 else xyz[rows]
            moved = stored[rows].copy()
            moved[:, axis] = near[own, place, axis] * extent[axis]
            xyz[rows] = np.where(better[:, None], moved, block)
        confidence[rows] = best / (best + 1)
    return xyz, confidence
