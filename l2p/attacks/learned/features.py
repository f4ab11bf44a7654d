"""What a line knows of its candidate neighbours: pairwise numbers that do not change when the scene is moved, turned
or scaled, when lines are reordered, or when a line's origin slides or its direction flips.

Lengths are divided by the local scale of the candidate, the distance of its estimate to the ``SCALE``-th estimate
next to it, so that the dense middle of a scene and its far background look alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l2p.attacks.tomography.posterior import Posterior
from l2p.geometry.elements import Lines, picked
from l2p.geometry.local_planes import Surface, crossing, fitted
from l2p.geometry.pairs import PARALLEL
from l2p.work.shards import ALONE, Shards
from l2p.work.threads import over_blocks

if TYPE_CHECKING:
    from scipy.spatial import KDTree

#: Neighbours of an estimate that give its local scale and its surface.
SCALE = 16
#: Neighbours that give its wide surface: it bends less than things do, but the errors of more estimates cancel out.
WIDE = 96
#: Of so many estimates one has a wide surface of its own: it differs little from one to the next, and takes the time.
_SHARED = 2
#: Numbers that each line hands to the lines around it in the next round.
STATE = 8
#: Where a candidate says that the point is: the closest point to its line, and where the line cuts the two surfaces
#: around its estimate.
VOTES = ("closest", "cut", "wide_cut")
_OFF, _SHAPE = ("foot_off_plane", "closest_off_plane", "own_off_plane"), ("incidence", "planarity", "linearity")
_WIDE_OFF, _WIDE_SHAPE = (tuple(f"wide_{name}" for name in names) for names in (_OFF, _SHAPE))
#: Names of the edge features, in order: positions on the line and distances over the local scale, then other numbers.
EDGE = (
    *("foot", "closest", "cut", "wide_cut", "gap", "line_line", "point_line", "line_point", "point_point"),
    *(*_OFF, *_WIDE_OFF),
    *("log_scale", "log_scale_ratio", "log_line_line", "log_point_line"),
    *("cosine", "posterior_at_foot", "posterior_at_closest", "confidence", "own_confidence", "crowd"),
    *(*_SHAPE, *_WIDE_SHAPE),
)
#: The edge features by what they tell of; each family can be left out of a network to see what it is worth.
FAMILIES = {
    "position": ("foot", "closest", "gap"),
    "distance": ("line_line", "point_line", "line_point", "point_point", "log_line_line", "log_point_line"),
    "angle": ("cosine",),
    "tomography": ("posterior_at_foot", "posterior_at_closest"),
    "confidence": ("confidence", "own_confidence", "crowd"),
    "scale": ("log_scale", "log_scale_ratio"),
    "surface": ("cut", *_OFF, *_SHAPE),
    "wide_surface": ("wide_cut", *_WIDE_OFF, *_WIDE_SHAPE),
}
#: Most estimates whose surroundings are looked at at a time, and bytes of temporaries of each.
_BLOCK, _ROW_BYTES = 1 << 10, 160 * WIDE
#: The cut counts as no farther from the foot than this many local scales.
_FARTHEST_CUT = 3.0


class Nodes(NamedTuple):
    """What is known of every line before a round.

    ``scale``, ``surface``, ``wide`` (surface of ``WIDE`` neighbours) and ``crowd`` (mean confidence) describe the
    estimates around a line's own; ``typical`` is the median scale of all.
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


class Told(NamedTuple):
    """What the lines tell each other of their estimates between two rounds; their nodes follow from it."""

    beta: Float[Tensor, " lines"]
    confidence: Float[Tensor, " lines"]
    state: Float[Tensor, "lines state"]


class Edges(NamedTuple):
    """Candidates of some lines: their votes, and features of each pair.

    ``vote`` holds positions on the line, one of each kind of ``VOTES``, counted from the line's estimate, and ``foot``
    that of the foot of the candidate's estimate; ``gap`` is the distance of that estimate from the line, ``width`` its
    local scale, ``confidence`` its own. Lengths are in the working frame. ``side`` is 1 or -1, whichever way along the
    line the features count as positive. ``valid`` is False for padding, ``index`` the candidate.
    """

    vote: Float[Tensor, "lines k votes"]
    foot: Float[Tensor, "lines k"]
    gap: Float[Tensor, "lines k"]
    width: Float[Tensor, "lines k"]
    confidence: Float[Tensor, "lines k"]
    feature: Float[Tensor, "lines k edge"]
    state: Float[Tensor, "lines k state"]
    side: Float[Tensor, "lines 1"]
    valid: Bool[Tensor, "lines k"]
    index: Int[Tensor, "lines k"]


class Around(NamedTuple):
    """The estimates around each one.

    ``tree`` holds all of them, ``point``; ``near`` are the ``SCALE`` nearest of the lines of this process, beside the
    line's own; ``scale`` is the local scale of all.
    """

    tree: KDTree
    point: Float[Tensor, "lines 3"]
    near: Int[Tensor, "own near"]
    scale: Float[Tensor, " lines"]


def surroundings(lines: Lines, told: Told, shards: Shards = ALONE) -> Nodes:
    """Local scale and surfaces of the estimates, from the nearest of them; O(lines log lines).

    Each process looks around the estimates of its own lines, and is told what the others see.
    """
    return described(lines, nearest_estimates(lines, told.beta, shards), told, shards)


def nearest_estimates(lines: Lines, beta: Float[Tensor, " lines"], shards: Shards = ALONE) -> Around:
    """The estimates around each one, and so its local scale."""
    from scipy.spatial import KDTree

    point = lines.at(beta)
    # On the CPU: other devices have no such trees, are slow at many small matrices, or know no double precision.
    place = point.cpu().double().numpy()
    tree = KDTree(place)
    own = place[shards.own(len(place))]
    k = min(SCALE + 1, len(place))

    def near(block: slice) -> tuple[Tensor, Tensor]:
        distance, index = _queried(tree, own[block], k)
        return index.int(), distance[:, -1].to(beta.dtype)

    index, reach = _over_rows(near, len(own))
    return Around(tree, point, index, _floored(shards.gather(reach.to(beta.device), len(place))))


def described(lines: Lines, around: Around, told: Told, shards: Shards = ALONE) -> Nodes:
    """What is known of the estimates, when the lines around them are told of them.

    The wide surfaces are those of every ``_SHARED``-th estimate, the leaders; the others have that of the nearest one.
    """
    from scipy.spatial import KDTree

    local, direction, sure = around.point.cpu(), lines.direction.cpu(), told.confidence.cpu()
    place = around.tree.data
    count = len(place)
    leaders = place[::_SHARED]
    lead, own = leaders[shards.own(len(leaders))], place[shards.own(count)]

    def fit(near: Int[Tensor, "rows k"]) -> Surface:
        return fitted(*(picked(column, near) for column in (local, direction, sure)))

    def of_own(block: slice) -> tuple[Tensor, ...]:
        near = around.near[block].long()
        return picked(sure, near).mean(dim=1), *fit(near)

    def of_leaders(block: slice) -> tuple[Tensor, ...]:
        return tuple(fit(_queried(around.tree, lead[block], min(WIDE + 1, count))[1]))

    guide = KDTree(leaders)

    def leader(block: slice) -> tuple[Tensor, ...]:
        return (_queried(guide, own[block], 1)[1].int()[:, 0],)

    def of_all(parts: Sequence[Tensor], count: int) -> list[Tensor]:
        return [shards.gather(part.to(told.beta.device), count) for part in parts]

    crowd, *surface = of_all(_over_rows(of_own, len(own)), count)
    wide = Surface(*of_all(_over_rows(of_leaders, len(lead)), len(leaders)))
    (led,) = of_all(_over_rows(leader, len(own)), count)
    return Nodes(
        beta=told.beta,
        point=around.point,
        scale=around.scale,
        surface=Surface(*surface),
        wide=Surface(*(part.index_select(0, led) for part in wide)),
        crowd=crowd,
        confidence=told.confidence,
        state=told.state,
        typical=around.scale.median(),
    )


def _queried(
    tree: KDTree, places: Float[np.ndarray, "rows 3"], k: int
) -> tuple[Float[Tensor, "rows k"], Int[Tensor, "rows k"]]:
    """Distances and indices of the k points of a tree nearest to places."""
    distance, index = tree.query(places, k)
    # SciPy drops the axis of k = 1.
    return torch.as_tensor(distance).view(-1, k), torch.as_tensor(index).view(-1, k)


def _over_rows(work: Callable[[slice], tuple[Tensor, ...]], count: int) -> list[Tensor]:
    """What is found of some rows, block by block."""
    found = [part for _, part in over_blocks(work, count, _BLOCK, row_bytes=_ROW_BYTES)] or [work(slice(0))]
    return [torch.cat(parts) for parts in zip(*found, strict=True)]


def _floored(reach: Float[Tensor, " lines"]) -> Float[Tensor, " lines"]:
    """Coinciding estimates have no scale of their own; the scene's typical one stands in."""
    apart = reach[reach > 0]
    return reach.clamp_min(1e-3 * apart.median() if len(apart) else 1.0)


def edges(
    lines: Lines,
    nodes: Nodes,
    posterior: Posterior,
    rows: Int[Tensor, " rows"],
    candidates: Int[Tensor, "rows k"],
    first: int = 0,
) -> Edges:
    """Votes and features of the candidates of some lines; -1 is padding. The posterior begins with line ``first``."""
    valid = candidates >= 0
    index = candidates.clamp_min(0).long()
    own = lines.rows(rows)
    # Only what the rows need is touched: the cost of a batch does not depend on the number of lines.
    direction, moment, point = (picked(column, index) for column in (lines.direction, lines.moment, nodes.point))
    scale, confidence, crowd = (picked(column, index) for column in (nodes.scale, nodes.confidence, nodes.crowd))
    d, o, here = own.direction[:, None], own.foot[:, None], nodes.point.index_select(0, rows)[:, None]
    beta, own_scale, own_confidence = (
        column.index_select(0, rows)[:, None] for column in (nodes.beta, nodes.scale, nodes.confidence)
    )
    cosine = (d * direction).sum(-1)
    sine2 = (1 - cosine.square()).clamp_min(PARALLEL**2)
    foot = (point * d).sum(-1)
    closest = _closest(d, o, direction, moment, cosine, sine2)
    at_foot, at_closest = o + foot[..., None] * d, o + closest[..., None] * d
    line_line = ((d * moment).sum(-1) + (own.moment[:, None] * direction).sum(-1)).abs() / sine2.sqrt()
    gap = (at_foot - point).norm(dim=-1)
    line_point = (torch.linalg.cross(here.expand_as(direction), direction) - moment).norm(dim=-1)
    # The flip of the direction is taken out: the side where the feet are skewed to is the positive one.
    sign = _side(foot - beta, scale, valid)
    surfaces = [nodes.surface.at(index), nodes.wide.at(index)]
    crossings = [crossing(surface, d, at_foot, at_closest, here) for surface in surfaces]
    cuts = [foot + crossing.cut for crossing in crossings]
    places = torch.stack([foot, closest, *cuts], dim=1) - beta[:, None]
    offs = [off.abs() for crossing in crossings for off in crossing.off]
    distances = [(closest - foot).abs(), line_line, gap, line_point, (here - point).norm(dim=-1), *offs]
    lengths = torch.cat([places * sign[:, None], torch.stack(distances, dim=1)], dim=1) / scale[:, None]
    ratios = [scale / nodes.typical, scale / own_scale, *(part / nodes.typical + 1e-3 for part in (line_line, gap))]
    numbers = [
        cosine.abs(),
        *_log_posterior(posterior, rows - first, (foot, closest), scale),
        confidence,
        own_confidence.expand_as(confidence),
        crowd,
        *(
            number
            for surface, crossing in zip(surfaces, crossings, strict=True)
            for number in (crossing.slope.abs(), surface.planarity, surface.linearity)
        ),
    ]
    # One number of all candidates after the other: torch is slow where they are side by side.
    parts = [_compressed(lengths), torch.stack(ratios, dim=1).log(), torch.stack(numbers, dim=1)]
    feature = torch.cat(parts, dim=1).masked_fill_(~valid[:, None], 0).transpose(1, 2)
    farthest = _FARTHEST_CUT * scale
    bounded = [foot + torch.maximum(torch.minimum(crossing.cut, farthest), -farthest) for crossing in crossings]
    vote = torch.stack([closest, *bounded], dim=2) - beta[..., None]
    return Edges(
        vote, places[:, 0], gap, scale, confidence, feature, picked(nodes.state, index), sign, valid, candidates
    )


def _closest(d: Tensor, o: Tensor, direction: Tensor, moment: Tensor, cosine: Tensor, sine2: Tensor) -> Tensor:
    other_foot = torch.linalg.cross(direction, moment)
    return ((other_foot * d).sum(-1) + cosine * (o * direction).sum(-1)) / sine2


def _side(
    apart: Float[Tensor, "rows k"], scale: Float[Tensor, "rows k"], valid: Bool[Tensor, "rows k"]
) -> Float[Tensor, "rows 1"]:
    skew = (apart.sign() * torch.log1p(apart.abs() / scale) * valid).sum(dim=1, keepdim=True)
    return torch.where(skew < 0, -1.0, 1.0)


def _compressed(value: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Signed logarithm: near and far places both keep digits."""
    return value.abs().log1p_().copysign_(value)


def _log_posterior(
    posterior: Posterior,
    rows: Int[Tensor, " rows"],
    places: Sequence[Float[Tensor, "rows k"]],
    scale: Float[Tensor, "rows k"],
) -> list[Float[Tensor, "rows k"]]:
    """Logarithm of the tomographic posterior mass within one local scale of places on the line."""
    beta, probability = posterior.beta.index_select(0, rows), posterior.probability.index_select(0, rows)
    place, reach = torch.cat(list(places), dim=1), scale.repeat(1, len(places))
    # 1 within reach, 0 beyond: all pairs of samples and places cost a fifth of looking each place up.
    near = (beta[:, :, None] - place[:, None]).abs_().lt_(reach[:, None])
    mass = (probability[:, None] @ near)[:, 0]
    return list(torch.log(mass + 1e-4).chunk(len(places), dim=1))
