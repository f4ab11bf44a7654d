"""Far points do not change what comes back of the rest, nor what is stated of it."""

import numpy as np
import pytest

import l2p
from l2p.attacks.apart import apart_words
from l2p.schemes.hide import hide


@pytest.fixture(scope="module")
def near() -> np.ndarray:
    return l2p.simulate("room", 600, 5).xyz


def with_far(near: np.ndarray, far: np.ndarray) -> tuple[l2p.Recovery, np.ndarray, np.ndarray]:
    """Recovery of near points with others, errors in scene units, and the point behind each line."""
    points = np.concatenate([near, far])
    hidden = hide(points, seed=1)
    recovery = l2p.recover(hidden.map, method="tomography")
    index = hidden.truth.index
    return recovery, np.linalg.norm(recovery.xyz - points[index], axis=1), index


def sphere(count: int, radius: float) -> np.ndarray:
    draw = np.random.default_rng(0).normal(size=(count, 3))
    return radius * draw / np.linalg.norm(draw, axis=1, keepdims=True)


@pytest.mark.parametrize(("count", "radius"), [(60, 1e5), (1, 1e15)])
def test_the_rest_comes_back_as_without_far_points(near: np.ndarray, count: int, radius: float) -> None:
    alone, own_error, _ = with_far(near, near[:0])
    recovery, error, index = with_far(near, sphere(count, radius))
    scale = 0.1 * np.ptp(near, axis=0).max()
    right = (error[index < len(near)] < scale).mean()
    assert right == pytest.approx((own_error < scale).mean(), abs=0.05)
    assert recovery.confidence[index >= len(near)].max() < 0.01 < alone.confidence.mean()
    assert [part["lines"] for part in recovery.info["parts"]] == [len(near), count]
    assert f"{count} of {len(index)}" in apart_words(recovery.info)
    assert "parts" not in alone.info and apart_words(alone.info) == ""


def test_both_of_two_rooms_come_back_with_neighbours_of_their_own(near: np.ndarray) -> None:
    recovery, error, index = with_far(near, near[:400] + np.array([3e4, 2e4, 1e4]))
    scale = 0.1 * np.ptp(near, axis=0).max()
    first = index < len(near)
    assert (error[first] < scale).mean() > 0.6 and (error[~first] < scale).mean() > 0.5
    assert recovery.neighbors is not None and recovery.affinity is not None
    there = recovery.neighbors >= 0
    same = first[np.maximum(recovery.neighbors, 0)] == first[:, None]
    assert same[there].all() and (recovery.affinity[~there] == 0).all()
    assert recovery.confidence[~first].mean() < recovery.confidence[first].mean(), "the second room is less dense"
