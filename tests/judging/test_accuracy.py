"""Measures on cases whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import jaxtyping
import numpy as np
import pytest

from l2p.errors import InputError
from l2p.geometry.points import nearest_neighbors
from l2p.judging.accuracy import errors, spacing
from l2p.judging.calibration import calibration_error, ranking, reliability, risk_coverage
from l2p.judging.neighbours import affinity_precision, neighbor_scores, right_neighbors
from l2p.judging.scores import evaluate
from l2p.maps.recovery import Recovery


def recovery_of(xyz: np.ndarray, confidence: np.ndarray | None = None) -> Recovery:
    confidence = np.ones(len(xyz), dtype=np.float32) if confidence is None else confidence.astype(np.float32)
    return Recovery(xyz=xyz, confidence=confidence, beta=np.zeros(len(xyz)))


def grid(side: int, step: float) -> np.ndarray:
    return step * np.stack(np.meshgrid(*[np.arange(float(side))] * 3), axis=-1).reshape(-1, 3)


def moved(truth: np.ndarray, by: np.ndarray) -> np.ndarray:
    return truth + np.asarray(by, dtype=float)[:, None] * [0, 0.6, 0.8]


@pytest.mark.parametrize("step", [1e-3, 1.0, 250.0])
def test_spacing_of_a_grid_is_the_distance_to_the_50th_of_its_points(step):
    # Of an inner point: 6 at 1, 12 at sqrt 2, 8 at sqrt 3, 6 at 2, 24 at sqrt 5. Most points of this grid are inner.
    assert spacing(grid(20, step)) == pytest.approx(step * np.sqrt(5))


def test_spacing_of_a_small_cloud_is_the_distance_to_the_farthest():
    assert spacing(np.array([[0.0, 0, 0], [0, 0, 4], [0, 3, 0]])) == pytest.approx(5)


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.ones((80, 3))])
def test_points_without_extent_have_no_spacing(points):
    with pytest.raises(InputError, match=rf"got {len(points)} points without extent; expected points that differ"):
        spacing(points)


@pytest.mark.parametrize("k", [1, 5, 39, 40, 100])
def test_nearest_neighbours_are_those_of_the_full_table(k):
    points = np.random.default_rng(0).normal(size=(40, 3))
    table = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(table, np.inf)
    found = nearest_neighbors(points, k)
    wide = min(k, 39)
    np.testing.assert_array_equal(found.index, np.argsort(table, axis=1)[:, :wide])
    np.testing.assert_allclose(found.distance, np.sort(table, axis=1)[:, :wide])


@pytest.mark.parametrize("k", [1, 3, 7])
def test_a_point_is_never_its_own_neighbour_even_among_copies(k):
    points = np.repeat(np.random.default_rng(0).normal(size=(10, 3)), 6, axis=0)
    found = nearest_neighbors(points, k)
    assert (found.index != np.arange(60)[:, None]).all()
    assert all(len(set(row)) == k for row in found.index.tolist())
    assert (found.distance[:, : min(k, 5)] == 0).all()
    assert (found.distance[:, 5:] > 0).all()


@pytest.mark.parametrize(("count", "k"), [(1, 4), (5, 0)])
def test_no_neighbours_are_an_empty_table(count, k):
    found = nearest_neighbors(np.zeros((count, 3)), k)
    assert found.index.shape == found.distance.shape == (count, 0)


def test_errors_and_shares_of_known_displacements():
    truth = grid(10, 1.0)[:100]
    by = np.repeat([0.1, 0.4, 0.9, 3.0], [40, 30, 20, 10])
    scores = evaluate(recovery_of(moved(truth, by)), truth, spacing=1.0)
    np.testing.assert_allclose(errors(moved(truth, by), truth), by)
    assert scores.lines == 100 and scores.spacing == 1
    assert scores.median == scores.median_spacings == pytest.approx(0.4)
    assert scores.mean == pytest.approx(by.mean())
    assert scores.within_spacings == pytest.approx({"0.25": 0.4, "0.5": 0.7, "1": 0.9, "2": 0.9, "5": 1.0})
    assert scores.within_cm == {}


def test_the_unit_of_a_share_is_the_spacing():
    truth = grid(10, 1.0)[:100]
    by = np.linspace(0, 10, 100)
    scores = evaluate(recovery_of(moved(truth, by)), truth, spacing=2.0)
    assert scores.median_spacings == pytest.approx(np.median(by) / 2)
    assert scores.within_spacings["1"] == (by <= 2).mean()
    assert evaluate(recovery_of(moved(truth, by)), truth).spacing == spacing(truth)


def test_centimetres_are_given_for_metric_scenes_only():
    truth = grid(10, 1.0)[:100]
    scores = evaluate(recovery_of(moved(truth, np.repeat([0.005, 0.07], [25, 75]))), truth, 1.0, metric=True)
    assert scores.within_cm == {"1": 0.25, "2.5": 0.25, "5": 0.25, "10": 1.0, "25": 1.0, "50": 1.0}


def test_the_confident_part_is_scored_apart():
    truth = grid(10, 1.0)[:100]
    by = np.repeat([0.0, 5.0], 50)
    confidence = np.linspace(1, 0, 100)
    scores = evaluate(recovery_of(moved(truth, by), confidence), truth, 1.0)
    assert (scores.confident_half, scores.confident_quarter) == (1.0, 1.0)
    scores = evaluate(recovery_of(moved(truth, by), confidence[::-1]), truth, 1.0)
    assert (scores.confident_half, scores.confident_quarter) == (0.0, 0.0)


def test_one_line_can_be_scored():
    scores = evaluate(recovery_of(np.zeros((1, 3))), np.ones((1, 3)), spacing=1.0)
    assert scores.median == pytest.approx(np.sqrt(3))
    assert scores.confident_half is scores.confident_quarter is None, "nobody is surer of it than of others"


def test_scores_are_plain_values():
    import json

    scores = evaluate(replace(recovery_of(grid(4, 1.0)), calibrated=True), grid(4, 1.0), metric=True).as_dict()
    assert json.loads(json.dumps(scores)) == scores


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        (grid(3, 1.0)[:26], "got 27 recovered and 26 true points; expected the truth of these very lines"),
        (np.full((27, 3), np.nan), r"got 27 line\(s\) with a truth that is NaN, infinite or beyond 1e30"),
        (np.zeros((27, 2)), r"got truth of shape \(27, 2\); expected \(lines, 3\)"),
    ],
)
def test_a_truth_of_other_lines_is_refused(truth, message, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(InputError, match=message):
        evaluate(recovery_of(grid(3, 1.0)), truth)


def test_calibration_error_is_the_gap_between_confidence_and_share():
    inside = np.arange(300) % 2 == 0
    assert calibration_error(np.full(300, 0.5), inside) == pytest.approx(0)
    assert calibration_error(np.full(300, 0.9), inside) == pytest.approx(0.4)
    # Bins hold equally many lines: here none mixes both kinds.
    third = np.arange(300) % 3 == 0
    assert calibration_error(third.astype(float), third) == 0
    assert calibration_error(1 - third.astype(float), third) == 1
    assert calibration_error(np.array([0.25]), np.array([True])) == pytest.approx(0.75)


def test_a_calibrated_confidence_has_a_small_calibration_error():
    rng = np.random.default_rng(0)
    confidence = rng.uniform(size=20000)
    inside = rng.uniform(size=20000) < confidence
    assert calibration_error(confidence, inside) < 0.02
    assert calibration_error(confidence**3, inside) > 0.1


def test_risk_coverage_keeps_the_confident_first():
    inside = np.array([True, False, True, False])
    coverage, risk = risk_coverage(np.array([0.9, 0.2, 0.8, 0.6]), inside)
    np.testing.assert_allclose(coverage, [0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(risk, [0, 0, 1 / 3, 0.5])


def test_ranking_is_the_share_of_pairs_in_order(rng: np.random.Generator) -> None:
    confidence = rng.integers(0, 5, 60) / 4
    inside = rng.random(60) < 0.3 + 0.4 * confidence
    right, wrong = confidence[inside], confidence[~inside]
    pairs = (right[:, None] > wrong).mean() + 0.5 * (right[:, None] == wrong).mean()
    assert ranking(confidence, inside) == pytest.approx(pairs)
    assert ranking(confidence, np.ones(60, dtype=bool)) is None


def test_true_neighbours_have_precision_one():
    points = np.random.default_rng(0).normal(size=(300, 3))
    for k in (1, 10, 299):
        scores = neighbor_scores(nearest_neighbors(points, k).index, points)
        assert (scores.precision, scores.under_half_outliers, scores.used) == (1.0, 1.0, k)


def test_random_neighbours_have_the_precision_of_chance():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400, 3))
    drawn = np.stack([np.delete(np.arange(400), i)[rng.permutation(399)[:40]] for i in range(400)])
    scores = neighbor_scores(drawn, points)
    assert scores.precision == pytest.approx(40 / 399, abs=0.01)
    assert scores.under_half_outliers == 0


def test_missing_neighbours_lower_the_k_they_are_judged_at():
    points = np.random.default_rng(0).normal(size=(300, 3))
    neighbors = nearest_neighbors(points, 20).index
    neighbors[:, 5:] = -1
    assert neighbor_scores(neighbors, points).precision == 1
    assert neighbor_scores(neighbors, points).used == 5
    neighbors[:150] = -1
    assert neighbor_scores(neighbors, points).precision == 1
    assert neighbor_scores(neighbors, points).used == 2.5
    assert neighbor_scores(np.full((300, 4), -1), points) == (0, 0, 0)


def test_affinities_weight_the_precision():
    points = np.random.default_rng(0).normal(size=(300, 3))
    table = np.argsort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)
    neighbors = np.concatenate([table[:, 1:5], table[:, -4:]], axis=1)
    affinity = np.where(np.arange(8) < 4, 0.9, 0.1)[None].repeat(300, axis=0)
    scores = neighbor_scores(neighbors, points, affinity)
    assert scores.precision == pytest.approx(0.9)
    assert scores.under_half_outliers == 1
    assert neighbor_scores(neighbors, points).under_half_outliers == 0


def test_reliability_bins_hold_all_lines_from_doubtful_to_sure():
    rng = np.random.default_rng(0)
    confidence = rng.uniform(size=1003)
    inside = rng.uniform(size=1003) < confidence**2
    bins = reliability(confidence, inside, 20)
    assert bins.lines.sum() == 1003 and np.ptp(bins.lines) <= 1 and len(bins.lines) == 20
    assert (np.diff(bins.confidence) > 0).all()
    assert (bins.lines * bins.confidence).sum() == pytest.approx(confidence.sum())
    assert (bins.lines * bins.inside).sum() == pytest.approx(inside.sum())
    assert len(reliability(confidence[:7], inside[:7], 20).lines) == 7


def test_right_neighbours_are_among_the_nearest_of_their_number():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60, 3))
    neighbors = np.argsort(rng.random((60, 60)), axis=1)[:, :9]
    neighbors[neighbors == np.arange(60)[:, None]] = -1
    neighbors[:5] = -1
    table = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(table, np.inf)
    for i, (row, right) in enumerate(zip(neighbors, right_neighbors(neighbors, points), strict=True)):
        nearest = np.argsort(table[i])[: (row >= 0).sum()]
        assert right.tolist() == [bool(j >= 0 and j in nearest) for j in row]


def test_what_is_right_may_be_given():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60, 3))
    neighbors = np.argsort(rng.random((60, 60)), axis=1)[:, :9]
    right = right_neighbors(neighbors, points)
    assert neighbor_scores(neighbors, points, right=right) == neighbor_scores(neighbors, points)


def test_affinities_rank_neighbours():
    rng = np.random.default_rng(0)
    affinity, shares = rng.random(500), np.arange(1, 11) / 10
    right = rng.random(500) < affinity
    order = np.argsort(-affinity)
    expected = [right[order[: round(500 * share)]].mean() for share in shares]
    np.testing.assert_allclose(affinity_precision(affinity, right, shares), expected)


def test_equal_affinities_rank_nothing():
    right = np.arange(90) < 30
    shares = np.array([0.1, 0.5, 1.0])
    np.testing.assert_allclose(affinity_precision(np.ones(90), right, shares), 1 / 3)
    # The upper half ties at 2/3, whatever the order of its pairs; then nothing is right.
    affinity = np.where(np.arange(90) < 45, 0.9, 0.1)
    np.testing.assert_allclose(affinity_precision(affinity, right, shares), [2 / 3, 2 / 3, 1 / 3])
