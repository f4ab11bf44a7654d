"""How like two pictures are: PSNR and SSIM."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

#: Gaussian window and constants of Wang et al. ("Image quality assessment: from error visibility to structural
#: similarity", IEEE TIP 2004), for values in [0, 1].
_SIGMA, _RADIUS = 1.5, 5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(one: Float[Tensor, "*pictures 3 height width"], other: Float[Tensor, "*pictures 3 height width"]) -> float:
    """Peak signal-to-noise ratio in decibels, of values in [0, 1]; infinite for equal pictures."""
    return float(-10 * torch.log10(functional.mse_loss(one, other)))


def ssim(
    one: Float[Tensor, "pictures 3 height width"], other: Float[Tensor, "pictures 3 height width"]
) -> Float[Tensor, ""]:
    """Structural similarity, the mean over channels and over the pixels whose window lies in the picture: 1 for equal
    pictures."""
    at = torch.arange(-_RADIUS, _RADIUS + 1, dtype=one.dtype, device=one.device)
    window = torch.exp(-(at**2) / (2 * _SIGMA**2))
    window = window / window.sum()
    stack = torch.cat([one, other, one * one, other * other, one * other])
    flat = stack.reshape(-1, 1, *stack.shape[2:])
    flat = functional.conv2d(functional.conv2d(flat, window.view(1, 1, -1, 1)), window.view(1, 1, 1, -1))
    mean1, mean2, square1, square2, product = flat.chunk(5)
    variance1, variance2, covariance = square1 - mean1**2, square2 - mean2**2, product - mean1 * mean2
    ratio = (2 * mean1 * mean2 + _C1) * (2 * covariance + _C2)
    return (ratio / ((mean1**2 + mean2**2 + _C1) * (variance1 + variance2 + _C2))).mean()


class Likeness(NamedTuple):
    """PSNR in decibels, and SSIM."""

    psnr: float
    ssim: float


def likeness(one: UInt8[np.ndarray, "height width 3"], other: UInt8[np.ndarray, "height width 3"]) -> Likeness:
    """Compare two pictures of one size."""
    first, second = (torch.from_numpy(each).permute(2, 0, 1)[None].float() / 255 for each in (one, other))
    return Likeness(psnr(first, second), float(ssim(first, second)))
