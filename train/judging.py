"""Evaluation of the network on held-back clouds: calibration, and figures for the record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from l2p.attacks.learned.learned import Learned
from l2p.judging.calibration import calibration_error
from train.clouds import Cloud, CloudSource


@dataclass(frozen=True)
class Judged:
    """Errors of a cloud's lines after a round, in spacings of the cloud, and the network's logits for each radius."""

    error: Float[Tensor, " lines"]
    found: Float[Tensor, "lines radii"]


@torch.inference_mode()
def rounds_of(cloud: Cloud, attack: Learned) -> list[Judged]:
    """Judge a cloud after every round."""
    attack.network.eval()
    state, judged = cloud.state(), []
    last = attack.rounds_of(cloud.elements)
    for number in range(last + 1):
        result = attack.judge(state)
        beta = result.estimates.beta
        judged.append(Judged((beta - cloud.true_near(beta)).abs() / cloud.spacing, result.found))
        if number < last:
            state = attack.next(state, result)
    return judged


def calibrate(judged: Sequence[Judged], radii: Sequence[float]) -> list[tuple[float, float]]:
    """Fit (a, b) for each radius: sigmoid(a found + b) is the probability of lying within it (Platt scaling).

    All clouds have equal weight; a is positive, so that the order does not change.
    """
    weight = torch.cat([torch.full((len(part.error),), 1 / len(part.error)) for part in judged]).double()
    found = torch.cat([part.found for part in judged]).double()
    error = torch.cat([part.error for part in judged])
    return [_platt(found[:, place], error <= radius, weight) for place, radius in enumerate(radii)]


def _platt(
    found: Float[Tensor, " lines"], inside: Bool[Tensor, " lines"], weight: Float[Tensor, " lines"]
) -> tuple[float, float]:
    numbers = torch.zeros(2, dtype=torch.float64, requires_grad=True)  # log a, b
    optimizer = torch.optim.LBFGS([numbers], max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        entropy = functional.binary_cross_entropy_with_logits(
            numbers[0].exp() * found + numbers[1], inside.double(), reduction="none"
        )
        # A weak prior on the identity keeps the fit finite if all lines, or none, are found.
        loss = (weight * entropy).sum() / weight.sum() + 1e-4 * numbers.square().sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    log_slope, offset = numbers.detach().tolist()
    return float(np.exp(log_slope)), float(offset)


def figures(
    source: CloudSource, known: str, judged: Sequence[Judged], calibration: Sequence[tuple[float, float]], one: int
) -> dict[str, Any]:
    """Compute errors after every round, and figures of the calibrated confidence of the last one, for one cloud.

    ``known`` is the knowledge of the attack, ``one`` the index of the radius of 1 spacing.
    """
    error, found = judged[-1].error, judged[-1].found[:, one].double()
    slope, offset = calibration[one]
    probability, inside = torch.sigmoid(slope * found + offset), error <= 1
    best = probability.argsort(descending=True)[: max(1, len(probability) // 2)]
    return {
        "scene": source.name,
        "fraction": source.fraction,
        "known": known,
        "lines": len(error),
        "median": [round(float(part.error.median()), 4) for part in judged],
        "within": [round(float((part.error <= 1).float().mean()), 4) for part in judged],
        "confident_half": round(float(inside[best].float().mean()), 4),
        "calibration_error": round(calibration_error(probability.numpy(), inside.numpy()), 4),
    }
