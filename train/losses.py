"""What the network is trained for: true neighbours, the place of the point, and knowing when it is found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from l2p.attacks.learned.edges import Edges
from l2p.attacks.learned.learned import LearnedConfig, weighted_peak
from l2p.attacks.learned.network import Judgement

#: A candidate at this many local radii is as likely a true neighbour as not; labels fall over a fifth of that.
BORDER, SOFTNESS = 1.25, 0.25
#: Logarithm of the density that a line has where no candidate votes: outliers must not dominate.
BACKGROUND = -5.0
#: Errors, in spacings, beyond which the probe of the states need not tell them apart.
LEAST_ERROR, MOST_ERROR = 0.01, 100.0


class Sample(NamedTuple):
    """Some lines with their truth; ``true_beta`` is counted from the estimate before, as the votes are.

    ``spacing`` is that of each line's cloud.
    """

    edges: Edges
    label: Float[Tensor, "lines k"]
    true_beta: Float[Tensor, " lines"]
    spacing: Float[Tensor, " lines"]

    def to(self, device: torch.device) -> Sample:
        """The same on another device."""
        edges = Edges(*(part.to(device) for part in self.edges))
        return Sample(edges, self.label.to(device), self.true_beta.to(device), self.spacing.to(device))


class Losses(NamedTuple):
    """The terms of the loss, whose sum is trained; how far the estimates moved, and their error in spacings."""

    affinity: Float[Tensor, ""]
    position: Float[Tensor, ""]
    found: Float[Tensor, ""]
    probe: Float[Tensor, ""]
    moved: Float[Tensor, " lines"]
    error: Float[Tensor, " lines"]

    @property
    def total(self) -> Float[Tensor, ""]:
        """The sum of the terms."""
        return self.affinity + self.position + self.found + self.probe


def soft_labels(distance: Float[Tensor, "lines k"], radius: Float[Tensor, " lines"]) -> Float[Tensor, "lines k"]:
    """Whether candidates are true neighbours: 1 near, 0 far, soft in between; ``radius`` is each line's local one."""
    reach = radius[:, None]
    return torch.sigmoid((BORDER * reach - distance) / (SOFTNESS * reach))


def losses(
    sample: Sample,
    judgement: Judgement,
    probe: Float[Tensor, " lines"],
    config: LearnedConfig,
    radii: Sequence[float],
) -> Losses:
    """All terms; ``probe`` is what a linear layer reads from the states as the logarithm of the error."""
    with torch.no_grad():
        moved = weighted_peak(judgement, config)
        error = (moved - sample.true_beta).abs() / sample.spacing
        inside = (error[:, None] <= error.new_tensor(radii)).to(error.dtype)
        size = error.clamp(LEAST_ERROR, MOST_ERROR).log()
    return Losses(
        affinity=affinity_loss(judgement, sample),
        position=position_loss(judgement, sample),
        found=functional.binary_cross_entropy_with_logits(judgement.found, inside),
        probe=0.1 * functional.smooth_l1_loss(probe, size),
        moved=moved,
        error=error,
    )


def affinity_loss(judgement: Judgement, sample: Sample) -> Float[Tensor, ""]:
    """Cross entropy with the soft labels over the candidates that there are."""
    valid = sample.edges.valid
    entropy = functional.binary_cross_entropy_with_logits(
        judgement.affinity.masked_fill(~valid, 0.0), sample.label, reduction="none"
    )
    return (entropy * valid).sum() / valid.sum().clamp_min(1)


def position_loss(judgement: Judgement, sample: Sample) -> Float[Tensor, ""]:
    """Minus the logarithm of the mixture of all votes at the true place, over a floor of outliers."""
    apart = (judgement.place - sample.true_beta[:, None, None]) / judgement.spread
    density = -torch.log1p(apart.square()) - (judgement.spread / sample.spacing[:, None, None]).log()
    share = functional.log_softmax(judgement.vote.flatten(1), dim=1)
    mixture = torch.logsumexp(share + density.flatten(1), dim=1)
    return -torch.logaddexp(mixture, torch.full_like(mixture, BACKGROUND)).mean()
