"""Queries: rays of every camera model, the map without a query, and models that hold no queries."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from l2p.errors import InputError
from l2p.io.colmap import read_model, scene_of_model
from l2p.utility.queries import Queries, evenly, queries_of, rays_of

WIDTH, HEIGHT = 1000, 800
#: Parameters of every camera model, with distortion, and the largest angle of its rays here, degrees.
CAMERAS: dict[str, tuple[list[float], float]] = {
    "SIMPLE_PINHOLE": ([600, 510, 390], 40),
    "PINHOLE": ([600, 620, 510, 390], 40),
    "SIMPLE_RADIAL": ([600, 510, 390, -0.1], 35),
    "RADIAL": ([600, 510, 390, -0.1, 0.01], 35),
    "OPENCV": ([600, 620, 510, 390, -0.1, 0.01, 0.001, -0.002], 35),
    "FULL_OPENCV": ([600, 620, 510, 390, -0.1, 0.01, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001], 35),
    "SIMPLE_DIVISION": ([600, 510, 390, -0.1], 35),
    "DIVISION": ([600, 620, 510, 390, -0.1], 35),
    "FOV": ([600, 620, 510, 390, 0.5], 40),
    "SIMPLE_FISHEYE": ([300, 510, 390], 85),
    "FISHEYE": ([300, 310, 510, 390], 85),
    "SIMPLE_RADIAL_FISHEYE": ([300, 510, 390, 0.01], 80),
    "RADIAL_FISHEYE": ([300, 510, 390, 0.01, -0.002], 80),
    "OPENCV_FISHEYE": ([300, 310, 510, 390, 0.02, -0.01, 0.002, -0.0003], 85),
    "THIN_PRISM_FISHEYE": ([300, 310, 510, 390, 0.01, -0.002, 0.0005, 0.0005, 0.001, 0.0001, 0.0005, -0.0005], 70),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        [300, 310, 510, 390, 0.01, -0.002, 0.001, 0.0, 0.0, 0.0, 0.0005, -0.0005, 0.0005, 0.0001, 0.0005, 0.0001],
        70,
    ),
    "EUCM": ([500, 510, 510, 390, 0.6, 1.1], 70),
    "EQUIRECTANGULAR": ([WIDTH, HEIGHT], 180),
}


def camera_of(name: str) -> Any:
    return pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=CAMERAS[name][0], camera_id=1)


def known() -> list[str]:
    return [name for name in pycolmap.CameraModelId.__members__ if name not in ("INVALID", "UNDEFINED")]


def rays(widest: float, rng: np.random.Generator, count: int = 60) -> np.ndarray:
    """Unit rays up to an angle from the axis, degrees."""
    angle, around = np.radians(rng.uniform(1, widest, count)), rng.uniform(-np.pi, np.pi, count)
    return np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])


def projected(camera: Any, ray: np.ndarray) -> np.ndarray:
    return np.array([camera.img_from_cam(each[:, None], False) for each in ray]).reshape(-1, 2)


def angle(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(one, other), axis=-1), (one * other).sum(axis=-1))


def test_every_camera_model_of_pycolmap_is_tested():
    assert set(known()) <= set(CAMERAS)


@pytest.mark.parametrize("name", known())
def test_rays_come_back_from_their_pixels(rng, name):
    camera, ray = camera_of(name), rays(CAMERAS[name][1], rng)
    found, _ = rays_of(camera, projected(camera, ray))
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
    assert angle(found, ray).max() < 1e-6


@pytest.mark.parametrize("name", known())
def test_radians_in_a_pixel_are_the_angles_between_rays(rng, name):
    """The geometric mean of the angles of a pixel across and down, where they are at right angles; their area else."""
    camera = camera_of(name)
    xy = projected(camera, rays(CAMERAS[name][1], rng))
    if name == "EQUIRECTANGULAR":  # away from the poles, where a pixel is a sliver
        xy = xy[np.abs(xy[:, 1] - HEIGHT / 2) < 0.4 * HEIGHT]
    ray, pixel = rays_of(camera, xy)
    step = 0.05
    across, down = (rays_of(camera, xy + step * axis)[0] - ray for axis in np.eye(2))
    area = np.linalg.norm(np.cross(across, down), axis=1) / step**2
    assert np.allclose(pixel, np.sqrt(area), rtol=0.02)
    assert (pixel > 0).all()


def test_a_pixel_of_a_pinhole_in_its_centre_is_one_over_the_focal_length():
    camera = camera_of("PINHOLE")
    _, pixel = rays_of(camera, np.array([[510.0, 390.0]]))
    assert pixel[0] == pytest.approx(1 / np.sqrt(600 * 620), rel=1e-6)


@pytest.mark.parametrize("xy", [(0.0, 400.0), (1000.0, 400.0), (500.0, 0.0), (500.0, 800.0), (0.0, 0.0)])
def test_edges_and_poles_of_a_spherical_image_have_finite_pixels(xy):
    """It has no focal length, which is a zero in pycolmap."""
    ray, pixel = rays_of(camera_of("EQUIRECTANGULAR"), np.array([xy]))
    assert np.isfinite(ray).all() and np.isfinite(pixel).all() and 0 < pixel[0] < 0.02


def test_pixels_that_no_ray_meets_are_nan():
    """So strong a distortion folds the plane over: no ray leads to the corner."""
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[600, 500, 400, -5.0], camera_id=1
    )
    ray, pixel = rays_of(camera, np.array([[500.0, 400.0], [990.0, 790.0]]))
    assert np.isfinite(ray[0]).all() and np.isnan(ray[1]).all()
    assert np.isfinite(pixel).all() and (pixel > 0).all()


# Which points the map without a query has


def ids_of(model: Any) -> np.ndarray:
    ids = scene_of_model(model).ids
    assert ids is not None
    return ids


def of(path: Path) -> tuple[Any, Queries]:
    model = read_model(path)
    return model, queries_of(model, ids_of(model))


def test_queries_are_the_images_with_their_observations(room):
    model, queries = of(room)
    ids = ids_of(model)
    assert [query.name for query in queries.all] == sorted(image.name for image in model.images.values())
    for query in queries.all:
        image = next(image for image in model.images.values() if image.name == query.name)
        seen = {int(point.point3D_id): point.xy for point in image.points2D if point.has_point3D()}
        assert set(ids[query.point].tolist()) == set(seen)
        assert np.allclose(query.pose.rotation, image.cam_from_world().rotation.matrix())
        assert np.allclose(query.pose.center, image.projection_center())
        place = model.cameras[image.camera_id]
        for row in range(0, len(query), 37):
            xy = seen[int(ids[query.point[row]])]
            ray = np.append(place.cam_from_img(np.asarray(xy)[None])[0], 1)
            assert angle(query.bearing[row], ray) < 1e-9
    centers = np.array([query.pose.center for query in queries.all])
    assert queries.extent == pytest.approx(np.linalg.norm(centers.max(axis=0) - centers.min(axis=0)))


def test_the_map_without_a_query_has_what_two_other_images_see(room):
    model, queries = of(room)
    ids = ids_of(model)
    for query in queries.all[::7]:
        found = queries.map_without(query)
        for row, key in enumerate(ids.tolist()):
            names = {model.images[element.image_id].name for element in model.points3D[key].track.elements}
            assert found[row] == (len(names - {query.name}) >= 2)
        assert not found.all()


def test_an_image_that_sees_a_point_twice_counts_once(room):
    model = read_model(room)
    key = next(key for key in sorted(model.point3D_ids()) if model.points3D[key].track.length() == 2)
    first = model.points3D[key].track.elements[0]
    image = model.images[first.image_id]
    # Another keypoint of that image, of another point, is given to this point.
    other = next(
        index
        for index, each in enumerate(image.points2D)
        if each.has_point3D() and model.points3D[each.point3D_id].track.length() > 4
    )
    model.delete_observation(image.image_id, other)
    model.add_observation(key, pycolmap.TrackElement(image.image_id, other))
    ids = ids_of(model)
    queries = queries_of(model, ids)
    row = int(np.searchsorted(ids, key))
    assert queries.images[row] == 2
    query = next(query for query in queries.all if query.name == image.name)
    assert (query.point == row).sum() == 2 and not queries.map_without(query)[row]


def test_queries_are_spread_evenly(room):
    _, queries = of(room)
    count = len(queries.all)
    assert evenly(queries.all, None) == evenly(queries.all, count) == evenly(queries.all, count + 5)
    some = evenly(queries.all, 5)
    assert some == evenly(queries.all, 5) and len({query.name for query in some}) == 5
    assert (some[0], some[-1]) == (queries.all[0], queries.all[-1])
    assert evenly(queries.all, 1) == [queries.all[0]]


# Models that hold no queries


def without_images(model: Any, kept: int) -> Any:
    """Take the poses of all but so many images away."""
    for image_id in sorted(model.images)[kept:]:
        model.deregister_frame(model.images[image_id].frame_id)
    return model


@pytest.mark.parametrize("kept", [1, 2])
def test_one_and_two_images_are_too_few(room, kept):
    model = without_images(read_model(room), kept)
    with pytest.raises(InputError, match=r"expected at least 3: each is left out") as refused:
        queries_of(model, ids_of(model))
    assert "\n" not in str(refused.value)


def changed(room: Path, change: Callable[[Any], None]) -> Any:
    model = read_model(room)
    change(model)
    return model


def at_one_place(model: Any) -> None:
    for frame in model.frames.values():
        pose = frame.rig_from_world
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, np.zeros(3))


def broken_camera(model: Any) -> None:
    camera = model.cameras[1]
    camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
    camera.params = [600.0, 800.0, 600.0, float("nan")]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (at_one_place, "got a model whose cameras are all at one place; expected cameras that moved"),
        (broken_camera, r"got camera 1 \(SIMPLE_RADIAL\) of frame00000.jpg, which pycolmap cannot undistort"),
    ],
)
def test_cameras_that_cannot_be_localized_are_refused(room, change, message):
    model = changed(room, change)
    with pytest.raises(InputError, match=message):
        queries_of(model, ids_of(model))
