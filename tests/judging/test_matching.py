"""True and recovered points of one element are matched one to one, with the least total distance."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

import l2p
from l2p.errors import InputError
from l2p.judging.accuracy import compare, errors, matched
from l2p.judging.scores import evaluate


def recovery_of(xyz: np.ndarray, element: np.ndarray | None = None) -> l2p.Recovery:
    confidence = np.linspace(0.1, 0.9, len(xyz)).astype(np.float32)
    made = l2p.Recovery(xyz, confidence, np.zeros(len(xyz)), calibrated=True)
    return made if element is None else replace(made, element=element)


def truth_of(xyz: np.ndarray, element: np.ndarray | None = None) -> l2p.Truth:
    made = l2p.Truth(xyz, np.arange(len(xyz)), 1.0)
    return made if element is None else replace(made, element=element)


def slow_errors(recovery: l2p.Recovery, truth: l2p.Truth) -> np.ndarray:
    """Every assignment of every element, the best kept."""
    error = np.full(len(truth), np.inf)
    for element in set(truth.element.tolist()):
        points, rows = np.flatnonzero(truth.element == element), np.flatnonzero(recovery.element == element)
        small, large = sorted((points, rows), key=len)
        best = np.inf
        for chosen in permutations(large, len(small)):
            pairs = zip(small, chosen, strict=True) if small is points else zip(chosen, small, strict=True)
            apart = {point: float(np.linalg.norm(recovery.xyz[row] - truth.xyz[point])) for point, row in pairs}
            if apart and sum(apart.values()) < best:
                best = sum(apart.values())
                error[points] = np.inf
                error[list(apart)] = list(apart.values())
    return error


@pytest.mark.parametrize("seed", range(20))
def test_errors_are_those_of_every_assignment(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lines, points, rows = 12, rng.integers(1, 30), rng.integers(1, 30)
    truth = truth_of(rng.normal(size=(points, 3)), rng.integers(0, lines, points))
    recovery = recovery_of(rng.normal(size=(rows, 3)), rng.integers(0, lines, rows))
    np.testing.assert_allclose(errors(recovery, truth), slow_errors(recovery, truth))
    row = matched(recovery, truth)
    used = row[row >= 0]
    assert len(set(used)) == len(used), "no row twice"
    np.testing.assert_array_equal(recovery.element[used], truth.element[row >= 0])


def test_two_points_of_a_line_are_not_both_found_by_one_row() -> None:
    truth = truth_of(np.array([[0.0, 0, 0], [1, 0, 0]]), np.zeros(2, dtype=int))
    recovery = recovery_of(np.array([[0.9, 0, 0], [0.8, 0, 0]]), np.zeros(2, dtype=int))
    np.testing.assert_allclose(errors(recovery, truth), [0.8, 0.1])
    np.testing.assert_allclose(errors(recovery.rows(np.array([True, False])), truth), [np.inf, 0.1])


def test_rows_in_order_are_as_without_elements_to_the_last_bit(rng: np.random.Generator) -> None:
    truth, xyz = rng.normal(size=(40, 3)), rng.normal(size=(40, 3))
    plain = evaluate(recovery_of(xyz), truth, 1.0)
    assert evaluate(recovery_of(xyz), truth_of(truth)) == plain
    order = rng.permutation(40)
    shuffled = replace(recovery_of(xyz).rows(order), element=order)
    np.testing.assert_array_equal(errors(shuffled, truth), np.linalg.norm(xyz - truth, axis=1))
    assert evaluate(shuffled, truth_of(truth)) == plain


def test_a_point_without_a_row_is_wrong_and_nobody_is_sure_of_it() -> None:
    found = compare(recovery_of(np.zeros((1, 3)), np.array([1])), truth_of(np.zeros((2, 3)), np.arange(2)))
    assert found.row.tolist() == [-1, 0]
    assert found.error.tolist() == [np.inf, 0] and found.inside.tolist() == [False, True]
    assert found.confidence.tolist() == pytest.approx([0, 0.1])


@pytest.mark.parametrize("element", [np.array([0, 1]), np.array([0, -1, 2]), np.array([0.0, 1, 2])])
def test_wrong_elements_are_refused(element: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    import jaxtyping

    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    for made in (recovery_of, truth_of):
        with pytest.raises(InputError, match="got element"):
            made(np.zeros((3, 3)), element)


def test_spacing_is_that_of_the_truth_unless_another_is_given(rng: np.random.Generator) -> None:
    xyz = rng.normal(size=(60, 3))
    assert evaluate(recovery_of(xyz), truth_of(xyz)).spacing == 1.0
    assert evaluate(recovery_of(xyz), truth_of(xyz), spacing=2.0).spacing == 2.0
    measured = evaluate(recovery_of(xyz), replace(truth_of(xyz), spacing=None)).spacing
    assert measured == evaluate(recovery_of(xyz), xyz).spacing
