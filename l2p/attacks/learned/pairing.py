"""Two points on one line: which estimates may vote for which of them, and which of the two has which appearance."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from l2p.attacks.families import other_points_near_lines
from l2p.attacks.learned.embedding import Appearances
from l2p.attacks.learned.nodes import Estimates, Nodes
from l2p.attacks.structure import Structure
from l2p.geometry.elements import Lines, picked
from l2p.geometry.nearest import (
    Nearest,
    nearest_points_to_lines,
    nearest_points_to_points,
)
from l2p.work.work import Work

#: Distance from the other point's estimate, in its local scales, from which a line's candidates are free again.
_CLEAR = 4.0
#: Estimates around a place whose appearances tell which of the two points it is, and sweeps over all lines.
_AROUND, _SWEEPS = 16, 6


def nearest_allowed(lines: Lines, nodes: Nodes, k: int, structure: Structure, work: Work) -> Nearest:
    """Find the k estimates nearest to each line of this process among those that may vote for it.

    Lines through centres: those of other families. Lines through pairs: those that do not belong to the line's other
    point (:func:`of_own_point`). Distances are in units of the square root of the local scale.
    """
    scale = nodes.scale.sqrt()
    if structure.family is not None:
        return other_points_near_lines(lines, nodes.point, k, scale, structure.family, work)
    if structure.twin is None:
        return nearest_points_to_lines(lines, nodes.point, k, scale=scale, work=work)
    near = nearest_points_to_lines(lines, nodes.point, 2 * k + 1, scale=scale, work=work)
    own = work.own(len(nodes.beta))
    rows = torch.arange(own.start, own.stop, device=near.index.device)
    allowed = of_own_point(lines, nodes, structure.twin, rows, near.index)
    order = (~allowed).byte().argsort(dim=1, stable=True)[:, :k]
    absent = ~allowed.gather(1, order)
    index = near.index.gather(1, order).masked_fill(absent, -1)
    return Nearest(index, near.distance.gather(1, order).masked_fill(absent, torch.inf))


def of_own_point(
    lines: Lines, nodes: Nodes, twin: Int[Tensor, " lines"], rows: Int[Tensor, " rows"], index: Int[Tensor, "rows k"]
) -> Bool[Tensor, "rows k"]:
    """Whether candidates of some lines may vote for their own point, and not only for the other point of the line.

    Excluded is what is near the other point's estimate: all of it for the less confident of the two, and what is nearer
    to it than to the own estimate for the other. So both cannot stay at one peak.
    """
    other = twin[rows]
    foot = torch.einsum("rki,ri->rk", picked(nodes.point, index.clamp_min(0).long()), lines.direction[rows])
    from_own, from_other = ((foot - nodes.beta[some][:, None]).abs() for some in (rows, other))
    reach = _CLEAR * nodes.scale[other]
    sure = (nodes.confidence[rows] > nodes.confidence[other]) | (
        (nodes.confidence[rows] == nodes.confidence[other]) & (rows < other)
    )
    apart = (nodes.beta[rows] - nodes.beta[other]).abs() > reach
    free = from_other > reach[:, None]
    nearer = (from_own <= from_other) & (sure | apart)[:, None]
    return (free | nearer) & (index >= 0) & (index != other[:, None])


def assigned(lines: Lines, estimates: Estimates, twin: Int[Tensor, " lines"], appearance: Appearances) -> Estimates:
    """Exchange the estimates of the two points of a line where their appearances fit better the other way round.

    Each place is compared with the estimates around it: the likelihood of an appearance there is the mean of
    exp(s_ij) over them. Half of the lines are decided at a time, since their places are compared with each other.
    """
    count = len(twin)
    place = torch.arange(count, device=twin.device)
    around = nearest_points_to_points(lines.at(estimates.beta), min(_AROUND, count - 1)).index.long()
    holds = place.clone()  # the element whose appearance is at each place
    fresh = around != twin[:, None]
    for sweep in range(_SWEEPS):
        neighbors = picked(holds, around)
        fits, swapped = (
            torch.where(fresh, appearance.likeness(rows, neighbors), -torch.inf).logsumexp(dim=1)
            for rows in (holds, holds[twin])
        )
        gain = swapped - fits
        turn = torch.minimum(place, twin) // 2 % 2 == sweep % 2
        holds = torch.where(turn & (gain + gain[twin] > 0), holds[twin], holds)
    found = holds.argsort()
    return Estimates(*(column[found] for column in estimates))
