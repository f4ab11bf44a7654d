"""The learned attack with random weights: what must hold whatever the weights are."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import l2p
from l2p.attack import run
from l2p.learned import Learned, RoundConfig
from l2p.lines import LineCloud
from l2p.network import LineTransformer, NetworkConfig
from l2p.recovery import Recovery

#: Of the lines: samples on the borders of cells, and ties between candidates, fall either way.
SHARE = 0.99


def attack(rounds: int = 2, batch: int = 64, calibration: list[tuple[float, float]] | None = None) -> Learned:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        networks = [LineTransformer(NetworkConfig(width=8, layers=1, heads=2)) for _ in range(rounds)]
    return Learned(networks, RoundConfig(candidates=24, batch=batch), calibration)


@pytest.fixture(scope="module")
def lines(scene_points: np.ndarray) -> LineCloud:
    return l2p.lift(scene_points, seed=0)


@pytest.fixture(scope="module")
def first(lines: LineCloud) -> Recovery:
    return run(lines, attack())


def assert_nearly_all_close(one: np.ndarray, other: np.ndarray, share: float = SHARE) -> None:
    apart = np.linalg.norm(one - other, axis=1)
    assert (apart < 0.02).mean() >= share, f"{(apart >= 0.02).sum()} of {len(apart)} points differ"


def test_points_lie_on_their_lines(lines: LineCloud, first: Recovery) -> None:
    off = np.cross(first.xyz, lines.direction) - lines.moment
    assert np.abs(off).max() < 1e-9
    assert first.neighbors is not None and first.neighbors.shape == (len(lines), 24)
    assert first.affinity is not None and first.affinity.min() >= 0 and first.affinity.max() <= 1
    assert first.confidence.min() >= 0 and first.confidence.max() <= 1


def test_runs_are_equal_to_the_last_bit(lines: LineCloud, first: Recovery) -> None:
    np.testing.assert_array_equal(first.xyz, run(lines, attack()).xyz)


def test_batches_change_nothing(lines: LineCloud, first: Recovery) -> None:
    assert_nearly_all_close(first.xyz, run(lines, attack(batch=37)).xyz)


def test_flipped_directions_change_nothing(lines: LineCloud, first: Recovery, rng: np.random.Generator) -> None:
    sign = rng.choice([-1.0, 1.0], size=(len(lines), 1))
    assert_nearly_all_close(first.xyz, run(LineCloud(sign * lines.direction, sign * lines.moment), attack()).xyz)


def test_order_of_lines_changes_nothing(lines: LineCloud, first: Recovery, rng: np.random.Generator) -> None:
    order = rng.permutation(len(lines))
    shuffled = LineCloud(lines.direction[order], lines.moment[order])
    assert_nearly_all_close(first.xyz[order], run(shuffled, attack()).xyz)


def test_sliding_origins_changes_nothing(lines: LineCloud, first: Recovery, rng: np.random.Generator) -> None:
    moved = lines.origin + rng.normal(size=(len(lines), 1)) * lines.direction
    assert_nearly_all_close(first.xyz, run(LineCloud.through(moved, lines.direction), attack()).xyz)


def test_scale_and_shift_change_nothing(lines: LineCloud, first: Recovery) -> None:
    shift = np.array([30.0, -200.0, 7.0])
    moved = LineCloud.through(40 * lines.origin + shift, lines.direction)
    assert_nearly_all_close(first.xyz, (run(moved, attack()).xyz - shift) / 40)


def test_a_rigid_motion_changes_nothing(lines: LineCloud, first: Recovery, rng: np.random.Generator) -> None:
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn[:, 0] *= np.linalg.det(turn)
    shift = np.array([5.0, -2.0, 1.0])
    moved = LineCloud.through(lines.origin @ turn.T + shift, lines.direction @ turn.T)
    assert_nearly_all_close(first.xyz @ turn.T + shift, run(moved, attack()).xyz)


@pytest.mark.parametrize("count", [1, 2, 3, 20])
def test_few_lines_work(count: int, scene_points: np.ndarray) -> None:
    recovery = run(l2p.lift(scene_points[:count], seed=0), attack())
    assert recovery.xyz.shape == (count, 3) and np.isfinite(recovery.xyz).all()
    assert np.isfinite(recovery.confidence).all()


def test_coinciding_and_parallel_lines_work(scene_points: np.ndarray) -> None:
    same = l2p.lift(np.repeat(scene_points[:5], 8, axis=0), seed=0)
    parallel = LineCloud.through(scene_points[:40], np.repeat([[0.0, 0.6, 0.8]], 40, axis=0))
    twice = LineCloud(np.repeat(same.direction[:10], 4, axis=0), np.repeat(same.moment[:10], 4, axis=0))
    for cloud in (same, parallel, twice):
        assert np.isfinite(run(cloud, attack()).xyz).all()


def test_no_rounds_leave_the_tomography(lines: LineCloud) -> None:
    recovery = run(lines, attack(rounds=0))
    assert np.isfinite(recovery.xyz).all() and recovery.info["settings"]["rounds"] == 0


def test_calibration_of_the_last_round_makes_the_confidence(lines: LineCloud, first: Recovery) -> None:
    recovery = run(lines, attack(calibration=[(9.0, 9.0), (2.0, -1.0)]))
    sure = np.log(first.confidence / (1 - first.confidence))
    np.testing.assert_allclose(recovery.confidence, 1 / (1 + np.exp(1 - 2 * sure)), atol=1e-4)
    np.testing.assert_array_equal(recovery.xyz, first.xyz)
