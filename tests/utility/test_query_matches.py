"""Matches by tracks and by descriptors: which are right, which are wrong, and what no match may use."""

from __future__ import annotations

import math

import numpy as np
import pytest

from l2p.errors import InputError
from l2p.utility.matching import RATIO, by_descriptors, by_tracks
from l2p.utility.queries import Pose, Queries, Query, unit
from l2p.utility.releases import read_queries


def query_of(point: np.ndarray, name: str = "query", descriptor: np.ndarray | None = None) -> Query:
    """A query of given points; where it is does not matter here."""
    count = len(point)
    bearing = np.tile([0.0, 0.0, 1.0], (count, 1))
    pose = Pose(np.eye(3), np.array([float(len(name)), float(sum(map(ord, name))), 0.0]))
    return Query(name, bearing, np.full(count, 1e-3), np.asarray(point), pose, descriptor)


# By tracks


@pytest.mark.parametrize("wrong", [0.0, 0.1, 0.3, 0.5, 0.7, 0.99])
def test_the_share_of_wrong_matches_is_exact(rng, wrong):
    query = query_of(rng.permutation(500)[:200])
    landmark_of = rng.permutation(500)
    matches = by_tracks(query, landmark_of, wrong, rng)
    assert len(matches) == 200 and (~matches.right).sum() == round(wrong * 200)
    own = landmark_of[query.point[matches.keypoint]]
    # A wrong match never has the right landmark, a right one never another.
    assert np.array_equal(matches.landmark == own, matches.right)


def test_wrong_landmarks_are_any_others_of_the_release():
    """All others are equally probable, and no landmark is used that the release does not have."""
    landmark_of = np.array([4, -1, 0, 2, -1, 1, 3])
    query = query_of(np.array([0, 1, 2, 3, 6]))
    counts = np.zeros(5, dtype=int)
    for seed in range(3000):
        matches = by_tracks(query, landmark_of, 0.25, np.random.default_rng(seed))
        assert matches.keypoint.tolist() == [0, 2, 3, 4]
        changed = np.flatnonzero(~matches.right)
        assert len(changed) == 1
        if matches.keypoint[changed[0]] == 0:
            counts[matches.landmark[changed[0]]] += 1
    assert counts[4] == 0
    expected = counts.sum() / 4
    assert (np.abs(counts[:4] - expected) < 5 * math.sqrt(expected)).all()


def test_points_that_are_not_published_are_not_matched(rng):
    query = query_of(np.arange(100))
    landmark_of = np.where(rng.random(100) < 0.4, np.arange(100), -1)
    matches = by_tracks(query, landmark_of, 0.0, rng)
    assert np.array_equal(matches.landmark, landmark_of[landmark_of >= 0])
    assert len(by_tracks(query, np.full(100, -1), 0.3, rng)) == 0
    assert len(by_tracks(query_of(np.zeros(0, dtype=int)), landmark_of, 0.3, rng)) == 0


def test_keypoints_without_a_point_are_not_matched(rng):
    matches = by_tracks(query_of(np.array([-1, 3, -1, 1])), np.arange(5), 0.0, rng)
    assert matches.keypoint.tolist() == [3, 1] and matches.landmark.tolist() == [1, 3]


def test_a_point_that_is_seen_twice_gives_one_match(rng):
    matches = by_tracks(query_of(np.array([2, 0, 2, 2, 1])), np.arange(3), 0.0, rng)
    assert sorted(matches.landmark.tolist()) == [0, 1, 2]


def test_a_release_of_one_landmark_has_no_wrong_match(rng):
    matches = by_tracks(query_of(np.array([0])), np.array([0]), 0.9, rng)
    assert matches.right.tolist() == [True]


def test_points_that_fewer_than_two_other_images_see_are_not_matched(room, rng):
    _, queries = read_queries(room)
    query = queries.all[3]
    matches = by_tracks(query, np.where(queries.map_without(query), np.arange(queries.points), -1), 0.0, rng)
    others = np.zeros(queries.points, dtype=int)
    for other in queries.all:
        if other is not query:
            others[np.unique(other.point)] += 1
    assert others[matches.landmark].min() == 2
    assert set(query.point[others[query.point] >= 2]) == set(matches.landmark)


# By descriptors


def described(rng: np.random.Generator, images: int = 4, points: int = 40, noise: float = 0.15) -> Queries:
    """Images of points, each with noisy descriptors of them, and some keypoints of no point."""
    true = rng.normal(size=(points, 16))
    found = []
    for number in range(images):
        point = np.concatenate([rng.permutation(points)[: points - 8], np.full(6, -1)])
        descriptor = np.where(point[:, None] >= 0, true[point], rng.normal(size=(len(point), 16)))
        descriptor = descriptor + noise * rng.normal(size=descriptor.shape)
        found.append(query_of(point, f"image{number}", descriptor.astype(np.float32)))
    return Queries(tuple(found), points)


def own(query: Query) -> np.ndarray:
    """Unit descriptors of a query."""
    assert query.descriptor is not None
    return query.descriptor / np.linalg.norm(query.descriptor, axis=1, keepdims=True)


def mean_without(queries: Queries, query: Query, point: int) -> np.ndarray:
    total = np.zeros(16)
    for other in queries.all:
        if other.name != query.name:
            for row in np.flatnonzero(other.point == point):
                total += own(other)[row]
    return total / np.linalg.norm(total)


def test_matches_by_descriptors_equal_a_loop(rng):
    queries = described(rng, noise=0.6)
    for query in queries.all:
        point = [row for row in range(queries.points) if queries.map_without(query)[row]]
        landmark_of = np.full(queries.points, -1)
        landmark_of[point] = rng.permutation(len(point))
        means = {row: mean_without(queries, query, row) for row in point}
        found_in = own(query)
        expected = []
        for keypoint, descriptor in enumerate(found_in):
            far = sorted((float(np.linalg.norm(descriptor - mean)), row) for row, mean in means.items())
            (best, row), (second, _) = far[:2]
            back = min(range(len(query)), key=lambda other: float(np.linalg.norm(found_in[other] - means[row])))
            if back == keypoint and best < RATIO * second:
                expected.append((keypoint, landmark_of[row], query.point[keypoint] == row))
        found = by_descriptors(queries, query, landmark_of)
        assert 0 < len(found) < len(query)
        assert list(zip(*(column.tolist() for column in found), strict=True)) == expected
        assert found.right.any()


def test_descriptors_of_the_map_do_not_contain_those_of_the_query(rng):
    """Whatever the query's own descriptors are, the map that it is matched with is the same."""
    queries = described(rng)
    query, rows = queries.all[1], np.flatnonzero(queries.map_without(queries.all[1]))
    before = queries.descriptors_without(query, rows)
    other = query_of(query.point, query.name, rng.normal(size=(len(query), 16)).astype(np.float32))
    changed = Queries((queries.all[0], other, *queries.all[2:]), queries.points)
    assert np.allclose(changed.descriptors_without(other, rows), before, atol=1e-5)
    assert np.allclose(before, [mean_without(queries, query, row) for row in rows.tolist()], atol=1e-5)


def test_a_point_that_the_query_sees_twice_loses_both_descriptors(rng):
    queries = described(rng)
    one = queries.all[0]
    twice = query_of(np.append(one.point, one.point[0]), one.name, np.concatenate([own(one), -own(one)[:1]]))
    changed = Queries((twice, *queries.all[1:]), queries.points)
    rows = np.flatnonzero(changed.map_without(twice))
    assert np.allclose(changed.descriptors_without(twice, rows), queries.descriptors_without(one, rows), atol=1e-5)


def test_too_few_landmarks_or_keypoints_give_no_match(rng):
    queries = described(rng)
    query = queries.all[0]
    one = np.full(queries.points, -1)
    assert len(by_descriptors(queries, query, one)) == 0
    one[int(query.point[0])] = 0  # no second nearest for the ratio
    assert len(by_descriptors(queries, query, one)) == 0
    empty = query_of(np.zeros(0, dtype=int), query.name, np.zeros((0, 16), dtype=np.float32))
    assert len(by_descriptors(queries, empty, np.arange(queries.points))) == 0


def test_queries_without_descriptors_are_refused(rng):
    queries = Queries(tuple(query_of(np.arange(9), f"image{number}") for number in range(3)), 9)
    with pytest.raises(InputError, match="got queries without descriptors; expected features of the images"):
        _ = queries.descriptor_sum


def test_unit_descriptors_of_zero_stay_zero():
    assert np.array_equal(unit(np.array([[0, 0], [3, 4]], dtype=np.uint8)), np.array([[0, 0], [0.6, 0.8]], np.float32))
