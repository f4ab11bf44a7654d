"""Candidate pairs of some lines; their geometry is computed once for all families of inputs.

Everything follows from the lines alone. It does not change if the scene is moved, turned or scaled, if lines are
reordered, if a line's origin moves along it, or if its direction is reversed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from l2p.attacks.learned.nodes import Nodes
from l2p.attacks.tomography.posterior import Posterior
from l2p.geometry.elements import Lines, picked
from l2p.geometry.pairs import PARALLEL


@dataclass(frozen=True, eq=False)
class Candidates:
    """Lines and their candidates; positions are relative to each line's foot, lengths in the frame's unit.

    Attributes
    ----------
    index : (rows, k)
        The candidates; 0 for padding.
    valid : (rows, k)
        False for padding.
    rows : (rows,)
        Indices of the lines.
    direction, point, scale, confidence, crowd : (rows, k, ...)
        Columns of the candidates (:class:`l2p.attacks.learned.nodes.Nodes`).
    own_direction, own_foot, own_point, own_beta, own_scale, own_confidence : (rows, 1, ...)
        Columns of the lines themselves.
    cosine : (rows, k)
        Cosine of the angle between line and candidate.
    foot : (rows, k)
        Position on the line of the foot of the candidate's estimate.
    closest : (rows, k)
        Position of the line's point closest to the candidate.
    at_foot, at_closest : (rows, k, 3)
        Points at these positions.
    line_line, point_line : (rows, k)
        Distance of the two lines; distance of the candidate's estimate from the line.
    line_point : (rows, k)
        Distance of the candidate from the line's estimate.
    side : (rows, 1)
        1 or -1: the side to which the feet are skewed; it removes the arbitrary sign of the direction.
    nodes : Nodes
    posterior : Posterior
        Its row 0 is that of line ``first``.
    attributes : mapping
        Data published with each line (:class:`l2p.attacks.attack.Elements`).
    """

    index: Int[Tensor, "rows k"]
    valid: Bool[Tensor, "rows k"]
    rows: Int[Tensor, " rows"]
    direction: Float[Tensor, "rows k 3"]
    point: Float[Tensor, "rows k 3"]
    scale: Float[Tensor, "rows k"]
    confidence: Float[Tensor, "rows k"]
    crowd: Float[Tensor, "rows k"]
    own_direction: Float[Tensor, "rows 1 3"]
    own_foot: Float[Tensor, "rows 1 3"]
    own_point: Float[Tensor, "rows 1 3"]
    own_beta: Float[Tensor, "rows 1"]
    own_scale: Float[Tensor, "rows 1"]
    own_confidence: Float[Tensor, "rows 1"]
    cosine: Float[Tensor, "rows k"]
    foot: Float[Tensor, "rows k"]
    closest: Float[Tensor, "rows k"]
    at_foot: Float[Tensor, "rows k 3"]
    at_closest: Float[Tensor, "rows k 3"]
    line_line: Float[Tensor, "rows k"]
    point_line: Float[Tensor, "rows k"]
    line_point: Float[Tensor, "rows k"]
    side: Float[Tensor, "rows 1"]
    nodes: Nodes
    posterior: Posterior
    first: int
    attributes: Mapping[str, Shaped[Tensor, "lines ..."]]

    @classmethod
    def of(
        cls,
        lines: Lines,
        nodes: Nodes,
        posterior: Posterior,
        rows: Int[Tensor, " rows"],
        candidates: Int[Tensor, "rows k"],
        first: int = 0,
        attributes: Mapping[str, Shaped[Tensor, "lines ..."]] | None = None,
    ) -> Candidates:
        """Compute the geometry of the pairs; -1 in ``candidates`` is padding."""
        valid = candidates >= 0
        index = candidates.clamp_min(0).long()
        own = lines.rows(rows)
        # Only the columns of these rows are read: the cost of a batch does not depend on the number of lines.
        direction, moment, point = (picked(column, index) for column in (lines.direction, lines.moment, nodes.point))
        scale, confidence, crowd = (picked(column, index) for column in (nodes.scale, nodes.confidence, nodes.crowd))
        d, o, here = own.direction[:, None], own.foot[:, None], nodes.point.index_select(0, rows)[:, None]
        beta, own_scale, own_confidence = (
            column.index_select(0, rows)[:, None] for column in (nodes.beta, nodes.scale, nodes.confidence)
        )
        cosine = (d * direction).sum(-1)
        sine2 = (1 - cosine.square()).clamp_min(PARALLEL**2)
        foot = (point * d).sum(-1)
        other_foot = torch.linalg.cross(direction, moment)
        closest = ((other_foot * d).sum(-1) + cosine * (o * direction).sum(-1)) / sine2
        at_foot, at_closest = o + foot[..., None] * d, o + closest[..., None] * d
        reciprocal = (d * moment).sum(-1) + (own.moment[:, None] * direction).sum(-1)
        return cls(
            index=index,
            valid=valid,
            rows=rows,
            direction=direction,
            point=point,
            scale=scale,
            confidence=confidence,
            crowd=crowd,
            own_direction=d,
            own_foot=o,
            own_point=here,
            own_beta=beta,
            own_scale=own_scale,
            own_confidence=own_confidence,
            cosine=cosine,
            foot=foot,
            closest=closest,
            at_foot=at_foot,
            at_closest=at_closest,
            line_line=reciprocal.abs() / sine2.sqrt(),
            point_line=(at_foot - point).norm(dim=-1),
            line_point=(torch.linalg.cross(here.expand_as(direction), direction) - moment).norm(dim=-1),
            side=_side(foot - beta, scale, valid),
            nodes=nodes,
            posterior=posterior,
            first=first,
            attributes=attributes or {},
        )

    def attribute(self, name: str) -> tuple[Shaped[Tensor, "rows 1 ..."], Shaped[Tensor, "rows k ..."]]:
        """Return a published attribute of the lines and of their candidates."""
        column = self.attributes[name]
        return column.index_select(0, self.rows)[:, None], picked(column, self.index)


def _side(
    apart: Float[Tensor, "rows k"], scale: Float[Tensor, "rows k"], valid: Bool[Tensor, "rows k"]
) -> Float[Tensor, "rows 1"]:
    skew = (apart.sign() * torch.log1p(apart.abs() / scale) * valid).sum(dim=1, keepdim=True)
    return torch.where(skew < 0, -1.0, 1.0)
