"""Nodes: the data of every line before a round, from its estimate and the estimates around it.

Neighbours of an estimate give its *local scale*, the distance to the ``scale``-th neighbour, and two surfaces through
them, a near and a wide one (:mod:`l2p.geometry.local_planes`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.errors import InputError
from l2p.geometry.elements import Lines, picked
from l2p.geometry.local_planes import Surface, SurfaceConfig, fitted
from l2p.work.work import ALONE, Work

if TYPE_CHECKING:
    from scipy.spatial import KDTree

#: Most estimates per block.
_BLOCK = 1 << 10
#: Bytes of temporaries per estimate and neighbour of its wide surface.
_NEIGHBOR_BYTES = 160


@dataclass(frozen=True)
class NodesConfig:
    """Settings of the neighbourhoods of estimates.

    Attributes
    ----------
    scale : int
        Neighbours that give the local scale and the near surface.
    wide : int
        Neighbours that give the wide surface: smoother than the scene, but the errors of more estimates average out.
    shared : int
        The wide surface is fitted at every ``shared``-th estimate only, and used by the nearest others: it varies
        slowly, and is the most expensive part of a round.
    surface : SurfaceConfig
        Fit of both surfaces.
    """

    scale: int = 16
    wide: int = 96
    shared: int = 2
    surface: SurfaceConfig = SurfaceConfig()

    def __post_init__(self) -> None:
        for name in ("scale", "wide", "shared"):
            if getattr(self, name) < 1:
                raise InputError(f"got nodes.{name} {getattr(self, name)}; expected at least 1")


class Estimates(NamedTuple):
    """State carried from one round to the next, of all lines; ``Nodes`` follow from it.

    ``confidence`` is uncalibrated; ``state`` is passed by the network to the lines around.
    """

    beta: Float[Tensor, " lines"]
    confidence: Float[Tensor, " lines"]
    state: Float[Tensor, "lines state"]


class Nodes(NamedTuple):
    """Data of every line before a round.

    ``scale``, ``surface``, ``wide`` and ``crowd`` (mean confidence) describe the estimates around a line's own;
    ``typical`` is the median of all scales.
    """

    beta: Float[Tensor, " lines"]
    point: Float[Tensor, "lines 3"]
    scale: Float[Tensor, " lines"]
    surface: Surface
    wide: Surface
    crowd: Float[Tensor, " lines"]
    confidence: Float[Tensor, " lines"]
    state: Float[Tensor, "lines state"]
    typical: Float[Tensor, ""]


class Neighborhood(NamedTuple):
    """Neighbours of the estimates.

    ``tree`` holds all estimates, ``point``; ``near`` holds those nearest to the estimate of each of this process's
    lines; ``scale`` is the local scale of all.
    """

    tree: KDTree
    point: Float[Tensor, "lines 3"]
    near: Int[Tensor, "own near"]
    scale: Float[Tensor, " lines"]


def nodes_of(lines: Lines, estimates: Estimates, config: NodesConfig, work: Work = ALONE) -> Nodes:
    """Build the nodes of all lines; O(lines log lines). Each process computes its own lines and gathers the others."""
    return described(lines, neighborhood(lines, estimates.beta, config, work), estimates, config, work)


def neighborhood(lines: Lines, beta: Float[Tensor, " lines"], config: NodesConfig, work: Work = ALONE) -> Neighborhood:
    """Find the neighbours of every estimate, which give its local scale."""
    from scipy.spatial import KDTree

    point = lines.at(beta)
    # On the CPU: other devices have no k-d trees, are slow at many small matrices, or lack double precision.
    place = point.cpu().double().numpy()
    tree = KDTree(place)
    own = place[work.own(len(place))]
    k = min(config.scale + 1, len(place))

    def near(block: slice, _: Work) -> tuple[Tensor, Tensor]:
        distance, index = _queried(tree, own[block], k)
        return index.int(), distance[:, -1].to(beta.dtype)

    index, reach = _over_rows(near, len(own), config, work)
    return Neighborhood(tree, point, index, _floored(work.gather(reach.to(beta.device), len(place))))


def described(
    lines: Lines, around: Neighborhood, estimates: Estimates, config: NodesConfig, work: Work = ALONE
) -> Nodes:
    """Build the nodes from the neighbours of the estimates: surfaces and crowd."""
    from scipy.spatial import KDTree

    point, direction, confidence = around.point.cpu(), lines.direction.cpu(), estimates.confidence.cpu()
    place = around.tree.data
    count = len(place)
    # Wide surfaces are fitted at every ``shared``-th estimate, the leaders; the others use that of the nearest leader.
    leaders = place[:: config.shared]
    own_leaders, own = leaders[work.own(len(leaders))], place[work.own(count)]

    def fit(near: Int[Tensor, "rows k"]) -> Surface:
        return fitted(picked(point, near), picked(direction, near), picked(confidence, near), config.surface)

    def of_own(block: slice, _: Work) -> tuple[Tensor, ...]:
        near = around.near[block].long()
        return picked(confidence, near).mean(dim=1), *fit(near)

    def of_leaders(block: slice, _: Work) -> tuple[Tensor, ...]:
        return tuple(fit(_queried(around.tree, own_leaders[block], min(config.wide + 1, count))[1]))

    guide = KDTree(leaders)

    def leader(block: slice, _: Work) -> tuple[Tensor, ...]:
        return (_queried(guide, own[block], 1)[1].int()[:, 0],)

    def gathered(columns: Sequence[Tensor], count: int) -> list[Tensor]:
        return [work.gather(column.to(estimates.beta.device), count) for column in columns]

    crowd, *surface = gathered(_over_rows(of_own, len(own), config, work), count)
    wide = Surface(*gathered(_over_rows(of_leaders, len(own_leaders), config, work), len(leaders)))
    (nearest,) = gathered(_over_rows(leader, len(own), config, work), count)
    return Nodes(
        beta=estimates.beta,
        point=around.point,
        scale=around.scale,
        surface=Surface(*surface),
        wide=Surface(*(column.index_select(0, nearest) for column in wide)),
        crowd=crowd,
        confidence=estimates.confidence,
        state=estimates.state,
        typical=around.scale.median(),
    )


def _queried(
    tree: KDTree, places: Float[np.ndarray, "rows 3"], k: int
) -> tuple[Float[Tensor, "rows k"], Int[Tensor, "rows k"]]:
    """Distances and indices of the k points of a tree nearest to each place."""
    distance, index = tree.query(places, k)
    # SciPy drops the axis of k = 1.
    return torch.as_tensor(distance).view(-1, k), torch.as_tensor(index).view(-1, k)


def _over_rows(
    function: Callable[[slice, Work], tuple[Tensor, ...]], count: int, config: NodesConfig, work: Work
) -> list[Tensor]:
    """Compute columns of results block by block."""
    blocks = work.over_blocks(function, count, _BLOCK, row_bytes=_NEIGHBOR_BYTES * config.wide)
    results = [result for _, result in blocks] or [function(slice(0), work)]
    return [torch.cat(columns) for columns in zip(*results, strict=True)]


def _floored(reach: Float[Tensor, " lines"]) -> Float[Tensor, " lines"]:
    """Raise the scale of coinciding estimates, 0, to a small fraction of the typical scale."""
    apart = reach[reach > 0]
    return reach.clamp_min(1e-3 * apart.median() if len(apart) else 1.0)
