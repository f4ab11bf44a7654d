"""Images, by Pillow."""

from __future__ import annotations

import io

import numpy as np
from jaxtyping import UInt8

#: Endings of images that are written.
IMAGE_ENDINGS = (".png", ".jpg")


def image_bytes(image: UInt8[np.ndarray, "height width 3"], ending: str = ".png") -> bytes:
    """Encode an image."""
    from PIL import Image

    buffer = io.BytesIO()
    kind, options = ("PNG", {"optimize": True}) if ending == ".png" else ("JPEG", {"quality": 90})
    Image.fromarray(image).save(buffer, kind, **options)
    return buffer.getvalue()
