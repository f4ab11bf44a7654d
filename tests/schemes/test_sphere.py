"""Sphere clouds have the true directions among fakes that carry the appearance of points that were left out."""

from __future__ import annotations

import numpy as np
import pytest

import l2p


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    rng = np.random.default_rng(0)
    descriptor = np.arange(4 * 401, dtype=np.float32).reshape(401, 4)
    return l2p.Scene(rng.normal((3, 0, 9), size=(401, 3)), descriptor=descriptor, descriptor_kind="own")


def test_directions_are_those_from_the_mean(scene: l2p.Scene) -> None:
    hidden = l2p.hide(scene, seed=1, scheme="sphere")
    mean = [sum(column) / 401 for column in scene.xyz.T.tolist()]
    for xyz, element in zip(hidden.truth.xyz, hidden.truth.element, strict=True):
        away = xyz - mean
        np.testing.assert_allclose(hidden.map.direction[element], away / np.sqrt(away @ away), atol=1e-12)
    np.testing.assert_allclose(np.cross(mean, hidden.map.direction), hidden.map.moment, atol=1e-12)
    assert (hidden.map.direction[:, 2] < 0).any(), "the sign is published"


@pytest.mark.parametrize(("name", "fakes"), [("sphere-50", 1), ("sphere-33", 2), ("sphere-25", 3)])
def test_fakes_take_the_place_of_points(scene: l2p.Scene, name: str, fakes: int) -> None:
    hidden = l2p.hide(scene, seed=1, scheme=name, descriptor=True)
    lines, truth = hidden.map, hidden.truth
    true = 401 // (1 + fakes)
    assert len(truth) == true and len(lines) == true * (1 + fakes)
    assert len(set(truth.element)) == len(set(truth.index)) == true
    assert lines.descriptor is not None and scene.descriptor is not None
    owner = (lines.descriptor[:, 0] / 4).astype(int)
    np.testing.assert_array_equal(lines.descriptor, scene.descriptor[owner])
    np.testing.assert_array_equal(owner[truth.element], truth.index)
    assert len(set(owner)) == len(lines), "no appearance is there twice"
    # Fakes: noise of 0.1 on each component of a true direction.
    fake = np.setdiff1d(np.arange(len(lines)), truth.element)
    nearest = (lines.direction[fake] @ lines.direction[truth.element].T).max(axis=1)
    assert np.degrees(np.arccos(np.minimum(nearest, 1))).max() < 30
    np.testing.assert_allclose(np.linalg.norm(lines.direction, axis=1), 1, atol=1e-12)


def test_the_noise_of_fakes_is_a_tenth() -> None:
    """Of two points, one is a true ray; its fake is the other line."""
    cosines = []
    for seed in range(300):
        lines = l2p.lift(np.array([[0.0, 0, 0], [1, 2, 2]]), seed=seed, scheme="sphere-50")
        cosines.append(lines.direction[0] @ lines.direction[1])
    # Across the ray two components of noise 0.1: tan^2 has the mean 2 * 0.01, up to the component along it.
    tangent2 = 1 / np.square(cosines) - 1
    assert tangent2.mean() == pytest.approx(0.0206, rel=0.2)


def test_the_subset_of_true_rays_is_random(scene: l2p.Scene) -> None:
    index = np.concatenate([l2p.hide(scene, seed=seed, scheme="sphere-25").truth.index for seed in range(20)])
    assert np.bincount(index, minlength=401).max() < 16 and index.mean() == pytest.approx(200, abs=12)
