"""Coordinates far from the origin in single precision: each axis has a step of its own."""

import numpy as np
import pytest

from l2p.schemes.hide import hide
from l2p.schemes.rounding import lattice_step, resolution, resolution_words

UTM = np.array([5e5, 5.4e6, 100])


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 20, size=(400, 3))


@pytest.mark.parametrize("shift", [0, 1])
def test_each_axis_has_its_step_also_after_a_shift(points: np.ndarray, shift: int) -> None:
    georeferenced = (points + UTM).astype(np.float32).astype(np.float64) - shift * UTM
    assert resolution(georeferenced)[:2] == (2.0**-5, 0.5) and resolution(georeferenced)[2] < 1e-5
    assert resolution_words(georeferenced).startswith("coordinates have steps of 0.031 in x, 0.5 in y, ")
    hidden = hide(georeferenced, seed=0)
    true = hidden.truth.xyz
    # The nearest point of the line need not be the one that was moved; its offset is in the box of the steps.
    steps = lattice_step(georeferenced)[hidden.truth.index]
    nearest = np.cross(hidden.map.direction, hidden.map.moment - np.cross(true, hidden.map.direction))
    assert (np.linalg.norm(nearest, axis=1) <= np.linalg.norm(steps, axis=1) / 2 * 1.001).all()


def test_along_a_line_of_northings_heights_are_exact(points: np.ndarray) -> None:
    georeferenced = (points + UTM).astype(np.float32).astype(np.float64)
    assert (lattice_step(georeferenced)[:, 2] < 1e-5).all()


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_ordinary_maps_need_no_words(points: np.ndarray, kind: type) -> None:
    assert resolution_words(points.astype(kind).astype(np.float64)) == ""
    assert resolution_words((points + UTM).round(3)) == ""


def test_two_floors_are_no_step(points: np.ndarray) -> None:
    flat = (points + np.array([1e4, 1e4, 0])).astype(np.float32).astype(np.float64)
    flat[:, 2] = np.where(points[:, 2] < 10, 0.0, 4.0)
    assert lattice_step(flat)[:, 2].max() < 1e-5
