"""The line transformer: which of a line's candidates are true neighbours, judged by how well their votes agree.

A candidate's token holds the features of its pair and the state that the candidate took from the round before.
Tokens of one line attend to each other by where they vote: in head h token j reaches token i with the weight
1 / (1 + ((t_i - t_j) / (s_h w_j))^2)^2, where t is a position along the line, w_j the candidate's local scale and s_h
the width of the head. The weights are *not* normalised over j: how many candidates agree is what matters, and a
softmax would divide it out. States carry what a line has found to the lines around it, round by round.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from l2p.features import EDGE, STATE, Edges


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of one round's network.

    Attributes
    ----------
    width : int
        Numbers in a token.
    layers : int
        Attention layers.
    heads : int
        Widths s_h of the attention, spread geometrically from ``finest`` to ``widest`` local scales.
    """

    width: int = 48
    layers: int = 2
    heads: int = 4
    finest: float = 0.15
    widest: float = 4.0

    def __post_init__(self) -> None:
        if self.width % self.heads:
            raise ValueError(f"got width {self.width} and {self.heads} heads; expected a width that they divide")


class Judgement(NamedTuple):
    """The network's word on each line.

    ``affinity`` and ``vote`` are logits: of each candidate being a true neighbour, and of the point being where the
    candidate's two votes, closest point and foot, are. ``state`` is handed to the next round, ``sure`` is the logit
    of the line's point being found.
    """

    affinity: Float[Tensor, "lines k"]
    vote: Float[Tensor, "lines k 2"]
    state: Float[Tensor, "lines state"]
    sure: Float[Tensor, " lines"]


class PositionAttention(nn.Module):
    """Tokens attend to each other by position along the line; the kernel matrices are shared by all layers."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.value = nn.Linear(width, width)
        self.mix = nn.Linear(2 * width, width)
        self.expand = nn.Linear(width, 2 * width)
        self.shrink = nn.Linear(2 * width, width)
        self.heads = heads

    def forward(
        self, token: Float[Tensor, "lines k width"], kernel: Float[Tensor, "lines heads k k"]
    ) -> Float[Tensor, "lines k width"]:
        """One layer: gather what agrees, then think about it."""
        normal = self.norm(token)
        value = self.value(normal).unflatten(2, (self.heads, -1)).transpose(1, 2)  # lines heads k dim
        gathered = (kernel @ value).transpose(1, 2).flatten(2)  # lines k width
        # Counts range over orders of magnitude.
        gathered = gathered.sign() * torch.log1p(gathered.abs())
        token = token + self.mix(torch.cat([normal, gathered], dim=2))
        return token + self.shrink(nn.functional.gelu(self.expand(token)))


class LineTransformer(nn.Module):
    """Judges the candidates of each line on its own: the answer does not depend on the batch."""

    def __init__(self, config: NetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config or NetworkConfig()
        width, heads = self.config.width, self.config.heads
        self.embed = nn.Sequential(nn.Linear(len(EDGE) + STATE, width), nn.GELU(), nn.Linear(width, width))
        # Logarithms of the spread of the two kinds of votes, in local scales (closest points, feet).
        self.log_spread = nn.Parameter(torch.tensor([-1.0, -1.5]))
        self.layers = nn.ModuleList(PositionAttention(width, heads) for _ in range(self.config.layers))
        self.norm = nn.LayerNorm(width)
        self.judge = nn.Linear(width, 3)
        self.pool = nn.Sequential(nn.Linear(2 * width, width), nn.GELU(), nn.Linear(width, STATE + 1))

    def forward(self, edges: Edges) -> Judgement:
        """Judge the candidates; padding gets the logit -inf."""
        token = self.embed(torch.cat([edges.feature, edges.state], dim=2))
        kernel = self._kernel(edges)
        for layer in self.layers:
            token = layer(token, kernel)
        token = self.norm(token)
        affinity, closest, foot = self.judge(token).unbind(2)
        valid = edges.valid
        affinity = affinity.masked_fill(~valid, -torch.inf)
        vote = torch.stack([closest, foot], dim=2).masked_fill(~valid[..., None], -1e9)
        state = self.pool(_pooled(token, affinity, valid))
        return Judgement(affinity, vote, torch.tanh(state[:, :STATE]), state[:, STATE])

    def _kernel(self, edges: Edges) -> Float[Tensor, "lines heads k k"]:
        apart = ((edges.foot[:, :, None] - edges.foot[:, None, :]) / edges.width[:, None, :]).square_()
        ratio = (self.config.widest / self.config.finest) ** (1 / max(self.config.heads - 1, 1))
        widths = [self.config.finest * ratio**head for head in range(self.config.heads)]
        kernel = torch.stack([(apart / width**2).add_(1).square_().reciprocal_() for width in widths], dim=1)
        return kernel * edges.valid[:, None, None, :]


def _pooled(
    token: Float[Tensor, "lines k width"], affinity: Float[Tensor, "lines k"], valid: Bool[Tensor, "lines k"]
) -> Float[Tensor, "lines two_widths"]:
    """Mean token by affinity, and over all candidates."""
    weight = torch.sigmoid(affinity)
    share = (weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-6))[..., None]
    everything = (valid / valid.sum(dim=1, keepdim=True).clamp_min(1))[..., None]
    return torch.cat([(share * token).sum(dim=1), (everything * token).sum(dim=1)], dim=1)
