"""Photographs of a model's views, read at the size of a picture."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from l2p.errors import InputError
from l2p.images.views import View

#: Folders beside a model, and above it, in which photographs are looked for.
FOLDERS = ("images", "thumbs")


def folder_beside(model: str | PathLike[str]) -> Path | None:
    """Find the folder of photographs of a model: ``images`` or ``thumbs`` in it or up to two folders above."""
    here = Path(model).resolve()
    for folder in (here, *list(here.parents)[:2]):
        for name in FOLDERS:
            if (folder / name).is_dir():
                return folder / name
    return None


def photograph(folder: str | PathLike[str], view: View) -> UInt8[np.ndarray, "height width 3"]:
    """Read the photograph of a view, at the size of its camera.

    Raises
    ------
    FileNotFoundError
        If the folder has no such image.
    InputError
        If it cannot be read, or its sides have another ratio than the camera's.
    """
    from PIL import Image, UnidentifiedImageError

    path = Path(folder) / view.name
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; give the folder of the model's photographs")
    try:
        with Image.open(path) as file:
            image = file.convert("RGB")
    except (UnidentifiedImageError, OSError) as error:
        raise InputError(f"{path} is no image that can be read ({error})") from error
    # Rounding to whole pixels moves a side of a small photograph by one.
    if abs(image.width * view.height - image.height * view.width) > 2 * max(image.size):
        raise InputError(
            f"{path} has {image.width} x {image.height} pixels, and its camera {view.width} x {view.height}; expected "
            "the photograph that the model was made from"
        )
    return np.asarray(image.resize((view.width, view.height), Image.Resampling.BOX), dtype=np.uint8).copy()
