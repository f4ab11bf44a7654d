"""Candidate pairs of some lines; their geometry is computed when first read, once for all families of inputs.

Everything follows from the lines alone. It does not change if the scene is moved or turned, if lines are reordered, or
if a line's origin moves along it; positions change sign with a line's direction, and ``side`` is the positive side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from l2p.attacks.learned.embedding import Appearances
from l2p.attacks.learned.nodes import Nodes
from l2p.attacks.tomography.posterior import Posterior
from l2p.geometry.elements import Lines, picked
from l2p.geometry.nearest import Nearest
from l2p.geometry.pairs import PARALLEL, point_line_distance
from l2p.maps.short_repr import short_repr

#: Lines per block of the choice of candidates; their vectors stay in the cache.
_BLOCK = 512


@dataclass(frozen=True, eq=False)
class Candidates:
    """Lines and their candidates; positions are relative to each line's foot, lengths in the frame's unit.

    Attributes
    ----------
    lines, nodes
        All lines.
    posterior : Posterior
        Its row 0 is that of line ``first``.
    rows : (rows,)
        Indices of the lines.
    chosen : (rows, k)
        Indices of their candidates; -1 is padding.
    attributes : mapping
        Published attributes that the attack uses, and ``appearance``, their embedding, if there are any.
    """

    lines: Lines
    nodes: Nodes
    posterior: Posterior
    rows: Int[Tensor, " rows"]
    chosen: Int[Tensor, "rows k"]
    first: int = 0
    attributes: Mapping[str, Any] = field(default_factory=dict)

    __repr__ = short_repr

    def own(self, column: Shaped[Tensor, "lines ..."]) -> Shaped[Tensor, "rows 1 ..."]:
        """Select the entries of the lines themselves."""
        return column.index_select(0, self.rows)[:, None]

    def other(self, column: Shaped[Tensor, "lines ..."]) -> Shaped[Tensor, "rows k ..."]:
        """Select the entries of the candidates; the cost does not depend on the number of all lines."""
        return picked(column, self.index)

    @cached_property
    def valid(self) -> Bool[Tensor, "rows k"]:
        """False for padding."""
        return self.chosen >= 0

    @cached_property
    def index(self) -> Int[Tensor, "rows k"]:
        """Indices of the candidates; 0 for padding."""
        return self.chosen.clamp_min(0).long()

    @cached_property
    def direction(self) -> Float[Tensor, "rows 1 3"]:
        """Directions of the lines."""
        return self.own(self.lines.direction)

    @cached_property
    def origin(self) -> Float[Tensor, "rows 1 3"]:
        """Feet of the lines, the origins of positions."""
        return self.lines.rows(self.rows).foot[:, None]

    @cached_property
    def here(self) -> Float[Tensor, "rows 1 3"]:
        """Estimates of the lines."""
        return self.own(self.nodes.point)

    @cached_property
    def point(self) -> Float[Tensor, "rows k 3"]:
        """Estimates of the candidates."""
        return self.other(self.nodes.point)

    @cached_property
    def scale(self) -> Float[Tensor, "rows k"]:
        """Local scales of the candidates."""
        return self.other(self.nodes.scale)

    @cached_property
    def _other_lines(self) -> tuple[Float[Tensor, "rows k 3"], Float[Tensor, "rows k 3"]]:
        return self.other(self.lines.direction), self.other(self.lines.moment)

    @cached_property
    def cosine(self) -> Float[Tensor, "rows k"]:
        """Cosine of the angle between line and candidate."""
        return (self.direction * self._other_lines[0]).sum(-1)

    @cached_property
    def _sine2(self) -> Float[Tensor, "rows k"]:
        return (1 - self.cosine.square()).clamp_min(PARALLEL**2)

    @cached_property
    def foot(self) -> Float[Tensor, "rows k"]:
        """Position of the foot of the candidate's estimate."""
        return (self.point * self.direction).sum(-1)

    @cached_property
    def closest(self) -> Float[Tensor, "rows k"]:
        """Position of the line's point closest to the candidate."""
        direction, moment = self._other_lines
        other_foot = torch.linalg.cross(direction, moment)
        reach = (other_foot * self.direction).sum(-1) + self.cosine * (self.origin * direction).sum(-1)
        return reach / self._sine2

    @cached_property
    def at_foot(self) -> Float[Tensor, "rows k 3"]:
        """The point at ``foot``."""
        return self.origin + self.foot[..., None] * self.direction

    @cached_property
    def at_closest(self) -> Float[Tensor, "rows k 3"]:
        """The point at ``closest``."""
        return self.origin + self.closest[..., None] * self.direction

    @cached_property
    def line_line(self) -> Float[Tensor, "rows k"]:
        """Distance of line and candidate."""
        direction, moment = self._other_lines
        reciprocal = (self.direction * moment).sum(-1) + (self.own(self.lines.moment) * direction).sum(-1)
        return reciprocal.abs() / self._sine2.sqrt()

    @cached_property
    def point_line(self) -> Float[Tensor, "rows k"]:
        """Distance of the candidate's estimate from the line."""
        return (self.at_foot - self.point).norm(dim=-1)

    @cached_property
    def line_point(self) -> Float[Tensor, "rows k"]:
        """Distance of the candidate from the line's estimate."""
        direction, moment = self._other_lines
        return point_line_distance(self.here.expand_as(direction), direction, moment)

    @cached_property
    def likeness(self) -> Float[Tensor, "rows k"]:
        """Log likelihood ratio of the appearances of line and candidate; 0 if nothing is published."""
        appearance = self.attributes.get("appearance")
        return torch.zeros_like(self.scale) if appearance is None else appearance.likeness(self.rows, self.index)

    @cached_property
    def side(self) -> Float[Tensor, "rows 1"]:
        """1 or -1: the side to which the feet are skewed; it removes the arbitrary sign of the direction."""
        apart = self.foot - self.own(self.nodes.beta)
        skew = (apart.sign() * torch.log1p(apart.abs() / self.scale) * self.valid).sum(dim=1, keepdim=True)
        return torch.where(skew < 0, -1.0, 1.0)


def most_alike(
    near: Nearest, appearance: Appearances, count: int, liking: float, first: int
) -> Int[Tensor, "own count"]:
    """Choose ``count`` of the estimates near each line: those with the least distance times exp(-liking * likeness).

    They stay in the order of their distances; row 0 is line ``first``.
    """
    chosen = torch.empty_like(near.index[:, :count])
    for begin in range(0, len(chosen), _BLOCK):
        index, distance = near.index[begin : begin + _BLOCK], near.distance[begin : begin + _BLOCK]
        rows = torch.arange(first + begin, first + begin + len(index), device=index.device)
        likeness = appearance.likeness(rows, index.clamp_min(0).long())
        far = (distance.log() - liking * likeness).masked_fill_(index < 0, torch.inf)
        best = far.topk(count, dim=1, largest=False, sorted=False).indices.sort(dim=1).values
        chosen[begin : begin + len(index)] = index.gather(1, best)
    return chosen
