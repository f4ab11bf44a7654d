"""Losses of the network: affinity of true neighbours, position of the point, and confidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from l2p.attacks.learned.edges import Edges
from l2p.attacks.learned.learned import weighted_peak
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import Judgement

#: Distance, in local radii, at which the label of a candidate is 1/2, and the scale of its sigmoid.
BORDER, SOFTNESS = 1.25, 0.25
#: Logarithm of the least density at the true position: lines without correct votes must not dominate.
BACKGROUND = -5.0
#: Range, in spacings, to which errors are clamped for the probe of the states.
LEAST_ERROR, MOST_ERROR = 0.01, 100.0


class Sample(NamedTuple):
    """Lines with their truth; ``true_beta`` is relative to the last estimate, as are votes.

    ``spacing`` is that of each line's cloud, in the frame's unit.
    """

    edges: Edges
    label: Float[Tensor, "lines k"]
    true_beta: Float[Tensor, " lines"]
    spacing: Float[Tensor, " lines"]

    def to(self, device: torch.device) -> Sample:
        """Copy to another device."""
        edges = Edges(*(column.to(device) for column in self.edges))
        return Sample(edges, self.label.to(device), self.true_beta.to(device), self.spacing.to(device))


class Losses(NamedTuple):
    """Terms of the loss, whose sum is minimised; displacements of the estimates, and their errors in spacings."""

    affinity: Float[Tensor, ""]
    position: Float[Tensor, ""]
    found: Float[Tensor, ""]
    probe: Float[Tensor, ""]
    moved: Float[Tensor, " lines"]
    error: Float[Tensor, " lines"]

    @property
    def total(self) -> Float[Tensor, ""]:
        """Sum of the terms."""
        return self.affinity + self.position + self.found + self.probe


def soft_labels(distance: Float[Tensor, "lines k"], radius: Float[Tensor, " lines"]) -> Float[Tensor, "lines k"]:
    """Labels of candidates: 1 for true neighbours, 0 far away, soft between; ``radius`` is the local radius."""
    reach = radius[:, None]
    return torch.sigmoid((BORDER * reach - distance) / (SOFTNESS * reach))


def losses(
    sample: Sample,
    judgement: Judgement,
    probe: Float[Tensor, " lines"],
    config: LearnedConfig,
    radii: Sequence[float],
) -> Losses:
    """Compute all terms; ``probe`` is the logarithm of the error, predicted from the states by a linear layer."""
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
    """Mean cross entropy with the soft labels over valid candidates."""
    valid = sample.edges.valid
    entropy = functional.binary_cross_entropy_with_logits(
        judgement.affinity.masked_fill(~valid, 0.0), sample.label, reduction="none"
    )
    return (entropy * valid).sum() / valid.sum().clamp_min(1)


def position_loss(judgement: Judgement, sample: Sample) -> Float[Tensor, ""]:
    """Negative log density of the mixture of all votes at the true position, with a floor for outliers."""
    residual = (judgement.place - sample.true_beta[:, None, None]) / judgement.spread
    density = -torch.log1p(residual.square()) - (judgement.spread / sample.spacing[:, None, None]).log()
    share = functional.log_softmax(judgement.vote.flatten(1), dim=1)
    mixture = torch.logsumexp(share + density.flatten(1), dim=1)
    return -torch.logaddexp(mixture, torch.full_like(mixture, BACKGROUND)).mean()
