"""The posterior of each line's point, as the tomography computes it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Posterior(NamedTuple):
    """Posterior of the point on each line: samples along the line and their probabilities, which sum to 1.

    A line that misses the box has probability 0 everywhere. ``step`` is the distance of neighbouring samples. Where a
    line passes through a pair of points, the probabilities sum to 2, and ``pair`` holds its two most probable places.
    """

    beta: Float[Tensor, "lines m"]
    probability: Float[Tensor, "lines m"]
    step: Float[Tensor, " lines"]
    pair: Float[Tensor, "lines 2"] | None = None


def modes(posterior: Posterior) -> tuple[Float[Tensor, " lines"], Float[Tensor, " lines"]]:
    """Return the most probable position on each line and its probability.

    Samples in one cell are equally probable: their middle is taken, and of several such cells the one nearest to the
    foot, whatever the direction of the line.
    """
    probability = posterior.probability.amax(dim=1)
    equal = posterior.probability >= (1 - 1e-5) * probability[:, None]
    nearest = posterior.beta.abs().masked_fill(~equal, torch.inf).argmin(dim=1, keepdim=True)
    apart = (posterior.beta - posterior.beta.gather(1, nearest)).abs()
    equal &= apart <= 1.5 * posterior.step[:, None]
    beta = (posterior.beta * equal).sum(dim=1) / equal.sum(dim=1)
    return beta.masked_fill(probability == 0, 0), probability


def first_places(posterior: Posterior, twin: Int[Tensor, " elements"] | None, own: slice) -> Float[Tensor, " own"]:
    """Return the mode of each line of this process; of a pair, one of its two places for each of its points.

    ``twin`` is the other point on the line of each element, ``own`` the elements of this process.
    """
    if posterior.pair is None or twin is None:
        return modes(posterior)[0]
    first = (torch.arange(len(twin), device=twin.device) < twin)[own]
    return torch.where(first, posterior.pair[:, 0], posterior.pair[:, 1])


def mass_within(
    posterior: Posterior, beta: Float[Tensor, " lines"], radius: float | Float[Tensor, " lines"]
) -> Float[Tensor, " lines"]:
    """Posterior probability that a line's point lies within ``radius`` of ``beta``: a confidence."""
    reach = torch.as_tensor(radius, device=beta.device, dtype=beta.dtype).expand_as(beta)
    near = (posterior.beta - beta[:, None]).abs() <= reach[:, None]
    return (posterior.probability * near).sum(dim=1).clamp(0, 1)
