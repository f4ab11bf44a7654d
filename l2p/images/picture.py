"""A picture: what a camera would have seen, computed from points by the inversion network."""

from __future__ import annotations

from functools import lru_cache
from os import PathLike

import numpy as np
import torch
from jaxtyping import UInt8

from l2p.errors import InputError
from l2p.images.inversion import Inversion
from l2p.images.inversion_file import load_inversion, shipped_inversion
from l2p.images.panorama import rays_seen
from l2p.images.picture_points import PicturePoints, points_of
from l2p.images.projection import Marks, marks, sighted
from l2p.images.views import View, view_of
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene


def picture(
    source: Scene | Recovery | LineCloud,
    view: View | str,
    *,
    model: str | PathLike[str] | None = None,
    lines: LineCloud | None = None,
    weights: str | PathLike[str] | None = None,
) -> UInt8[np.ndarray, "height width 3"]:
    """Compute the picture that points or rays give of a view.

    Parameters
    ----------
    source : Scene, Recovery or LineCloud
        True points; recovered points; or a cloud of lines through few centres, seen from the largest
        (:func:`l2p.images.panorama.rays_seen`).
    view : View or str
        A camera at a place (:mod:`l2p.images.views`), or the name of an image of the model.
    model : path, optional
        COLMAP model that has the image.
    lines : LineCloud, optional
        The lines of a recovery, for their descriptors.
    weights : path, optional
        Weights of ``python -m train --config-name pictures``; default: those installed with the package.

    Returns
    -------
    (height, width, 3) uint8

    Raises
    ------
    FileNotFoundError
        If there are no such weights or no such model.
    InputError
        If the view is unknown, a name is given without a model, the weights cannot be used, or the source does not
        show anything: neither colours nor SIFT descriptors.

    Notes
    -----
    Points are drawn with their colours and SIFT descriptors, where they have them. The network was trained on pictures
    of 320 pixels; larger ones are sparser than what it knows.
    """
    if isinstance(view, str):
        if model is None:
            raise InputError(f"got the name of a view, {view!r}, without a model; expected the model that has it")
        from l2p.io.colmap import read_model

        view = view_of(read_model(model), view)
    points = rays_seen(source)[0] if isinstance(source, LineCloud) else points_of(source, lines)
    path = shipped_inversion() if weights is None else weights
    return draw(_network(str(path)), points, view)


@lru_cache(maxsize=2)
def _network(path: str) -> Inversion:
    return load_inversion(path)[0]


def draw(network: Inversion, points: PicturePoints, view: View) -> UInt8[np.ndarray, "height width 3"]:
    """Compute the picture of a view."""
    xyz, confidence, appearance = points
    found = marks(sighted(xyz, confidence, view), appearance, confidence)
    multiple = network.config.multiple
    height, width = (-(-side // multiple) * multiple for side in (view.height, view.width))
    device = next(network.parameters()).device
    with torch.inference_mode():
        place = found.place // view.width * width + found.place % view.width
        on_device = Marks(*(part.to(device) for part in found._replace(place=place)))
        made = network(on_device, (1, height, width))[0, :, : view.height, : view.width]
        return (made.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
