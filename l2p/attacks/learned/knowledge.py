"""What an attack knows of the lines, by name: its confidence has a calibration for each, at several radii."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from l2p.attacks.learned.embedding import OTHER
from l2p.attacks.learned.network import NetworkConfig

#: Knowledge of an attack that sees lines alone.
LINES_ALONE = "lines"
#: For each knowledge, round and radius, (a, b).
Calibrations = Mapping[str, Sequence[Sequence[tuple[float, float]]]]


def knowledges(config: NetworkConfig) -> tuple[str, ...]:
    """List all that a network can know."""
    if not config.appearance:
        return (LINES_ALONE,)
    return (LINES_ALONE, "rgb", "descriptor", "rgb+descriptor", OTHER, f"rgb+{OTHER}")


def between_radii(
    logit: Float[Tensor, "lines radii"], radii: Sequence[float], log_radius: float
) -> Float[Tensor, " lines"]:
    """Interpolate the logit at a radius, linearly in the logarithm of the radius.

    Below the smallest radius it is extrapolated: the probability falls to 0 with the radius.
    """
    known = [math.log(radius) for radius in radii]
    after = min(max(sum(radius <= log_radius for radius in known), 1), len(known) - 1)
    share = (log_radius - known[after - 1]) / (known[after] - known[after - 1])
    return torch.lerp(logit[:, after - 1], logit[:, after], share)
