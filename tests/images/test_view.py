"""Views: where cameras see points, for all camera models, and cameras that users place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from l2p.errors import InputError
from l2p.images.views import View, panorama_view, placed_view, view_of
from l2p.simulator import simulate_model


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("views") / "model"
    simulate_model("room", 300, 1).save_colmap(folder)
    return folder


def camera(kind: str, *params: float) -> pycolmap.Camera:
    return pycolmap.Camera(model=kind, width=320, height=240, params=list(params))


def at_origin(kind: str, *params: float) -> View:
    return View(np.eye(3), np.zeros(3), camera(kind, *params))


def test_a_pinhole_sees_points_where_the_formula_says(rng):
    view = placed_view(rng.normal(size=3), rng.normal(size=3) * 5, np.array([0, 0, 1.0]), angle=70)
    xyz = rng.normal(size=(200, 3)) * 4
    pixel, distance = view.seen(xyz)
    focal = 160 / np.tan(np.radians(35))
    for row in range(200):
        x, y, z = view.rotation @ xyz[row] + view.translation
        expected = np.array([focal * x / z + 160, focal * y / z + 120])
        inside = z > 0 and 0 <= expected[0] < 320 and 0 <= expected[1] < 240
        assert np.isfinite(pixel[row]).all() == inside
        if inside:
            np.testing.assert_allclose(pixel[row], expected, atol=1e-6)
    np.testing.assert_allclose(distance, np.linalg.norm(xyz @ view.rotation.T + view.translation, axis=1))


def test_a_placed_camera_looks_at_its_target_with_up_above(rng):
    center, toward, up = rng.normal(size=3), rng.normal(size=3), np.array([0.1, -1, 0.2])
    view = placed_view(center, toward, up)
    middle, above = view.seen(np.stack([toward, toward + 0.05 * up]))[0]
    np.testing.assert_allclose(middle, [160, 120], atol=1e-6)
    assert above[1] < middle[1]
    np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view.rotation) > 0


@pytest.mark.parametrize(
    ("kind", "params"),
    [
        ("SIMPLE_RADIAL", (200, 160, 120, -0.2)),
        ("OPENCV", (200, 210, 160, 120, 0.1, -0.05, 0.001, 0.002)),
        ("OPENCV_FISHEYE", (150, 150, 160, 120, 0.01, 0.0, 0.0, 0.0)),
        ("FULL_OPENCV", (200, 210, 160, 120, 0.1, -0.05, 0.001, 0.002, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_every_seen_point_lies_on_the_ray_of_its_pixel(rng, kind, params):
    view = at_origin(kind, *params)
    xyz = rng.normal(size=(500, 3)) * [2, 2, 1] + [0, 0, 1]
    pixel, _ = view.seen(xyz)
    seen = np.isfinite(pixel[:, 0])
    assert 0 < seen.sum() < 500
    ray = np.asarray(view.camera.cam_from_img(pixel[seen]))
    np.testing.assert_allclose(ray[:, :2], xyz[seen, :2] / xyz[seen, 2:], atol=5e-3)


def test_points_that_the_distortion_folds_back_are_not_seen():
    """Far outside of the image, r + k r^3 comes back into it."""
    view = at_origin("SIMPLE_RADIAL", 200, 160, 120, -0.3)
    folded = np.array([[1.8, 0, 1.0]])
    assert 0 <= view.camera.img_from_cam(folded)[0, 0] < 320
    assert np.isnan(view.seen(folded)[0]).all()


def test_a_panorama_sees_all_directions(rng):
    center = rng.normal(size=3)
    view = panorama_view(center, np.array([0, 0, 1.0]))
    pixel, distance = view.seen(center + rng.normal(size=(300, 3)))
    assert np.isfinite(pixel).all() and (distance > 0).all()
    top, bottom = view.seen(center + np.array([[1e-3, 0, 1], [1e-3, 0, -1]]))[0][:, 1]
    assert top < 2 and bottom > view.height - 2


def test_views_of_a_model_are_scaled_to_the_long_side(model):
    reconstruction = pycolmap.Reconstruction(str(model))
    image = next(iter(reconstruction.images.values()))
    view = view_of(reconstruction, image.name, 160)
    full = reconstruction.cameras[image.camera_id]
    assert max(view.width, view.height) == 160
    xyz = np.array([point.xyz for point in reconstruction.points3D.values()])
    pixel, _ = view.seen(xyz)
    seen = np.isfinite(pixel[:, 0])
    local = xyz[seen] @ view.rotation.T + view.translation
    whole = np.asarray(full.img_from_cam(local))
    np.testing.assert_allclose(pixel[seen], whole * 160 / max(full.width, full.height), atol=0.02)


def test_unknown_views_and_impossible_cameras_are_refused(model):
    with pytest.raises(InputError, match=r"got view 'nowhere.jpg'; expected one of the .* images of known pose: "):
        view_of(pycolmap.Reconstruction(str(model)), "nowhere.jpg")
    up = np.array([0, 0, 1.0])
    for toward in (np.zeros(3), np.array([0, 0, 2.0]), np.full(3, np.nan)):
        with pytest.raises(InputError, match="got a camera that looks along its up direction, or at its own place"):
            placed_view(np.zeros(3), toward, up)
    with pytest.raises(InputError, match="got angle 180; expected 5 to 150 degrees"):
        placed_view(np.zeros(3), np.ones(3), up, angle=180)
    with pytest.raises(InputError, match="got an up direction of length 0"):
        panorama_view(np.zeros(3), np.zeros(3))
