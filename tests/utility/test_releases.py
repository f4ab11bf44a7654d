"""Localization of the images of a model in releases of its map, from end to end."""

from __future__ import annotations

import math
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pycolmap
import pytest

import l2p
from l2p.errors import InputError
from l2p.io.colmap import read_model
from l2p.utility.landmarks import LineLandmarks, PointLandmarks
from l2p.utility.localization import Limit, Localization, checked_limits, parsed_limit
from l2p.utility.releases import LocalizeConfig, _angle, read_queries, release_of


def localized(path: Path, **settings: Any) -> Localization:
    words: dict[str, Any] = {"fractions": [1.0], "most_queries": 5}
    return l2p.localize(path, **(words | settings))


def plain(found: Localization) -> list[dict[str, Any]]:
    """All queries without their times."""
    rows = found.rows()
    for row in rows:
        del row["seconds"]
    return rows


def test_cameras_are_localized_in_points_and_in_lines(room):
    found = localized(room, fractions=[1.0, 0.5], wrong=[0.0, 0.3])
    assert len(found.trials) == 2 * 2 * 2
    assert [trial.fraction for trial in found.trials] == [1.0] * 4 + [0.5] * 4
    for trial in found.trials:
        assert trial.position < 0.01 * found.extent and trial.rotation < 0.5
        assert trial.within(Limit(0.02), found.extent) >= 0.8
    points, lines = (found.of(scheme, 1.0) for scheme in ("points", "uniform"))
    assert points.position < lines.position
    # Both have the same points, so the same matches, and the same ones are wrong.
    assert [each.matches for each in points.attempts] == [each.matches for each in lines.attempts]
    assert [each.right for each in points.attempts] == [each.right for each in lines.attempts]


def test_the_same_seed_gives_the_same_result(room):
    one, two, other = (plain(localized(room, fractions=[0.5], seed=seed)) for seed in (1, 1, 2))
    assert one == two and one != other


def test_known_gravity_takes_fewer_samples(room):
    """z is up in simulated rooms."""
    plain_, upright = (
        localized(room, schemes=["uniform"], gravity=gravity, wrong=[0.5]) for gravity in (None, (0.0, 0.0, -1.0))
    )
    assert upright.upright and not plain_.upright
    assert upright.trials[0].position < 0.01 * upright.extent
    samples = [np.mean([each.samples for each in found.trials[0].attempts]) for found in (plain_, upright)]
    assert samples[1] < 0.5 * samples[0]


def test_releases_at_one_share_publish_the_same_points(room):
    scene, _ = read_queries(room)
    points, lines = (release_of(scene, scheme, 0.3, 4) for scheme in ("points", "uniform"))
    assert isinstance(points.landmarks, PointLandmarks) and isinstance(lines.landmarks, LineLandmarks)
    assert len(points.landmarks) == len(lines.landmarks) == round(0.3 * len(scene))
    for release in (points, lines):
        published = release.landmark_of[release.landmark_of >= 0]
        assert np.array_equal(np.sort(published), np.arange(len(release.landmarks)))
    assert np.array_equal(points.landmark_of >= 0, lines.landmark_of >= 0)
    # Each landmark of a point is that point, or a line through it.
    for row in np.flatnonzero(points.landmark_of >= 0)[::50]:
        landmark, xyz = points.landmarks, scene.xyz[row]
        place = landmark.xyz[points.landmark_of[row]] * landmark.unit + landmark.center
        assert np.allclose(place, xyz)
        line, number = lines.landmarks, lines.landmark_of[row]
        inside = (xyz - line.center) / line.unit
        assert np.allclose(np.cross(inside, line.direction[number]), line.moment[number])


def test_wide_angle_queries_are_localized(room, tmp_path):
    """Fisheye images of 180 degrees of the same room: bearings, not pixels of a plane, are what counts."""
    model, rng, widest = read_model(room), np.random.default_rng(0), 0.0
    camera = model.cameras[1]
    camera.model, camera.width, camera.height = pycolmap.CameraModelId.OPENCV_FISHEYE, 1000, 1000
    camera.params = [318.0, 318.0, 500.0, 500.0, 0.01, -0.005, 0.001, 0.0]
    # All cameras look 50 degrees to the side, so that what they saw is near the edge of the wide image.
    turn = pycolmap.Rotation3d(np.array([0.0, math.sin(math.radians(25)), 0.0, math.cos(math.radians(25))]))
    for frame in model.frames.values():
        pose = frame.rig_from_world
        frame.rig_from_world = pycolmap.Rigid3d(turn * pose.rotation, turn.matrix() @ pose.translation)
    for image in model.images.values():
        for keypoint in image.points2D:
            if keypoint.has_point3D():
                ray = image.cam_from_world() * model.points3D[keypoint.point3D_id].xyz
                widest = max(widest, math.degrees(math.acos(ray[2] / np.linalg.norm(ray))))
                keypoint.xy = np.ravel(camera.img_from_cam(ray[:, None], False)) + 0.3 * rng.normal(size=2)
    assert 80 < widest < 92
    folder = tmp_path / "wide"
    folder.mkdir()
    model.write_binary(str(folder))
    found = localized(folder, wrong=[0.3])
    for trial in found.trials:
        assert trial.position < 0.02 * found.extent and trial.rotation < 1


# By descriptors


@pytest.fixture
def features(room: Path, tmp_path: Path) -> Path:
    """hloc's features beside a copy of the model: noisy descriptors of the points, and a keypoint of no point."""
    model, rng = read_model(room), np.random.default_rng(1)
    true = {key: rng.normal(size=32) for key in model.point3D_ids()}
    shutil.copytree(room, tmp_path / "described")
    path = tmp_path / "described" / "feats-superpoint.h5"
    with h5py.File(path, "w") as file:
        for image in model.images.values():
            rows = [true[each.point3D_id] if each.has_point3D() else rng.normal(size=32) for each in image.points2D]
            descriptor = np.array(rows) + 0.5 * rng.normal(size=(len(rows), 32))
            group = file.create_group(image.name)
            group.create_dataset("keypoints", data=np.array([each.xy for each in image.points2D]) - 0.5)
            group.create_dataset(
                "descriptors", data=(descriptor / np.linalg.norm(descriptor, axis=1, keepdims=True)).T.astype("f4")
            )
    return path


def test_cameras_are_localized_by_descriptors(features):
    found = localized(features.parent, matching="descriptors")
    assert found.matching == "descriptors" and len(found.trials) == 2
    for trial in found.trials:
        assert trial.wrong is None
        assert trial.position < 0.02 * found.extent
        assert 0 < np.mean([each.right / each.matches for each in trial.attempts]) <= 1
    other = localized(features.parent, matching="descriptors", features=features)
    assert plain(other) == plain(found)


# Figures


def test_figures_are_plain_values(room):
    found = localized(room, fractions=[1.0, 0.004], most_queries=3)
    figures = found.as_dict()
    assert figures["queries"] == 3 and figures["limits"] == ["0.1 %", "0.5 %", "1 %"]
    nothing = [each for each in figures["trials"] if each["fraction"] == 0.004]
    # Six points of 1500: too few matches for any pose.
    assert all(each["median_position"] is None and each["median_rotation"] is None for each in nothing)
    assert all(set(each["within"].values()) == {0.0} for each in nothing)
    rows = found.rows()
    assert len(rows) == 4 * 3 and {"scheme", "fraction", "wrong_matches", "name", "position"} <= set(rows[0])
    for trial in found.trials:
        positions = sorted(each.position for each in trial.attempts)
        assert trial.position == positions[1]
        assert trial.matches == sorted(each.matches for each in trial.attempts)[1]
        assert all(attempt.found == math.isfinite(attempt.position) for attempt in trial.attempts)
        assert all(asdict(attempt)["inliers"] <= attempt.matches for attempt in trial.attempts)


def test_limits_in_metres_where_the_map_is(room):
    found = localized(room, fractions=[1.0], metric=True, most_queries=3)
    assert [str(limit) for limit in found.limits] == ["0.25 m, 2 deg", "0.5 m, 5 deg", "5 m, 10 deg"]
    trial = found.trials[0]
    expected = np.mean([each.position <= 0.25 and each.rotation <= 2 for each in trial.attempts])
    assert trial.within(found.limits[0], found.extent) == expected


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 90.0, 179.0, 180.0])
def test_angles_of_rotations_are_exact(angle):
    turn = pycolmap.Rotation3d(np.array([0.6, 0.0, 0.8]) * math.radians(angle)).matrix()
    assert _angle(turn) == pytest.approx(angle, rel=1e-6, abs=1e-13)


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("0.25m,2deg", Limit(0.25, 2, True)),
        ("25cm", Limit(0.25, math.inf, True)),
        ("0.5%", Limit(0.005)),
        ("1 %, 3 deg", Limit(0.01, 3)),
        ("2deg,0.5m", Limit(0.5, 2, True)),
    ],
)
def test_limits_are_read(text, limit):
    assert parsed_limit(text) == limit


@pytest.mark.parametrize(
    "text", ["", "m", "2deg", "-1m", "0%", "nan m", "inf%", "1", "1km", "0.5m,", "half a metre", "0x1m"]
)
def test_other_limits_are_refused(text):
    with pytest.raises(InputError, match=r"expected metres and degrees, 0\.25m,2deg, or a share"):
        parsed_limit(text)


@pytest.mark.parametrize("text", ["1m,2m", "1m,1%", "1deg,2deg,1m"])
def test_limits_that_say_a_thing_twice_are_refused(text):
    with pytest.raises(InputError, match="got limit"):
        parsed_limit(text)


def test_metres_need_a_map_in_metres():
    checked_limits([Limit(0.25, 2, True)], True)
    checked_limits([Limit(0.005)], False)
    with pytest.raises(
        InputError, match=r"got a limit in metres for a map whose unit is not known; say that .*--metric"
    ):
        checked_limits([Limit(0.005), Limit(0.25, 2, True)], False)


# Bad settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"schemes": ["radial"]}, "got scheme 'radial'; expected some of points, uniform"),
        ({"schemes": []}, "got no way to publish; expected at least one of points, uniform"),
        ({"fractions": []}, "got no share of the points; expected at least one"),
        ({"fractions": [0.0]}, "got fraction 0.0; expected a number in"),
        ({"fractions": [1.0, math.nan]}, "got fraction nan; expected"),
        ({"wrong": [1.0]}, "got 1 as a share of wrong matches"),
        ({"wrong": [-0.1]}, "got -0.1 as a share of wrong matches"),
        ({"wrong": [math.nan]}, "got nan as a share of wrong matches"),
        ({"wrong": []}, "got no share of wrong matches"),
        ({"matching": "luck"}, "got matches by 'luck'; expected one of tracks, descriptors"),
        ({"most_queries": 0}, "got 0 queries; expected at least 1"),
        ({"gravity": (0.0, 0.0, 0.0)}, "expected the direction of gravity in the map"),
        ({"gravity": (0.0, math.inf, 0.0)}, "expected the direction of gravity in the map"),
        ({"gravity": (math.nan, 1.0, 0.0)}, "expected the direction of gravity in the map"),
        ({"seed": -1}, "got seed -1"),
    ],
)
def test_bad_settings_are_a_sentence(room, settings, message):
    with pytest.raises(InputError, match=message) as refused:
        localized(room, **settings)
    assert "\n" not in str(refused.value)


def test_settings_are_checked_without_a_model():
    with pytest.raises(InputError, match="got matches by"):
        LocalizeConfig(matching="luck")


MAPS = (
    "office_lounge",
    "plant_livingroom",
    "strecha_castle_p30",
    "strecha_entry_p10",
    "strecha_fountain_p11",
    "tabletop_posters",
)


@pytest.mark.parametrize("name", MAPS)
def test_real_maps_are_localized_in_as_closely_as_promised(shared, name):
    found = localized(shared / "maps" / "val" / name, most_queries=4)
    for trial in found.trials:
        assert trial.rotation < 0.1 and trial.position < 0.002 * found.extent


@pytest.mark.parametrize("scheme", ["ppl", "ppl+", "rays", "rays-voxel"])
def test_cameras_are_localized_in_the_lines_of_other_schemes(room, scheme):
    found = localized(room, schemes=[scheme], wrong=[0.0])
    assert found.of(scheme, 1.0).position < 0.05 * found.extent


def test_both_points_of_a_pair_are_matched_with_their_line(room):
    scene, _ = read_queries(room)
    release = release_of(scene, "ppl", 1.0, 0)
    matched = release.landmark_of[release.landmark_of >= 0]
    assert (np.bincount(matched) == 2).all() and len(matched) > 0.98 * len(scene)


@pytest.mark.parametrize("scheme", ["sphere", "sphere-33"])
def test_lines_that_meet_in_one_point_are_refused(room, scheme):
    with pytest.raises(InputError, match=r"lines that all meet in one point; expected others, since the distance"):
        localized(room, schemes=[scheme])


@pytest.mark.parametrize("scheme", ["planes", "planes-pooled", "planes-random", "permuted"])
def test_what_is_no_line_cloud_is_refused(room, scheme):
    with pytest.raises(InputError, match=f"got scheme {scheme}; expected one that publishes points or lines"):
        localized(room, schemes=["points", scheme])
