"""Permuted points have swapped one coordinate with one other point, and nothing tells which."""

from __future__ import annotations

import numpy as np
import pytest

import l2p


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(401, 3))


def test_each_two_points_swap_one_coordinate(points: np.ndarray) -> None:
    hidden = l2p.hide(points, seed=1, scheme="permuted")
    stored, truth = hidden.map.xyz[hidden.truth.element], hidden.truth
    assert sorted(truth.index) == list(range(400)), "the odd last point is left out"
    axes = []
    for i in range(400):
        differs = np.flatnonzero(stored[i] != truth.xyz[i])
        assert len(differs) == 1
        axis = int(differs[0])
        partner = np.flatnonzero(truth.xyz[:, axis] == stored[i, axis])
        assert len(partner) == 1 and stored[partner[0], axis] == truth.xyz[i, axis]
        axes.append(axis)
    assert (np.bincount(axes, minlength=3) > 90).all()
    for axis in range(3):
        np.testing.assert_array_equal(np.sort(stored[:, axis]), np.sort(truth.xyz[:, axis]))


def test_partners_are_not_stored_side_by_side(points: np.ndarray) -> None:
    hidden = l2p.hide(points, seed=1, scheme="permuted")
    element = hidden.truth.element
    apart = []
    for i in range(400):
        axis = int(np.argmax(hidden.map.xyz[element[i]] != hidden.truth.xyz[i]))
        partner = int(np.flatnonzero(hidden.truth.xyz[:, axis] == hidden.map.xyz[element[i], axis])[0])
        apart.append(abs(element[i] - element[partner]))
    assert np.median(apart) == pytest.approx(400 * (1 - np.sqrt(0.5)), rel=0.25)


def test_digits_do_not_tell_a_swapped_coordinate(points: np.ndarray) -> None:
    """In a map of which half is in single precision, a number of the other half would stand out."""
    mixed = points.copy()
    mixed[::2] = mixed[::2].astype(np.float32)
    stored = l2p.lift(mixed, seed=1, scheme="permuted").xyz
    assert (stored != stored.astype(np.float32)).all()
