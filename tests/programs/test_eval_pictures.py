"""Side-by-side pictures: how a scene is seen, and what is drawn of it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("hydra", reason="the evaluation program needs the extra train: pip install 'l2p[train]'")

from matplotlib.image import imread
from test_eval import run

from eval.side_by_side import View
from l2p.maps.scene import Scene


def turned(rng: np.random.Generator) -> np.ndarray:
    """A rotation, (3, 3)."""
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return axes * np.sign(np.linalg.det(axes))


@pytest.mark.parametrize("custom", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_cameras_at_one_height_tell_what_is_up(custom: tuple[float, float, float], rng: np.random.Generator) -> None:
    up = np.array(custom) + 0.1 * rng.normal(size=3)
    up /= np.linalg.norm(up)
    axes, _ = np.linalg.qr(np.stack([up, *rng.normal(size=(2, 3))]).T)
    ring = np.linspace(0, 6, 30)
    cameras = np.stack([0.01 * rng.normal(size=30), np.cos(ring), np.sin(ring)], axis=1) @ axes.T
    # A wall is flat, too, but not in the direction that is up.
    wall = rng.uniform(-1, 1, size=(500, 3)) * (3, 3, 0.1) @ axes.T
    view = View.of(Scene(wall, camera_centers=cameras), upright=False)
    assert view.turn[2] @ up > 0.99
    np.testing.assert_allclose(view.turn @ view.turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(view.turn) == pytest.approx(1)


def test_background_does_not_shrink_the_view(rng: np.random.Generator) -> None:
    near, far = rng.uniform(size=(950, 3)), rng.normal((30, 0, 0), 1, size=(50, 3))
    view = View.of(Scene(np.concatenate([near, far])), upright=True)
    assert view.shown(near).all() and not view.shown(far).any()
    assert View.of(Scene(near[:1]), upright=False).shown(near[:1]).shape == (1,)


@pytest.mark.parametrize("color", ["error", "rgb"])
def test_a_picture_has_a_panel_for_the_truth_and_each_method(tmp_path: Path, color: str) -> None:
    pictures = ("pictures.scenes=[sim-room-120-0]", "pictures.fractions=[0.5]", f"pictures.color={color}")
    assert run(tmp_path, "methods=[{name: loo}, {name: tomography}]", "seeds=[0,1]", *pictures) == 0
    files = list((tmp_path / "figures").glob("*.png"))
    assert [file.name for file in files] == ["sim-room-120-0_50.png"]
    image = imread(io.BytesIO(files[0].read_bytes()))[:, :, :3]
    assert (image[0] == 1).all() and (image[:, 0] == 1).all(), "white paper"
    third = image.shape[1] // 3
    for panel in range(3):
        drawn = (image[:, panel * third : (panel + 1) * third] < 0.9).any(axis=2)
        assert drawn.mean() > 0.005
    assert f"figures/{files[0].name}" in (tmp_path / "results.md").read_text()
