"""Poses from matches with wrong ones among them: scores and refinement against plain twins, and what always holds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import l2p
from l2p.errors import InputError
from l2p.utility.landmarks import Gravity
from l2p.utility.queries import Pose
from l2p.utility.ransac import Located, RansacConfig, _samples, _Score, _searched, locate

KINDS = ("points", "lines")
CONFIG = RansacConfig()


def rows_with_wrong_ones(rng: np.random.Generator, count: int, wrong: float) -> tuple[np.ndarray, np.ndarray]:
    """Landmark of each match, and whether it is right."""
    rows, right = np.arange(count), np.ones(count, dtype=bool)
    some = rng.choice(count, round(wrong * count), replace=False)
    rows[some] = (some + rng.integers(1, count, len(some))) % count
    right[some] = False
    return rows, right


def located(seen: Any, kind: str, wrong: float, seed: int = 0, gravity: Gravity | None = None, **settings: Any) -> Any:
    rng = np.random.default_rng(seed)
    rows, right = rows_with_wrong_ones(rng, len(seen.xyz), wrong)
    config = replace(CONFIG, **settings)
    found = locate(seen.landmarks(kind), seen.bearing, seen.pixel, rows, config, rng, gravity)
    return found, rows, right


@pytest.mark.parametrize("known", [False, True], ids=["", "gravity"])
@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.5])
@pytest.mark.parametrize("kind", KINDS)
def test_poses_are_found_among_wrong_matches(view, kind, wrong, known):
    world = np.array([0.2, 1.0, 0.1])
    for seed in range(3):
        seen = view(seed, 120, noise=0.5)
        gravity = Gravity(seen.pose.rotation @ world, world) if known else None
        found, _, right = located(seen, kind, wrong, seed, gravity)
        assert isinstance(found, Located)
        assert seen.error(found.pose) < (0.02 if kind == "lines" else 0.005)
        assert np.linalg.det(found.pose.rotation) == pytest.approx(1)
        assert found.inliers[right].mean() > 0.95 and found.inliers[~right].sum() <= 0.2 * max((~right).sum(), 1)


@pytest.mark.parametrize("kind", KINDS)
def test_matches_without_noise_give_the_exact_pose(view, kind):
    seen = view(4)
    found, _, right = located(seen, kind, 0.4)
    assert found is not None and seen.error(found.pose) < 1e-8
    assert found.inliers[right].all()


@pytest.mark.parametrize("kind", KINDS)
def test_losses_equal_a_loop(view, kind):
    seen, rng = view(noise=5.0), np.random.default_rng(0)
    landmarks, pixel = seen.landmarks(kind), rng.uniform(0.5e-3, 2e-3, 80)
    score = _Score(landmarks, seen.bearing, pixel, seen.rows, CONFIG)
    poses = [landmarks.enter(seen.pose)]
    poses.append(poses[0] + 1e-3 * rng.normal(size=(3, 4)))
    for pose, loss in zip(poses, score.losses(np.array(poses)), strict=True):
        total = inliers = cauchy = 0.0
        for row in range(80):
            residual = landmarks.residuals(pose[None], seen.bearing[[row]], seen.rows[[row]])[0, 0] / pixel[row]
            total += min(residual**2, CONFIG.threshold**2)
            inliers += residual <= CONFIG.threshold
            cauchy += np.log(1 + (residual / CONFIG.scale) ** 2)
        assert loss == pytest.approx(total)
        assert score.inliers(pose).sum() == inliers
        assert score.cauchy(pose, np.ones(80, dtype=bool)) == pytest.approx(cauchy)


@pytest.mark.parametrize("wrong", [0.0, 0.3])
@pytest.mark.parametrize("kind", KINDS)
def test_the_refinement_is_the_least_cauchy_loss_of_scipy(view, kind, wrong):
    """From the same inliers, and with residuals of another form: projections to the image in place of angles."""
    seen = view(7, 150, noise=1.0)
    found, rows, _ = located(seen, kind, wrong)
    inliers, landmarks = found.inliers, seen.landmarks(kind)

    def residuals(vector: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(vector[:3]).as_matrix()
        pose = Pose(turn @ found.pose.rotation, turn @ found.pose.translation + vector[3:])
        entered = landmarks.enter(pose)[None]
        return landmarks.residuals(entered, seen.bearing[inliers], rows[inliers])[0] / seen.pixel[inliers]

    def signed(vector: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(vector[:3]).as_matrix()
        pose = landmarks.enter(Pose(turn @ found.pose.rotation, turn @ found.pose.translation + vector[3:]))
        return (landmarks.linearized(pose, seen.bearing[inliers], rows[inliers])[0] / seen.pixel[inliers, None])[:, 0]

    def loss(vector: np.ndarray) -> float:
        return float(np.log1p(residuals(vector) ** 2).sum())

    if kind == "lines":
        best = least_squares(signed, np.zeros(6), loss="cauchy", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    else:  # scipy's loss is of each number, ours of each match
        from scipy.optimize import minimize

        best = minimize(loss, np.zeros(6), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12}).x
    assert loss(np.zeros(6)) <= loss(best) * (1 + 1e-6)
    assert np.abs(best).max() < 2e-4
    error = seen.error(found.pose)
    assert np.abs(best).max() < 0.1 * error or error < 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_gives_the_same_pose(view, kind):
    seen = view(noise=1.0)
    one, two, other = (located(seen, kind, 0.3, seed)[0] for seed in (1, 1, 2))
    assert np.array_equal(one.pose.rotation, two.pose.rotation) and one.samples == two.samples
    assert np.array_equal(one.pose.translation, two.pose.translation)
    assert not np.array_equal(one.pose.translation, other.pose.translation)


@pytest.mark.parametrize("kind", KINDS)
def test_poses_move_with_the_scene(view, kind):
    seen = view(3, noise=0.5)
    turn, move, scale = Rotation.from_rotvec([-0.5, 1.0, 2.0]).as_matrix(), np.array([50.0, -20.0, 7.0]), 12.0
    moved = replace(
        seen,
        xyz=scale * seen.xyz @ turn.T + move,
        lines=l2p.LineCloud.through(scale * seen.xyz @ turn.T + move, seen.lines.direction @ turn.T),
    )
    one, two = (located(each, kind, 0.3)[0] for each in (seen, moved))
    assert np.allclose(two.pose.center, scale * turn @ one.pose.center + move, atol=1e-4 * scale)
    assert np.allclose(two.pose.rotation @ turn, one.pose.rotation, atol=1e-5)


def test_signs_of_lines_do_not_move_the_pose(view, rng):
    seen = view(3, noise=0.5)
    direction = seen.lines.direction * rng.choice([-1.0, 1.0], (80, 1))
    flipped = replace(seen, lines=l2p.LineCloud.through(seen.lines.at(rng.uniform(-9, 9, 80)), direction))
    one, two = (located(each, "lines", 0.3)[0] for each in (seen, flipped))
    assert np.allclose(two.pose.center, one.pose.center, atol=1e-5)
    assert np.allclose(two.pose.rotation, one.pose.rotation, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_too_few_matches_give_no_pose(view, kind):
    sample = view().landmarks(kind).sample
    for count in (0, 1, sample, 2 * sample - 1):
        seen = view(1, max(count, 1))
        found = locate(
            seen.landmarks(kind),
            seen.bearing[:count],
            seen.pixel[:count],
            seen.rows[:count],
            CONFIG,
            np.random.default_rng(0),
        )
        assert found is None
    found, _, _ = located(view(1, 3 * sample), kind, 0.0)
    assert found is not None


@pytest.mark.parametrize("kind", KINDS)
def test_matches_that_agree_with_nothing_give_no_pose(view, kind):
    seen, rng = view(count=60), np.random.default_rng(3)
    bearing = rng.normal(size=(60, 3))
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    config = replace(CONFIG, most_samples=60)
    assert locate(seen.landmarks(kind), bearing, seen.pixel, seen.rows, config, rng) is None


def test_no_more_samples_are_drawn_than_allowed_and_no_fewer(view):
    seen = view(count=40, noise=0.5)
    assert located(seen, "points", 0.0)[0].samples == CONFIG.least_samples
    assert located(seen, "points", 0.0, least_samples=1)[0].samples <= 5
    found, _, _ = located(seen, "lines", 0.7, most_samples=30)
    assert found is None or found.samples <= 30


def test_few_matches_that_agree_with_nothing_end_soon(view):
    """Twelve of sixteen lines would have to agree, which a few samples find or rule out."""
    seen, rng = view(count=16), np.random.default_rng(3)
    landmarks = seen.landmarks("lines")
    score = _Score(landmarks, rng.permutation(seen.bearing), seen.pixel, seen.rows, CONFIG)
    _, drawn = _searched(score, 6, rng, None)
    assert drawn <= _samples(12 / 16, 6, CONFIG.confidence) < 100


def test_many_matches_are_searched_in_part_and_refined_as_a_whole(view):
    seen = view(2, 1500, noise=1.0)
    errors = []
    for kind in KINDS:
        found, _, right = located(seen, kind, 0.5)
        assert found.inliers.shape == (1500,) and found.inliers[right].mean() > 0.95
        errors.append(seen.error(found.pose))
    # As close as 750 matches make it, not 200.
    assert errors[0] < 1e-3 and errors[1] < 3e-3


def test_number_of_samples_grows_with_wrong_matches_and_confidence():
    counts = [_samples(share, 6, 0.999) for share in (1.0, 0.9, 0.7, 0.5, 0.3, 0.1, 0.0)]
    assert counts == sorted(counts) and counts[-1] == 10**9
    assert _samples(0.5, 6, 0.9999) > _samples(0.5, 6, 0.999) > _samples(0.5, 6, 0.9)
    assert _samples(0.5, 3, 0.999) < _samples(0.5, 6, 0.999)
    assert _samples(1.3, 6, 0.999) == counts[0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"threshold": 0.0}, "got threshold 0.0 of the localization; expected more than 0 pixels"),
        ({"scale": float("inf")}, "got scale inf of the localization; expected more than 0 pixels"),
        ({"scale": float("nan")}, "got scale nan of the localization"),
        ({"confidence": 1.0}, r"got confidence 1.0 of the localization; expected a number in \(0, 1\)"),
        ({"least_samples": 0}, "got 0 to 3000 samples of the localization; expected at least 1"),
        ({"most_samples": 5}, "got 20 to 5 samples of the localization"),
    ],
)
def test_bad_settings_are_a_sentence(settings, message):
    with pytest.raises(InputError, match=message):
        RansacConfig(**settings)
