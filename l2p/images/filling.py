"""Filling between coloured points by a Gaussian: the picture that needs no network."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch.nn import functional

from l2p.errors import InputError
from l2p.images.picture_points import PicturePoints
from l2p.images.projection import sighted
from l2p.images.views import View

#: Name of the method in tables.
FILL_NAME = "filled"
#: Standard deviation of the Gaussian, pixels. Where it meets no point it is doubled, up to the widest; beyond, a pixel
#: has the mean colour.
SIGMA, WIDEST = 4.0, 64.0
#: Weight of the points around a pixel below which the next wider Gaussian takes over.
_THIN = 1e-3


def gaussian_fill(points: PicturePoints, view: View) -> UInt8[np.ndarray, "height width 3"]:
    """Colour each pixel by the mean of the points around it, weighted by their confidence and a Gaussian
    (normalised convolution: Knutsson and Westin, CVPR 1993).

    Raises
    ------
    InputError
        If the points have no colours.
    """
    xyz, confidence, appearance = points
    if appearance.rgb is None:
        raise InputError("got points without colours; expected colours to fill between")
    found = sighted(xyz, confidence, view)
    weight = torch.from_numpy(np.maximum(confidence[found.row], 1e-3).astype(np.float32))
    color = torch.from_numpy(appearance.rgb[found.row].astype(np.float32) / 255)
    sums = torch.zeros(view.height * view.width, 4)
    sums.index_add_(0, torch.from_numpy(found.place), torch.cat([color * weight[:, None], weight[:, None]], dim=1))
    sums = sums.T.reshape(4, 1, view.height, view.width)
    total = sums.sum(dim=(2, 3), keepdim=True)
    picture = (total[:3] / total[3:].clamp_min(1e-12)).expand(3, 1, view.height, view.width)
    sigma, wide = SIGMA, []
    while sigma <= WIDEST:
        wide.append(_blurred(sums, sigma))
        sigma *= 2
    for around in reversed(wide):  # from wide to narrow
        mass = around[3:] * 2 * math.pi * SIGMA**2
        picture = torch.where(mass > _THIN, around[:3] / around[3:].clamp_min(1e-12), picture)
    return (picture[:, 0].clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()


def _blurred(
    planes: Float[torch.Tensor, "planes 1 height width"], sigma: float
) -> Float[torch.Tensor, "planes 1 height width"]:
    radius = math.ceil(3 * sigma)
    at = torch.arange(-radius, radius + 1, dtype=torch.float32)
    window = torch.exp(-(at**2) / (2 * sigma**2))
    window = window / window.sum()
    planes = functional.conv2d(planes, window.view(1, 1, -1, 1), padding=(radius, 0))
    return functional.conv2d(planes, window.view(1, 1, 1, -1), padding=(0, radius))
