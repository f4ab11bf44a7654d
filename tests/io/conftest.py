"""A small COLMAP model for the tests of files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def write_model() -> Callable[..., Path]:
    """Write a synthetic model, bin or txt, into a new folder: 8 images of two rigs, not every keypoint has a point."""

    def write(folder: Path, points: int = 40, text: bool = False, seed: int = 0) -> Path:
        import pycolmap

        pycolmap.set_random_seed(seed)
        options = pycolmap.SyntheticDatasetOptions()
        options.num_points3D, options.num_frames_per_rig, options.track_length = points, 4, 5
        model = pycolmap.synthesize_dataset(options)
        for key in list(model.point3D_ids())[::7]:
            model.delete_point3D(key)
        folder.mkdir()
        (model.write_text if text else model.write_binary)(str(folder))
        return folder

    return write
