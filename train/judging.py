"""What the network is worth on held-back clouds: its calibration, and its figures for the record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from l2p.attacks.learned.features import surroundings
from l2p.attacks.learned.learned import LearnedConfig, judge_round, relaxed
from l2p.attacks.learned.network import RADII, LineTransformer
from l2p.judging.confidence import calibration_error
from train.clouds import Cloud, CloudSource

_ONE = RADII.index(1.0)


@dataclass(frozen=True)
class Judged:
    """Errors of a cloud's lines after a round, in spacings of the cloud, and the network's logits about them."""

    error: Float[Tensor, " lines"]
    sure: Float[Tensor, "lines radii"]


@torch.inference_mode()
def rounds_of(cloud: Cloud, network: LineTransformer, config: LearnedConfig) -> list[Judged]:
    """What every round finds on a cloud."""
    nodes, found = cloud.first_nodes, []
    for number in range(config.rounds):
        result = judge_round(cloud.lines, nodes, cloud.posterior, network, config)
        found.append(Judged((result.told.beta - cloud.true_beta).abs() / cloud.spacing, result.sure))
        if number + 1 < config.rounds:
            nodes = surroundings(cloud.lines, relaxed(nodes, result.told, config))
    return found


def errors_by_round(cloud: Cloud, network: LineTransformer, config: LearnedConfig) -> list[Float[Tensor, " lines"]]:
    """Errors of a cloud's lines after every round, in spacings of the cloud."""
    return [judged.error for judged in rounds_of(cloud, network, config)]


def calibrate(judged: Sequence[Judged]) -> list[tuple[float, float]]:
    """For each radius a and b of sigmoid(a sure + b), the probability of lying within it (Platt scaling).

    Every cloud counts the same; a stays positive, so that ranks are kept.
    """
    weight = torch.cat([torch.full((len(part.error),), 1 / len(part.error)) for part in judged]).double()
    sure = torch.cat([part.sure for part in judged]).double()
    error = torch.cat([part.error for part in judged])
    return [_platt(sure[:, place], error <= radius, weight) for place, radius in enumerate(RADII)]


def _platt(
    sure: Float[Tensor, " lines"], inside: Bool[Tensor, " lines"], weight: Float[Tensor, " lines"]
) -> tuple[float, float]:
    numbers = torch.zeros(2, dtype=torch.float64, requires_grad=True)  # log a, b
    optimizer = torch.optim.LBFGS([numbers], max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        entropy = functional.binary_cross_entropy_with_logits(
            numbers[0].exp() * sure + numbers[1], inside.double(), reduction="none"
        )
        # A little pull to the identity keeps the answer finite where all lines, or none, are found.
        loss = (weight * entropy).sum() / weight.sum() + 1e-4 * numbers.square().sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    log_slope, offset = numbers.detach().tolist()
    return float(np.exp(log_slope)), float(offset)


def figures(
    source: CloudSource, judged: Sequence[Judged], calibration: Sequence[tuple[float, float]]
) -> dict[str, Any]:
    """Errors after every round, and what the calibrated confidence of the last one is worth; for one cloud."""
    error, sure = judged[-1].error, judged[-1].sure[:, _ONE].double()
    slope, offset = calibration[_ONE]
    probability, inside = torch.sigmoid(slope * sure + offset), error <= 1
    best = probability.argsort(descending=True)[: max(1, len(probability) // 2)]
    return {
        "scene": source.name,
        "fraction": source.fraction,
        "lines": len(error),
        "median": [round(float(part.error.median()), 4) for part in judged],
        "within": [round(float((part.error <= 1).float().mean()), 4) for part in judged],
        "confident_half": round(float(inside[best].float().mean()), 4),
        "calibration_error": round(calibration_error(probability.numpy(), inside.numpy()), 4),
    }
