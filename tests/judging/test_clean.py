"""Outlier removal keeps what is dense and drops what is far away."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from l2p.errors import InputError
from l2p.io.open3d import load_open3d
from l2p.judging.clean import inliers


def test_far_points_are_dropped_and_dense_ones_kept():
    rng = np.random.default_rng(0)
    dense, far = rng.normal(size=(1000, 3)), rng.normal(size=(10, 3)) * 5 + 60
    mask = inliers(np.concatenate([dense, far]))
    assert mask[:1000].mean() > 0.85
    assert not mask[1000:].any()


def test_the_order_and_scale_of_the_points_do_not_matter():
    points = np.random.default_rng(0).standard_t(2, size=(500, 3))
    order = np.random.default_rng(1).permutation(500)
    mask = inliers(points)
    assert 0 < mask.sum() < 500
    np.testing.assert_array_equal(inliers(points[order]), mask[order])
    np.testing.assert_array_equal(inliers(8 * points), mask)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_so_few_points_have_no_outliers(count):
    assert inliers(np.zeros((count, 3))).all()


def test_open3d_that_does_not_load_is_explained(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match=r"Open3D does not load .* apt install libusb-1\.0-0 libgl1 libegl1 libx11-6"):
        load_open3d()
