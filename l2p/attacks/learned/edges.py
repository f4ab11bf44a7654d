"""Inputs of the network for candidate pairs, assembled from its families."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.inputs.family import Inputs, Kind


class Edges(NamedTuple):
    """Candidate pairs of some lines, as input of the network; lengths are in the working frame.

    ``vote`` holds one position on the line per kind of vote, and ``foot`` that of the foot of the candidate's estimate,
    both relative to the line's estimate. ``point_line`` is the distance of the candidate's estimate from the line,
    ``scale`` its local scale, ``confidence`` its confidence. ``side`` is 1 or -1, the positive side of the line, the
    same for all candidates. ``likeness`` is the log likelihood ratio of the appearances, 0 without any. ``valid`` is
    False for padding.
    """

    vote: Float[Tensor, "lines k votes"]
    foot: Float[Tensor, "lines k"]
    point_line: Float[Tensor, "lines k"]
    scale: Float[Tensor, "lines k"]
    confidence: Float[Tensor, "lines k"]
    feature: Float[Tensor, "lines k features"]
    state: Float[Tensor, "lines k state"]
    side: Float[Tensor, "lines k"]
    likeness: Float[Tensor, "lines k"]
    valid: Bool[Tensor, "lines k"]


def feature_names(inputs: Sequence[Inputs]) -> list[str]:
    """Names of the features: by kind, then in the order of the families; last, flags of the attributes present."""
    by_kind = [name for kind in Kind for family in inputs for name, own in family.columns.items() if own is kind]
    return [*by_kind, *(f"has_{name}" for name in _needed(inputs))]


def vote_names(inputs: Sequence[Inputs]) -> list[str]:
    """Names of the votes, in the order of the families."""
    return [name for family in inputs for name in family.votes]


def edges_of(pairs: Candidates, inputs: Sequence[Inputs]) -> Edges:
    """Compute features and votes of candidate pairs."""
    columns: dict[Kind, list[Tensor]] = {kind: [] for kind in Kind}
    votes: list[Tensor] = []
    absent = torch.zeros_like(pairs.foot)
    for family in inputs:
        if any(name not in pairs.attributes for name in family.needs):
            values = [absent] * len(family.columns)
        else:
            values, own_votes = family.of(pairs)
            votes += own_votes
        for value, kind in zip(values, family.columns.values(), strict=True):
            columns[kind].append(value)
    columns[Kind.NUMBER] += [absent + (name in pairs.attributes) for name in _needed(inputs)]
    beta, scale, sign = pairs.own(pairs.nodes.beta), pairs.scale, pairs.side
    places = torch.stack(columns[Kind.POSITION], dim=1) - beta[:, None]
    lengths = [places * sign[:, None], *([torch.stack(columns[Kind.LENGTH], dim=1)] if columns[Kind.LENGTH] else [])]
    # Values of one feature are contiguous over the candidates: torch is slow the other way round.
    blocks = [_compressed(torch.cat(lengths, dim=1) / scale[:, None])]
    if columns[Kind.RATIO]:
        blocks.append(torch.stack(columns[Kind.RATIO], dim=1).log())
    if columns[Kind.NUMBER]:
        blocks.append(torch.stack(columns[Kind.NUMBER], dim=1))
    feature = torch.cat(blocks, dim=1).masked_fill_(~pairs.valid[:, None], 0).transpose(1, 2)
    return Edges(
        vote=torch.stack(votes, dim=2) - beta[..., None],
        foot=pairs.foot - beta,
        point_line=pairs.point_line,
        scale=scale,
        confidence=pairs.other(pairs.nodes.confidence),
        feature=feature,
        state=pairs.other(pairs.nodes.state),
        side=sign.expand_as(scale),
        likeness=pairs.likeness,
        valid=pairs.valid,
    )


def _needed(inputs: Sequence[Inputs]) -> list[str]:
    """Attributes that the families need, each once."""
    return list(dict.fromkeys(name for family in inputs for name in family.needs))


def _compressed(value: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Signed logarithm, which resolves near and far positions."""
    return value.abs().log1p_().copysign_(value)
