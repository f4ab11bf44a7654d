"""The line transformer: it judges which candidates of a line are true neighbours, by the agreement of their votes.

A candidate's token holds the features of its pair, the candidate's state from the round before, and the density of the
other candidates around the foot of its estimate. Tokens of one line attend to each other by their positions along the
line: in head h, token j gathers token k with the weight

    A_h[j, k] = (1 + ((t_j - t_k)^2 + g_k^2) / (s_h w_k)^2)^-2,

where t is the foot of an estimate on the line, g its distance from the line, w its local scale and s_h the width of the
head: (t_j - t_k)^2 + g_k^2 is the squared distance of estimate k from foot j. So sum_k A_h[j, k] / w_k^3 is an adaptive
kernel estimate of the density of points at foot j; its logarithm, relative to the densest foot of the line, is the
strongest single cue, as in the leave-one-out bound (:mod:`l2p.judging.references`). With the same weights, the mean of
the feet around foot j, a step of mean shift, gives the direction to the densest place. Each layer also reads the mean
and the maximum over all tokens, since the positions along a line compete. States pass the findings of a line to the
lines around it, round by round.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from l2p.attacks.learned.edges import Edges, feature_names, vote_names
from l2p.attacks.learned.embedding import Embedding
from l2p.attacks.learned.inputs import GEOMETRY, inputs_of
from l2p.maps.appearance import SIFT

#: Inputs per foot and head: density of all candidates, of confident ones, number of candidates, and mean shift; then,
#: by likeness: density, mean likeness, and mean shift.
_AROUND, _AROUND_LIKE = 4, 3
#: Bound of the likeness in an exponential.
_MOST_LIKE = 10.0
#: Logit of padding.
NOTHING = -30.0
#: Logit of padding among votes; low enough to vanish in a softmax over padding only.
NO_VOTE = -1e9


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes and constants of the network.

    Attributes
    ----------
    width : int
        Length of a token.
    layers : int
        Attention layers.
    heads : int
        Attention heads; their widths s_h form a geometric series from ``finest`` to ``widest`` local scales.
    inputs : tuple of str
        Families of inputs (:data:`l2p.attacks.learned.inputs.INPUTS`).
    state : int
        Length of the state that each line passes to the lines around it in the next round.
    radii : tuple of float
        Radii, in spacings of the line cloud's own points, one of them 1; for each, the network gives the logit that the
        error is within it.
    pooled : int
        Length of the part of a token that is pooled over the line.
    farthest_mean : float
        Largest distance of the mean of the feet from a foot, in local scales.
    log_range, log_factor : float
        Bound of the logarithm of a density over the densest, and its factor, so that inputs are about 1.
    kind : str
        Kind of the descriptors that the embedding was trained for; used with the input ``likeness``, as are the others.
    length, hidden, embedding : int
        Length of a descriptor, width of the embedding's hidden layers, and length of its vectors.
    """

    width: int = 64
    layers: int = 1
    heads: int = 4
    finest: float = 0.25
    widest: float = 2.0
    inputs: tuple[str, ...] = GEOMETRY
    state: int = 8
    radii: tuple[float, ...] = (0.125, 0.25, 0.5, 1.0, 2.0)
    pooled: int = 16
    farthest_mean: float = 3.0
    log_range: float = 15.0
    log_factor: float = 0.3
    kind: str = SIFT
    length: int = 128
    hidden: int = 256
    embedding: int = 48

    def __post_init__(self) -> None:
        if self.width < 1 or self.heads < 1 or self.width % self.heads:
            raise ValueError(f"got width {self.width} and {self.heads} heads; expected a width that they divide")
        if self.layers < 0 or not 0 < self.finest <= self.widest:
            raise ValueError(
                f"got {self.layers} layers and heads of {self.finest} to {self.widest} local scales; expected at least "
                "0 layers, and widths that rise from above 0"
            )
        if min(self.length, self.hidden, self.embedding) < 1:
            raise ValueError(
                f"got length {self.length}, hidden {self.hidden}, embedding {self.embedding}; expected at least 1"
            )
        if self.state < 1 or self.pooled < 1:
            raise ValueError(f"got state {self.state} and pooled {self.pooled}; expected at least 1 of each")
        rising = all(0 < low < high for low, high in zip(self.radii, self.radii[1:], strict=False))
        if len(self.radii) < 2 or 1.0 not in self.radii or not rising:
            raise ValueError(f"got radii {self.radii}; expected at least two that rise from above 0, 1 among them")
        inputs_of(self.inputs)

    @property
    def appearance(self) -> bool:
        """Whether the network uses published colours and descriptors."""
        return "likeness" in self.inputs

    @property
    def around(self) -> int:
        """Inputs per foot and head that describe its surroundings."""
        return _AROUND + self.appearance * _AROUND_LIKE

    @property
    def one(self) -> int:
        """Index of the radius of 1 spacing in ``radii``."""
        return self.radii.index(1.0)

    @property
    def scales(self) -> list[float]:
        """Widths s_h of the heads."""
        ratio = (self.widest / self.finest) ** (1 / max(self.heads - 1, 1))
        return [self.finest * ratio**head for head in range(self.heads)]


class Judgement(NamedTuple):
    """Output of the network for each line.

    ``affinity``: logit of each candidate being a true neighbour. ``place``: each candidate's votes, positions on the
    line relative to the last estimate; ``spread``: scale of their errors; ``vote``: logits that the point is there, for
    a softmax over all votes of a line. ``found``: logits that the error is within each radius. ``state``: passed to the
    next round.
    """

    affinity: Float[Tensor, "lines k"]
    place: Float[Tensor, "lines k votes"]
    spread: Float[Tensor, "lines k votes"]
    vote: Float[Tensor, "lines k votes"]
    state: Float[Tensor, "lines state"]
    found: Float[Tensor, "lines radii"]


class Attention(NamedTuple):
    """Attention weights: ``kernel``, unscaled, from token k to token j, 0 from padding; ``share``, the factor that
    makes the weights of each j sum to about 1."""

    kernel: Float[Tensor, "lines heads k j"]
    share: Float[Tensor, "lines heads 1 j"]

    def gathered(self, value: Float[Tensor, "lines k width"]) -> Float[Tensor, "lines j width"]:
        """Gather the values around each token; each head gathers its part of the width."""
        heads = self.kernel.shape[1]
        # Narrow matrices (8 numbers) multiply several times faster from the left than from the right.
        parts = value.transpose(1, 2).contiguous().unflatten(1, (heads, -1))
        return (parts @ self.kernel * self.share).flatten(1, 2).transpose(1, 2)


class PositionAttention(nn.Module):
    """Attention of tokens by position along the line; all layers share the kernels."""

    def __init__(self, width: int, pooled: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.value = nn.Linear(width, width)
        self.global_value = nn.Linear(width, pooled)
        self.mix = nn.Linear(2 * width + 2 * pooled, width)
        self.expand = nn.Linear(width, 2 * width)
        self.shrink = nn.Linear(2 * width, width)

    def forward(
        self, token: Float[Tensor, "lines k width"], attention: Attention, valid: Bool[Tensor, "lines k"]
    ) -> Float[Tensor, "lines k width"]:
        """Apply one layer: gather from near tokens and from the whole line, then a feed-forward network."""
        normal = self.norm(token)
        near = attention.gathered(self.value(normal))
        token = token + self._mixed(normal, near, _mean_and_most(self.global_value(normal), valid))
        return token + self.shrink(nn.functional.gelu(self.expand(token)))

    def _mixed(
        self,
        normal: Float[Tensor, "lines k width"],
        near: Float[Tensor, "lines k width"],
        everywhere: Float[Tensor, "lines pooled"],
    ) -> Float[Tensor, "lines k width"]:
        """Apply ``mix`` to the three concatenated; the part common to all tokens is computed once per line."""
        width = normal.shape[2]
        own, around, rest = self.mix.weight.split([width, width, everywhere.shape[1]], dim=1)
        line = nn.functional.linear(everywhere, rest, self.mix.bias)[:, None]
        return nn.functional.linear(normal, own) + nn.functional.linear(near, around) + line


class LineTransformer(nn.Module):
    """Network that judges the candidates of each line by itself: the result does not depend on the batch."""

    def __init__(self, config: NetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config or NetworkConfig()
        width, heads, state = self.config.width, self.config.heads, self.config.state
        inputs = inputs_of(self.config.inputs)
        features, votes = len(feature_names(inputs)), len(vote_names(inputs))
        self.embed = nn.Sequential(
            nn.Linear(features + state + self.config.around * heads, width), nn.GELU(), nn.Linear(width, width)
        )
        if self.config.appearance:
            self.embedding = Embedding(self.config.length, self.config.hidden, self.config.embedding)
            # Exponent of the likeness in the weights of candidates.
            self.power = nn.Parameter(torch.tensor(1.0))
        # Logarithm of the spread of each kind of vote, in local scales.
        self.log_spread = nn.Parameter(torch.full((votes,), -1.5))
        self.layers = nn.ModuleList(PositionAttention(width, self.config.pooled) for _ in range(self.config.layers))
        self.norm = nn.LayerNorm(width)
        self.judge = nn.Linear(width, 1 + votes)
        self.pool = nn.Sequential(
            nn.Linear(2 * width, width), nn.GELU(), nn.Linear(width, state + len(self.config.radii))
        )

    def forward(self, edges: Edges) -> Judgement:
        """Judge the candidates; padding gets the logits ``NOTHING`` and ``NO_VOTE``."""
        attention, around = self._kernels(edges)
        token = self.embed(torch.cat([edges.feature, edges.state, around], dim=2))
        for layer in self.layers:
            token = layer(token, attention, edges.valid)
        token = self.norm(token)
        judged = self.judge(token)
        affinity = judged[..., 0].masked_fill(~edges.valid, NOTHING)
        vote = judged[..., 1:].masked_fill(~edges.valid[..., None], NO_VOTE)
        spread = edges.scale.masked_fill(~edges.valid, 1.0)[..., None] * self.log_spread.exp()
        pooled = self.pool(_pooled(token, affinity, edges.valid))
        state, found = torch.tanh(pooled[:, : self.config.state]), _rising(pooled[:, self.config.state :])
        return Judgement(affinity, edges.vote, spread, vote, state, found)

    def _kernels(self, edges: Edges) -> tuple[Attention, Float[Tensor, "lines k around"]]:
        """Compute the attention of each head, and the inputs that describe the surroundings of each foot."""
        valid, count = edges.valid, edges.valid.to(edges.scale.dtype)
        width = edges.scale.masked_fill(~valid, 1.0)
        foot = edges.foot.masked_fill(~valid, 0)
        # Rows are the candidates k, columns the feet j.
        gap2 = edges.point_line.square().masked_fill(~valid, torch.inf)
        apart2 = (foot[:, None, :] - foot[:, :, None]).square_().add_(gap2[:, :, None])
        apart2 = apart2.mul_(width.square().reciprocal()[:, :, None])
        # (1 + a / s^2)^-2 = s^4 (s^2 + a)^-2; s^4 is applied later, to fewer numbers.
        scale2 = apart2.new_tensor(self.config.scales).square()[:, None, None]
        kernel = (apart2[:, None] + scale2).pow(-2)
        # 1 / w^3, relative to the densest so that it stays in range.
        weight = -3 * width.log().masked_fill(~valid, torch.inf)
        weight = (weight - weight.amax(dim=1, keepdim=True)).exp().masked_fill(~valid, 0)
        confident = weight * edges.confidence
        weights = [weight, confident, count, confident * foot]
        if self.config.appearance:
            like = self._like(edges)
            weights += [confident * like, confident * like * foot]
        factor = scale2.square()
        total = torch.stack(weights, dim=1)[:, None] @ kernel * factor  # lines heads weights feet
        level = total[:, :, :3].clamp_min(1e-12).log()
        level[:, :, :2] -= self._densest(level[:, :, :2], valid)
        _, sure, number, moment = total[:, :, :4].unbind(dim=2)
        around = [self._bounded(level), self._shift(sure, moment, edges)]
        if self.config.appearance:
            alike, moment = total[:, :, 4:].unbind(dim=2)
            level = alike[:, :, None].clamp_min(1e-12).log()
            mean = level - sure[:, :, None].clamp_min(1e-12).log()
            around += [self._bounded(level - self._densest(level, valid)), self._bounded(mean)]
            around += [self._shift(alike, moment, edges)]
        inputs = torch.cat(around, dim=2).flatten(1, 2)
        inputs = inputs.nan_to_num_().masked_fill_(~valid[:, None], 0).transpose(1, 2)
        return Attention(kernel, factor / (number[:, :, None] + 1e-2)), inputs

    def _like(self, edges: Edges) -> Float[Tensor, "lines k"]:
        """exp(power * likeness)."""
        return (self.power * edges.likeness).clamp(-_MOST_LIKE, _MOST_LIKE).exp()

    def _densest(
        self, level: Float[Tensor, "lines heads levels feet"], valid: Bool[Tensor, "lines feet"]
    ) -> Float[Tensor, "lines heads levels 1"]:
        return level.masked_fill(~valid[:, None, None], -torch.inf).amax(dim=3, keepdim=True)

    def _bounded(self, level: Float[Tensor, "lines heads levels feet"]) -> Float[Tensor, "lines heads levels feet"]:
        return level.clamp(-self.config.log_range, self.config.log_range) * self.config.log_factor

    def _shift(
        self, mass: Float[Tensor, "lines heads feet"], moment: Float[Tensor, "lines heads feet"], edges: Edges
    ) -> Float[Tensor, "lines heads 1 feet"]:
        """Step of mean shift from each foot, in local scales, towards the positive side."""
        foot, width = (value.masked_fill(~edges.valid, fill) for value, fill in ((edges.foot, 0), (edges.scale, 1)))
        shift = torch.where(mass > 1e-12, moment / mass.clamp_min(1e-12) - foot[:, None], 0.0) / width[:, None]
        farthest = self.config.farthest_mean
        return (edges.side[:, None] * shift.clamp(-farthest, farthest))[:, :, None]


def _mean_and_most(value: Float[Tensor, "lines k n"], valid: Bool[Tensor, "lines k"]) -> Float[Tensor, "lines two_n"]:
    """Mean and maximum over a line's candidates; about 0 for a line without candidates."""
    share = valid / valid.sum(dim=1, keepdim=True).clamp_min(1)
    mean = (share[:, None] @ value)[:, 0]
    most = value.masked_fill(~valid[..., None], NOTHING).amax(dim=1)
    return torch.cat([mean, most * valid.any(dim=1, keepdim=True)], dim=1)


def _rising(logit: Float[Tensor, "lines radii"]) -> Float[Tensor, "lines radii"]:
    """Logits that do not fall from one radius to the next."""
    return torch.cat([logit[:, :1], nn.functional.softplus(logit[:, 1:])], dim=1).cumsum(dim=1)


def _pooled(
    token: Float[Tensor, "lines k width"], affinity: Float[Tensor, "lines k"], valid: Bool[Tensor, "lines k"]
) -> Float[Tensor, "lines two_widths"]:
    """Mean token weighted by affinity, and mean over all candidates."""
    weight = torch.sigmoid(affinity) * valid
    share = weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-6)
    everything = valid / valid.sum(dim=1, keepdim=True).clamp_min(1)
    return (torch.stack([share, everything], dim=1) @ token).flatten(1)
