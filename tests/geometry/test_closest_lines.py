"""The exact search of lines near lines, against a plain loop over all pairs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from l2p.geometry import closest_lines
from l2p.geometry.closest_lines import nearest_lines
from l2p.geometry.elements import Lines


def random_lines(count: int, seed: int) -> Lines:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Lines(torch.as_tensor(direction), torch.as_tensor(np.cross(rng.normal(size=(count, 3)), direction)))


def slow_distance(a: Lines, i: int, b: Lines, j: int) -> float:
    """Distance of two lines by the common normal, infinite where they are parallel."""
    normal = np.cross(a.direction[i], b.direction[j])
    length = np.linalg.norm(normal)
    between = a.foot[i].numpy() - b.foot[j].numpy()
    return float(abs(between @ normal) / length) if length > 1e-3 else np.inf


@pytest.mark.parametrize(("itself", "block"), [(True, 1 << 21), (True, 64), (False, 100)])
def test_search_is_that_of_a_plain_loop(monkeypatch, itself, block):
    monkeypatch.setattr(closest_lines, "_BLOCK", block)
    lines = random_lines(40, 0)
    others = random_lines(30, 1) if itself else lines
    others.direction[3] = lines.direction[5]
    others.moment[3] = lines.moment[5] + torch.linalg.cross(lines.direction[6], lines.direction[5])
    found = nearest_lines(lines, others, 7, itself=itself)
    for i in range(40):
        rows = [j for j in range(len(others.direction)) if itself or j != i]
        slow = {j: slow_distance(lines, i, others, j) for j in rows}
        wanted = sorted(slow.values())[:7]
        np.testing.assert_allclose(found.distance[i], wanted, rtol=1e-9)
        np.testing.assert_allclose([slow[int(j)] for j in found.index[i]], wanted, rtol=1e-9)


def test_fewer_lines_than_wanted_give_fewer_columns():
    one, few = random_lines(1, 0), random_lines(3, 1)
    assert nearest_lines(one, few, 7).index.shape == (1, 3)
    assert nearest_lines(one, one, 7, itself=False).index.shape == (1, 0)


def test_parallel_lines_are_infinitely_far():
    lines = random_lines(5, 0)
    lines.direction[:] = lines.direction[0]
    assert nearest_lines(lines, lines, 3, itself=False).distance.isinf().all()
