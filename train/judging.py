"""What a round is worth on held-back clouds: its calibration, and its figures for the record."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from train.clouds import CloudSource
from train.states import State

_BINS = 15


def calibrate(after: Sequence[State]) -> tuple[float, float]:
    """a and b of sigmoid(a sure + b), the probability of lying within 1 spacing (Platt scaling).

    Every cloud counts the same. ``after`` are the states after the round; a stays positive, so that ranks are kept.
    """
    sure = torch.cat([_sure(state) for state in after])
    inside = torch.cat([_inside(state) for state in after]).double()
    weight = torch.cat([torch.full((len(s.candidates),), 1 / len(s.candidates)) for s in after]).double()
    numbers = torch.zeros(2, dtype=torch.float64, requires_grad=True)  # log a, b
    optimizer = torch.optim.LBFGS([numbers], max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        entropy = functional.binary_cross_entropy_with_logits(
            numbers[0].exp() * sure + numbers[1], inside, reduction="none"
        )
        # A little pull to the identity keeps the answer finite where all lines, or none, are found.
        loss = (weight * entropy).sum() / weight.sum() + 1e-4 * numbers.square().sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    log_slope, offset = numbers.detach().tolist()
    return float(np.exp(log_slope)), float(offset)


def figures(source: CloudSource, state: State, calibration: tuple[float, float]) -> dict[str, Any]:
    """Errors of the estimates after a round, in spacings, and what the calibrated confidence is worth."""
    error = _error(state)
    probability = torch.sigmoid(calibration[0] * _sure(state) + calibration[1])
    inside = _inside(state)
    return {
        "scene": Path(source.scene).name,
        "fraction": source.fraction,
        "lines": len(error),
        "median": round(float(error.median()), 4),
        "within": round(float(inside.float().mean()), 4),
        "confident_half": round(_best_half(probability, inside), 4),
        "calibration_error": round(_calibration_error(probability, inside), 4),
    }


def _sure(state: State) -> Float[Tensor, " lines"]:
    return torch.logit(state.nodes.confidence.double(), eps=1e-6)


def _error(state: State) -> Float[Tensor, " lines"]:
    return (state.nodes.beta - state.cloud.true_beta).abs() / state.cloud.spacing


def _inside(state: State) -> Bool[Tensor, " lines"]:
    return _error(state) <= 1


def _best_half(probability: Float[Tensor, " lines"], inside: Bool[Tensor, " lines"]) -> float:
    best = probability.argsort(descending=True)[: max(1, len(probability) // 2)]
    return float(inside[best].float().mean())


def _calibration_error(probability: Float[Tensor, " lines"], inside: Bool[Tensor, " lines"]) -> float:
    """Mean distance of the mean probability from the share inside, over bins of equal size."""
    order = probability.argsort()
    parts = zip(probability[order].tensor_split(_BINS), inside[order].double().tensor_split(_BINS), strict=True)
    return float(sum(len(p) * abs(float(p.mean() - right.mean())) for p, right in parts if len(p)) / len(order))
