"""The procedural SfM simulator: it is deterministic, its geometry is honest, and its COLMAP model is whole."""

from __future__ import annotations

import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.simulator import KINDS, MIN_POINTS, SimulatedModel, _check, simulate_model
from l2p.simulator.cameras import Cameras
from l2p.simulator.observe import Sightings
from l2p.simulator.occlusion import hidden
from l2p.simulator.surfaces import CUBE, CYLINDER, SPHERE, SQUARE, Pose, Stage, Texture
from l2p.simulator.triangulate import MAX_REPROJECTION_ERROR, triangulate

PLAIN = Texture(1.0, 1)


@pytest.fixture(scope="module")
def model() -> SimulatedModel:
    return simulate_model("room", points=4000, seed=3)


def views_of(cameras: Cameras, xyz: np.ndarray, model: SimulatedModel) -> np.ndarray:
    """Reprojection error of every observation, in pixels."""
    local = cameras.local(xyz[model.view_point], model.view_camera)
    assert (local[:, 2] > 0).all()
    return np.linalg.norm(cameras.pixels(local) - model.view_pixel, axis=1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("points", [300, 5000])
def test_every_kind_gives_exactly_the_points_asked_for(kind: str, points: int) -> None:
    scene = l2p.simulate(kind, points=points, seed=1)
    assert len(scene) == points
    assert np.isfinite(scene.xyz).all()
    assert scene.xyz.dtype == np.float64


def test_same_seed_gives_the_same_scene(model: SimulatedModel) -> None:
    again = simulate_model("room", points=4000, seed=3)
    np.testing.assert_array_equal(again.scene.xyz, model.scene.xyz)
    np.testing.assert_array_equal(again.scene.rgb, model.scene.rgb)
    np.testing.assert_array_equal(again.view_pixel, model.view_pixel)


def test_seed_matters(model: SimulatedModel) -> None:
    other = l2p.simulate("room", points=4000, seed=4)
    assert not np.allclose(np.median(other.xyz, axis=0), np.median(model.scene.xyz, axis=0), atol=1e-3)


def test_more_points_show_the_same_world(model: SimulatedModel) -> None:
    denser = simulate_model("room", points=6000, seed=3)
    np.testing.assert_array_equal(denser.cameras.center, model.cameras.center)
    np.testing.assert_allclose(
        np.percentile(denser.scene.xyz, [25, 75], axis=0), np.percentile(model.scene.xyz, [25, 75], axis=0), atol=0.3
    )


def test_arrays_are_aligned(model: SimulatedModel) -> None:
    scene = model.scene
    assert scene.rgb is not None and scene.rgb.shape == (4000, 3) and scene.rgb.dtype == np.uint8
    assert scene.ids is not None and len(np.unique(scene.ids)) == 4000
    assert scene.camera_centers is not None and len(scene.camera_centers) == len(model.cameras)
    assert scene.track_length is not None and scene.error is not None
    np.testing.assert_array_equal(scene.track_length, np.bincount(model.view_point, minlength=4000))
    error = np.bincount(model.view_point, views_of(model.cameras, scene.xyz, model)) / scene.track_length
    np.testing.assert_allclose(scene.error, error, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_every_point_is_seen_twice_with_small_error(kind: str) -> None:
    model = simulate_model(kind, points=1000, seed=2)
    assert model.scene.track_length is not None and model.scene.track_length.min() >= 2
    pair = model.view_point * len(model.cameras) + model.view_camera
    assert len(np.unique(pair)) == len(pair), "an image sees a point once"
    assert views_of(model.cameras, model.scene.xyz, model).max() <= MAX_REPROJECTION_ERROR
    measured = model.view_pixel[~model.wrong[model.view_point]]
    slack = 5 * MAX_REPROJECTION_ERROR
    assert (measured > -slack).all() and (measured < (model.cameras.width + slack, model.cameras.height + slack)).all()


def test_reconstructed_point_is_the_least_squares_one(model: SimulatedModel) -> None:
    best = views_of(model.cameras, model.scene.xyz, model) ** 2
    best = np.bincount(model.view_point, best)
    rng = np.random.default_rng(0)
    for _ in range(5):
        moved = model.scene.xyz + 0.003 * rng.standard_normal(model.scene.xyz.shape)
        other = np.bincount(model.view_point, views_of(model.cameras, moved, model) ** 2)
        assert (other >= best - 1e-3).mean() > 0.99


def noise_of(depth: int, cameras_used: int) -> float:
    """Median distance of triangulated points from true ones at one depth, seen by cameras half a metre wide."""
    points = 500
    center = np.column_stack([np.linspace(-0.25, 0.25, 8)[[0, 7, 1, 6, 2, 5, 3, 4]], np.zeros((8, 2))])
    cameras = Cameras(center, np.tile(np.eye(3), (8, 1, 1)), 1000.0, 1600, 1200)
    xyz = np.column_stack([np.random.default_rng(0).uniform(-0.3, 0.3, (points, 2)), np.full(points, depth)])
    point, camera = np.repeat(np.arange(points), cameras_used), np.tile(np.arange(cameras_used), points)
    nobody = np.full(points, -1)
    tracks = triangulate(
        Sightings(xyz, nobody > 0, 0 * xyz, nobody, point, camera), cameras, 0.5, np.random.default_rng(1)
    )
    return float(np.median(np.linalg.norm(tracks.xyz - tracks.sightings.xyz, axis=1)))


def test_noise_grows_with_depth_and_falls_with_track_length(model: SimulatedModel) -> None:
    assert noise_of(8, 2) > 2.5 * noise_of(4, 2) > 2.5 * 2.5 * noise_of(2, 2)
    assert noise_of(4, 8) < 0.8 * noise_of(4, 2)
    noise = np.linalg.norm(model.scene.xyz - model.true_xyz, axis=1)[~model.wrong]
    length = np.bincount(model.view_point)[~model.wrong]
    assert np.median(noise[length <= 3]) > 1.5 * np.median(noise[length >= 8])


def test_noise_is_long_along_the_viewing_ray(model: SimulatedModel) -> None:
    shift = model.scene.xyz - model.true_xyz
    first = np.searchsorted(model.view_point, np.arange(len(shift)))
    ray = model.true_xyz - model.cameras.center[model.view_camera[first]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = np.abs((shift * ray).sum(axis=1))
    across = np.linalg.norm(shift - (shift * ray).sum(axis=1)[:, None] * ray, axis=1)
    assert np.median(along) > 3 * np.median(across)


def test_wrong_matches_are_few_and_seen_twice(model: SimulatedModel) -> None:
    assert 0 < model.wrong.mean() < 0.1
    assert (np.bincount(model.view_point)[model.wrong] == 2).all()


# Occlusion: one wall or body between a camera at the origin and points on the other side.


def meets(stage: Stage, row: int, start: np.ndarray, end: np.ndarray) -> bool:
    """Loop twin: sample the segment densely and ask whether it passes through the solid."""
    solids = stage.solids
    t = np.linspace(0, 1, 4001)[1:-1, None]
    unit = (start + t * (end - start) - solids.center[row]) @ np.linalg.inv(solids.axes[row]).T
    kind = solids.shape[row]
    if kind == SQUARE:
        crossing = np.flatnonzero(np.diff(np.sign(unit[:, 2])) != 0)
        return bool((np.abs(unit[crossing, :2]) <= 1).all(axis=1).any())
    if kind == CUBE:
        return bool((np.abs(unit) < 1).all(axis=1).any())
    if kind == SPHERE:
        return bool((np.linalg.norm(unit, axis=1) < 1).any())
    return bool(((np.linalg.norm(unit[:, :2], axis=1) < 1) & (np.abs(unit[:, 2]) < 1)).any())


@pytest.mark.parametrize("shape", [SQUARE, CUBE, SPHERE, CYLINDER])
def test_hidden_agrees_with_dense_sampling(shape: int) -> None:
    stage, pose = Stage(), Pose(0.2, 0.1, -0.3, 0.7)
    if shape == SQUARE:
        stage.rect((0.2, 0.1, 0), (0.8, 0.3, 0), (-0.1, 0.2667, 0.9), PLAIN, (0, 0, 0))
    elif shape == CUBE:
        stage.box(pose, (0, 0, 0), (1.0, 0.6, 0.8), PLAIN, (0, 0, 0))
    elif shape == SPHERE:
        stage.ellipsoid(pose, (0, 0, 0.3), (0.8, 0.4, 0.5), PLAIN, (0, 0, 0))
    else:
        stage.cylinder(pose, (0, 0, 0), 0.5, 0.9, PLAIN, (0, 0, 0))
    rng = np.random.default_rng(0)
    center, point = rng.uniform(-2, 2, (20, 3)), rng.uniform(-2, 2, (300, 3))
    camera = rng.integers(0, 20, 300)
    cut = hidden(center, camera, point, np.full(300, -1), stage.solids)
    twin = np.array([meets(stage, 0, center[c], p) for c, p in zip(camera, point, strict=True)])
    assert 20 < twin.sum() < 280
    assert (cut != twin).sum() <= 2  # grazing segments, which the samples of the twin miss
    assert not hidden(center, camera, point, np.zeros(300, dtype=int), stage.solids).any(), "own body"


def test_occluded_points_are_not_seen() -> None:
    from l2p.simulator.layouts import LAYOUTS

    model = simulate_model("room", points=2000, seed=5)
    stage = LAYOUTS["room"](np.random.default_rng([5, KINDS.index("room"), 0])).stage
    right = ~model.wrong[model.view_point]
    point, camera = model.true_xyz[model.view_point[right]], model.view_camera[right]
    # Stop short of the point, so that the surface it lies on does not count.
    short = point + 0.05 * (model.cameras.center[camera] - point)
    assert hidden(model.cameras.center, camera, short, np.full(len(short), -1), stage.solids).mean() < 0.02
    far = model.cameras.center[camera] + 1.5 * (point - model.cameras.center[camera])
    assert hidden(model.cameras.center, camera, far, np.full(len(far), -1), stage.solids).mean() > 0.5


def test_colmap_model_reloads_with_every_track(model: SimulatedModel, tmp_path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model.save_colmap(tmp_path / "sparse")
    read = pycolmap.Reconstruction(str(tmp_path / "sparse"))
    assert read.num_points3D() == 4000 and read.num_reg_images() == len(model.cameras)
    assert read.compute_num_observations() == len(model.view_point)
    stored = read.compute_mean_reprojection_error()
    read.update_point_3d_errors()
    assert read.compute_mean_reprojection_error() == pytest.approx(stored, rel=1e-4) and stored < 2
    for row in range(0, 4000, 97):
        point = read.points3D[row + 1]
        np.testing.assert_allclose(point.xyz, model.scene.xyz[row])
        assert model.scene.rgb is not None and tuple(point.color) == tuple(model.scene.rgb[row])
        for element in point.track.elements:
            image = read.images[element.image_id]
            place = image.points2D[element.point2D_idx]
            assert place.point3D_id == row + 1
            seen = image.project_point(point.xyz)
            assert seen is not None and np.linalg.norm(seen - place.xy) <= MAX_REPROJECTION_ERROR + 1e-6
    image = read.images[1]
    np.testing.assert_allclose(image.projection_center(), model.cameras.center[0], atol=1e-9)


def test_colmap_model_never_overwrites(model: SimulatedModel, tmp_path) -> None:
    (tmp_path / "other.txt").write_text("mine")
    with pytest.raises(InputError, match="is not an empty folder; name a new folder"):
        model.save_colmap(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "castle"}, "got kind 'castle'; expected one of room, object, facade, street, terrain"),
        ({"points": MIN_POINTS - 1}, "got 99 points; expected a whole number of at least 100"),
        ({"points": True}, "got True points; expected a whole number"),
        ({"seed": -1}, "got seed -1; expected a whole number of at least 0"),
    ],
)
def test_bad_arguments_get_one_sentence(arguments: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        l2p.simulate(**arguments)


@pytest.mark.parametrize(("points", "seed"), [(1000.0, 0), ("1000", 0), (1000, None), (1000, 1.5)])
def test_arguments_that_are_no_whole_numbers_are_refused(points: object, seed: object) -> None:
    # Behind the public door, where the type checks of the tests would speak first.
    with pytest.raises(InputError, match="expected a whole number of at least"):
        _check("room", points, seed)
