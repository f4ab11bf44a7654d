"""Planes are across the axes of their servers, or of random normals; pooled servers join on descriptors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest

import l2p


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    rng = np.random.default_rng(0)
    descriptor = np.arange(300, dtype=np.float32)[:, None].repeat(4, axis=1)
    return l2p.Scene(rng.normal(size=(300, 3)), descriptor=descriptor, descriptor_kind="own")


def test_one_server_has_one_coordinate(scene: l2p.Scene) -> None:
    hidden = l2p.hide(scene, seed=1, scheme="planes")
    planes, truth = hidden.map, hidden.truth
    np.testing.assert_array_equal(planes.normal, np.tile([1.0, 0, 0], (300, 1)))
    for xyz, element in zip(truth.xyz, truth.element, strict=True):
        assert planes.offset[element] == xyz[0]


def test_pooled_servers_give_every_point_back(scene: l2p.Scene) -> None:
    hidden = l2p.hide(scene, seed=1, scheme="planes-pooled", descriptor=True)
    planes, truth = hidden.map, hidden.truth
    assert len(planes) == len(truth) == 900
    assert (np.bincount(truth.index) == 3).all() and len(set(truth.element)) == 900
    assert planes.descriptor is not None
    joined: dict[float, dict[int, float]] = {}
    for normal, offset, descriptor in zip(planes.normal, planes.offset, planes.descriptor, strict=True):
        joined.setdefault(float(descriptor[0]), {})[int(normal.argmax())] = offset
    for name, own in joined.items():
        np.testing.assert_array_equal([own[axis] for axis in range(3)], scene.xyz[int(name)])


def test_servers_have_orders_of_their_own(scene: l2p.Scene) -> None:
    truth = l2p.hide(scene, seed=1, scheme="planes-pooled").truth
    orders = truth.index[np.argsort(truth.element)].reshape(3, 300)
    for one in range(3):
        assert abs(np.corrcoef(orders[one], np.arange(300))[0, 1]) < 0.25
        assert abs(np.corrcoef(orders[one], orders[one - 1])[0, 1]) < 0.25


def test_the_spacing_of_pooled_planes_is_that_of_the_points(scene: l2p.Scene) -> None:
    """A point that three planes hide is one point."""
    pooled = l2p.hide(scene, seed=1, scheme="planes-pooled").truth
    perfect = l2p.Recovery(pooled.xyz, np.ones(900, np.float32), np.zeros(900), element=pooled.element)
    assert l2p.evaluate(perfect, pooled).spacing == pytest.approx(
        l2p.evaluate(l2p.Recovery(scene.xyz, np.ones(300, np.float32), np.zeros(300)), scene.xyz).spacing
    )


def test_random_normals_are_uniform_and_sorted(scene: l2p.Scene) -> None:
    points = np.random.default_rng(1).normal(size=(4000, 3))
    hidden = l2p.hide(points, seed=1, scheme="planes-random")
    normal = hidden.map.normal
    assert kstest(normal[:, 2], "uniform").pvalue > 1e-3
    np.testing.assert_array_equal(np.lexsort(normal.T), np.arange(4000))
    for xyz, element in zip(hidden.truth.xyz[:200], hidden.truth.element[:200], strict=True):
        assert hidden.map.offset[element] == pytest.approx(sum(normal[element] * xyz), abs=1e-12)
