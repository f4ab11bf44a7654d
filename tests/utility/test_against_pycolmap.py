"""Poses against pycolmap's estimators on the same matches: our error is at most twice theirs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from l2p.utility.landmarks import LineLandmarks, PointLandmarks
from l2p.utility.matching import Matches, by_tracks
from l2p.utility.queries import Pose, Query, evenly
from l2p.utility.ransac import RansacConfig, locate
from l2p.utility.releases import Release, read_queries, release_of

#: Focal length of a virtual camera along a line: its pixel does not count beside those of the query.
FOCAL = 60_000.0
#: Distance of virtual cameras from the feet of their lines, in units of the frame: outside the map.
FAR = 100.0


def points_by_pycolmap(query: Query, matches: Matches, xyz: np.ndarray, camera: Any) -> Pose:
    """Pose by the absolute pose estimator; the query is seen by a pinhole of its own."""
    pycolmap.set_random_seed(0)
    bearing = query.bearing[matches.keypoint]
    pixels = np.array([camera.img_from_cam(each[:, None]) for each in bearing]).reshape(-1, 2)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = RansacConfig().threshold
    found = pycolmap.estimate_and_refine_absolute_pose(pixels, xyz[matches.landmark], camera, options)
    assert found is not None
    pose = found["cam_from_world"]
    return Pose(pose.rotation.matrix(), pose.translation)


def lines_by_pycolmap(query: Query, matches: Matches, landmarks: LineLandmarks, camera: Any) -> Pose | None:
    """Pose by the generalized relative pose estimator: one rig of a virtual pinhole a line, one of the query."""
    pycolmap.set_random_seed(0)
    count = len(matches)
    cameras = [pycolmap.Camera(model="PINHOLE", width=1000, height=1000, params=[FOCAL, FOCAL, 500, 500]), camera]
    cameras = [cameras[0]] * count + [cameras[1]]
    poses = []
    for row in matches.landmark:
        forward = landmarks.direction[row]
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward])
        foot = np.cross(forward, landmarks.moment[row])
        poses.append(pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ (foot - FAR * forward)))
    poses.append(pycolmap.Rigid3d())
    bearing = query.bearing[matches.keypoint]
    pixels = np.array([camera.img_from_cam(each[:, None]) for each in bearing]).reshape(-1, 2)
    options = pycolmap.RANSACOptions()
    options.max_error, options.confidence = RansacConfig().threshold, RansacConfig().confidence
    options.min_num_trials, options.max_num_trials = 20, 400
    found = pycolmap.estimate_generalized_relative_pose(
        np.full((count, 2), 500.0), pixels, list(range(count)), [count] * count, poses, cameras, options
    )
    if found is None:
        return None
    pose = found["rig2_from_rig1"]
    return landmarks.leave(np.column_stack([pose.rotation.matrix(), pose.translation]))


def errors(pose: Pose, query: Query, extent: float) -> tuple[float, float]:
    """Position, of the cameras' extent, and rotation, radians."""
    turn = pose.rotation @ query.pose.rotation.T
    angle = np.linalg.norm(pycolmap.Rotation3d(turn).quat[:3]) * 2
    return float(np.linalg.norm(pose.center - query.pose.center)) / extent, float(angle)


def compared(path: Path, kind: str, queries: int, most: int, wrong: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors of ours and of pycolmap on the same matches, (queries, 2) each."""
    scene, read = read_queries(path)
    release: Release = release_of(scene, "uniform" if kind == "lines" else "points", 1.0, 0)
    ours, theirs = [], []
    seen_enough = [query for query in read.all if len(query) >= most // 2]
    for number, query in enumerate(evenly(seen_enough, queries)):
        rng = np.random.default_rng(number)
        landmark_of = np.where(read.map_without(query), release.landmark_of, -1)
        matches = by_tracks(query, landmark_of, wrong, rng)
        some = rng.permutation(len(matches))[:most]
        matches = Matches(*(column[some] for column in matches))
        keypoint = matches.keypoint
        own = locate(
            release.landmarks,
            query.bearing[keypoint],
            query.pixel[keypoint],
            matches.landmark,
            RansacConfig(),
            rng,
        )
        assert own is not None
        focal = 1 / float(np.median(query.pixel))
        camera = pycolmap.Camera(model="PINHOLE", width=1600, height=1200, params=[focal, focal, 800, 600])
        landmarks = release.landmarks
        if isinstance(landmarks, LineLandmarks):
            other = lines_by_pycolmap(query, matches, landmarks, camera)
        else:
            assert isinstance(landmarks, PointLandmarks)
            xyz = landmarks.xyz * landmarks.unit + landmarks.center
            other = points_by_pycolmap(query, matches, xyz, camera)
        ours.append(errors(own.pose, query, read.extent))
        theirs.append((np.inf, np.inf) if other is None else errors(other, query, read.extent))
    return np.array(ours), np.array(theirs)


@pytest.mark.parametrize("kind", ["points", "lines"])
def test_errors_are_at_most_twice_those_of_pycolmap(room, kind):
    ours, theirs = compared(room, kind, 7, 150, 0.3)
    assert np.isfinite(theirs).all() or kind == "lines"
    assert (np.median(ours, axis=0) <= 2 * np.median(theirs, axis=0)).all()


@pytest.mark.parametrize("kind", ["points", "lines"])
def test_errors_on_a_real_map_are_at_most_twice_those_of_pycolmap(shared, kind):
    ours, theirs = compared(shared / "maps" / "val" / "strecha_castle_p30", kind, 5, 200, 0.3)
    assert (np.median(ours, axis=0) <= 2 * np.median(theirs, axis=0)).all()


def test_lines_of_a_few_matches_agree_with_pycolmap_without_wrong_ones(room):
    """Not only medians: without wrong matches both end at the same pose, up to their losses."""
    ours, theirs = compared(room, "lines", 5, 60, 0.0)
    assert (ours[:, 0] < 2 * theirs[:, 0] + 1e-3).all()
