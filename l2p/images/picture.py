"""A picture: what a camera would have seen, computed from points by the inversion network."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import UInt8

from l2p.images.inversion import Inversion
from l2p.images.points import PicturePoints
from l2p.images.projection import Marks, marks, sighted
from l2p.images.view import View


def draw(network: Inversion, points: PicturePoints, view: View) -> UInt8[np.ndarray, "height width 3"]:
    """Compute the picture of a view."""
    xyz, confidence, appearance = points
    found = marks(sighted(xyz, confidence, view), appearance, confidence)
    multiple = network.config.multiple
    height, width = (-(-side // multiple) * multiple for side in (view.height, view.width))
    place = found.place // view.width * width + found.place % view.width
    device = next(network.parameters()).device
    with torch.inference_mode():
        on_device = Marks(*(part.to(device) for part in found._replace(place=place)))
        picture = network(on_device, (1, height, width))[0, :, : view.height, : view.width]
        return (picture.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
