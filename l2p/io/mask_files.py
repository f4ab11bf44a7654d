"""Masks of images, as COLMAP and hloc have them: black pixels mark what must not be used."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.errors import InputError
from l2p.io.track_means import observations
from l2p.maps.short_repr import short_repr


@dataclass(frozen=True, eq=False)
class Masked:
    """Points of a model that masks of its images mark.

    Attributes
    ----------
    points : (points,) bool
        True for each point that at least one image sees in a black pixel of its mask.
    images : int
        Number of images that see points.
    masks : int
        Number of these that have a mask.
    """

    points: Bool[np.ndarray, " points"]
    images: int
    masks: int

    __repr__ = short_repr


def marked_by_masks(folder: str | PathLike[str], model: Any, ids: Int[np.ndarray, " points"]) -> Masked:
    """Mark the points that at least one image sees in a black pixel of its mask.

    Parameters
    ----------
    folder : path
        The mask of the image ``a/b.jpg`` is ``a/b.jpg.png`` in this folder (COLMAP), or ``a/b.png``; if there are both,
        both count. An image without a mask marks nothing.
    model : pycolmap.Reconstruction
        Its tracks say where images see the points.
    ids : (points,) int64
        ``point3D_id`` of each point.

    Raises
    ------
    InputError
        If there is no such folder, no image has a mask, a mask is no readable picture or of another size than its
        camera, or the model lacks a point.

    Notes
    -----
    As in COLMAP, a keypoint is in the pixel of its coordinates rounded down, and one outside of the picture counts as
    black.
    """
    if not os.path.isdir(folder):
        raise InputError(f"{folder} is not a folder; expected a folder of masks, IMAGE_NAME.png for each image")
    seen = observations(model, ids)
    cameras = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    marked, masks = np.zeros(len(ids), dtype=np.bool_), 0
    for each in seen:
        files = _files_of(folder, each.name)
        masks += bool(files)
        for file in files:
            black = _black(file, (cameras[each.name].width, cameras[each.name].height))
            marked[each.point[_looked_up(black, each.xy)]] = True
    if not masks:
        example = f"{seen[0].name}.png" if seen else "IMAGE_NAME.png"
        raise InputError(f"{folder} has no mask of the {len(seen)} images of the model; expected such as {example}")
    return Masked(marked, len(seen), masks)


def _files_of(folder: str | PathLike[str], name: str) -> list[Path]:
    """Masks of the image of this name."""
    names = dict.fromkeys((f"{name}.png", f"{os.path.splitext(name)[0]}.png"))
    return [path for each in names if (path := Path(folder, each)).is_file()]


def _black(path: Path, size: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Mask of the black pixels of a picture of ``size`` (width, height)."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large pictures: the camera says how large a mask must be
        try:
            with Image.open(path) as image:
                if image.size == size:
                    # Grey already, with 1, 8 or 16 bits: a conversion could cut off bits.
                    grey = (
                        image if image.mode in ("1", "L", "I", "F") or image.mode[:4] == "I;16" else image.convert("L")
                    )
                    return np.asarray(grey) == 0
                found = image.size
        except Exception as error:  # pillow raises many types on damaged files
            reason = " ".join(str(error).split())[:100]
            raise InputError(f"{path} is no readable picture; expected a PNG ({reason})") from error
    raise InputError(
        f"{path} has {found[0]} x {found[1]} pixels; expected the {size[0]} x {size[1]} of the camera of its image"
    )


def _looked_up(
    black: Bool[np.ndarray, "height width"], xy: Float[np.ndarray, "observations 2"]
) -> Bool[np.ndarray, " observations"]:
    """Whether each keypoint (x, y in pixels) is in a black pixel, or outside of the picture."""
    height, width = black.shape
    inside = np.all((xy >= 0) & (xy < (width, height)), axis=1)
    column, row = np.where(inside[:, np.newaxis], xy, 0).astype(np.int64).T
    return ~inside | black[row, column]
