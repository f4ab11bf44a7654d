"""The learned attack with random weights: what must hold whatever the weights are."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from tiny import learned as attack

import l2p
from l2p.attacks.attack import Elements
from l2p.attacks.learned.knowledge import between_radii
from l2p.attacks.learned.learned import (
    Learned,
    LearnedConfig,
    Round,
    State,
    relaxed,
    spacing_ratio,
    weighted_peak,
)
from l2p.attacks.learned.network import NO_VOTE, Judgement, NetworkConfig
from l2p.attacks.learned.nodes import Estimates
from l2p.attacks.run import run
from l2p.attacks.tomography.posterior import modes
from l2p.attacks.tomography.reconstruct import reconstruct
from l2p.errors import InputError
from l2p.geometry.frame import Frame
from l2p.judging.accuracy import spacing
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.work.shards import BLOCK
from l2p.work.work import Work

RADII = NetworkConfig.radii
#: Of the lines: samples on the borders of cells, and ties between candidates, fall either way.
SHARE = 0.99


@pytest.fixture(scope="module")
def lines(scene_points: np.ndarray) -> LineCloud:
    return l2p.lift(scene_points, seed=0)


@pytest.fixture(scope="module")
def many(on_walls: Callable[[int], np.ndarray]) -> LineCloud:
    """Several blocks of lines."""
    return l2p.lift(on_walls(3 * BLOCK + 40), seed=0)


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


def begun(lines: LineCloud, method: Learned) -> State:
    """The state before the first round."""
    frame = Frame.of(lines)
    with torch.inference_mode():
        return method.begin(Elements.sorted(frame.enter(lines), frame), None, Work())


def test_threads_change_nothing(many: LineCloud) -> None:
    method, before = attack(), torch.get_num_threads()
    state, results = begun(many, method), []
    with torch.inference_mode():
        for threads in (1, 2):
            torch.set_num_threads(threads)
            try:
                results.append(method.judge(state))
            finally:
                torch.set_num_threads(before)
    one, two = results
    assert torch.equal(one.estimates.beta, two.estimates.beta)
    assert torch.equal(one.affinity, two.affinity)
    assert torch.equal(one.found, two.found)


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


def test_a_line_that_nobody_votes_on_is_not_sure(scene_points: np.ndarray) -> None:
    assert run(l2p.lift(scene_points[:1], seed=0), attack()).confidence[0] < 1e-9


def test_coinciding_and_parallel_lines_work(scene_points: np.ndarray) -> None:
    same = l2p.lift(np.repeat(scene_points[:5], 8, axis=0), seed=0)
    parallel = LineCloud.through(scene_points[:40], np.repeat([[0.0, 0.6, 0.8]], 40, axis=0))
    twice = LineCloud(np.repeat(same.direction[:10], 4, axis=0), np.repeat(same.moment[:10], 4, axis=0))
    for cloud in (same, parallel, twice):
        recovery = run(cloud, attack())
        assert np.isfinite(recovery.xyz).all() and np.isfinite(recovery.confidence).all()


def test_no_rounds_leave_the_modes_of_the_tomography(lines: LineCloud) -> None:
    recovery = run(lines, attack(rounds=0))
    frame = Frame.of(lines)
    beta, _ = modes(reconstruct(frame.enter(lines)))
    np.testing.assert_array_equal(recovery.beta, frame.leave(lines, beta))
    assert recovery.info["settings"]["rounds"] == 0
    assert recovery.neighbors is not None and recovery.neighbors.shape == (len(lines), 24)


@pytest.mark.parametrize("rounds", [1, 3])
def test_one_network_judges_every_line_in_every_round(many: LineCloud, rounds: int) -> None:
    method, seen = attack(rounds), []
    method.network.register_forward_hook(lambda _, given, __: seen.append(len(given[0].valid)))
    run(many, method)
    assert sum(seen) == rounds * len(many) and max(seen) == BLOCK


def test_a_round_starts_from_what_the_one_before_found(lines: LineCloud, first: Recovery) -> None:
    method = attack()
    state = begun(lines, method)
    with torch.inference_mode():
        after = method.judge(method.next(state, method.judge(state)))
    beta = after.estimates.beta[state.elements.row.argsort()]
    np.testing.assert_array_equal(first.beta, state.elements.frame.leave(lines, beta))
    assert not np.allclose(first.beta, run(lines, attack(rounds=1)).beta, atol=1e-3)


def test_relaxation_moves_estimates_on_but_not_those_that_jumped(lines: LineCloud) -> None:
    nodes = begun(lines, attack()).nodes
    share = torch.linspace(-2.5, 2.5, len(nodes.beta))
    told = Estimates(nodes.beta + share * nodes.scale, nodes.confidence, nodes.state)
    again = relaxed(nodes, told, LearnedConfig(relaxation=1.5))
    for i, part in enumerate(share.tolist()):
        factor = 1.5 if abs(part) < 1 else 1.0
        assert float(again.beta[i]) == pytest.approx(
            float(nodes.beta[i]) + factor * part * float(nodes.scale[i]), abs=1e-5
        )
    assert torch.equal(again.confidence, told.confidence) and torch.equal(again.state, told.state)
    assert torch.equal(relaxed(nodes, told, LearnedConfig(relaxation=1.0)).beta, told.beta)


def test_votes_settle_from_kuipers_peak_on() -> None:
    """Two votes of the lines' own crowd are moved together; absent ones are of no weight."""
    draw = torch.Generator().manual_seed(0)
    place = torch.randn(9, 6, 3, generator=draw)
    vote = torch.randn(9, 6, 3, generator=draw)
    vote[:, 4:], vote[0] = NO_VOTE, NO_VOTE
    some = torch.zeros(9, 6)
    judgement = Judgement(some, place, torch.full_like(place, 0.01), vote, some, some)
    kuiper = weighted_peak(judgement, LearnedConfig(settling=0))
    once = weighted_peak(judgement, LearnedConfig(settling=1))
    assert (once != kuiper)[1:].all() and ((once - kuiper).abs() < 1)[1:].all()
    moved = judgement._replace(place=torch.where(judgement.vote > NO_VOTE, place, 1e6))
    one, other = (weighted_peak(some, LearnedConfig()) for some in (judgement, moved))
    torch.testing.assert_close(one[1:], other[1:])


def test_calibration_of_the_last_round_makes_the_confidence(lines: LineCloud, first: Recovery) -> None:
    known = {"lines": [[(9.0, 9.0)] * len(RADII), [(2.0, -1.0)] * len(RADII)]}
    recovery = run(lines, attack(calibration=known))
    sure = np.log(first.confidence / (1 - first.confidence))
    np.testing.assert_allclose(recovery.confidence, 1 / (1 + np.exp(1 - 2 * sure)), atol=1e-4)
    np.testing.assert_array_equal(recovery.xyz, first.xyz)


def found(sure: torch.Tensor) -> Round:
    """A round with these logits."""
    nothing = torch.zeros(len(sure), 0)
    return Round(Estimates(nothing.sum(dim=1), torch.sigmoid(sure[:, 0]), nothing), nothing.int(), nothing, sure)


def test_each_radius_has_a_calibration_of_its_own() -> None:
    """The confidence is that of radius 1; what is within a smaller radius is within it, too."""
    sure = torch.randn(300, len(RADII), generator=torch.Generator().manual_seed(0)).cumsum(dim=1)
    pairs = [(1.0, 0.5), (2.0, 0.0), (0.5, -2.0), (1.5, -0.3), (1.0, 9.0)]
    method = attack(calibration={"lines": [[(7.0, 7.0)] * len(RADII), pairs]})
    upto = [a * sure[:, place] + b for place, (a, b) in enumerate(pairs)][: RADII.index(1.0) + 1]
    expected = torch.sigmoid(torch.stack(upto, dim=1).amax(dim=1))
    torch.testing.assert_close(method.confidence(method.calibrated_logits(found(sure), "lines")), expected)


@pytest.mark.parametrize("relaxation", [-1.0, 0.0, 2.0, math.nan])
def test_relaxations_that_do_not_settle_are_refused(relaxation: float) -> None:
    with pytest.raises(InputError, match=r"got relaxation .* of the learned attack; expected more than 0, less than 2"):
        LearnedConfig(relaxation=relaxation)


def test_more_rounds_than_calibrations_are_refused() -> None:
    with pytest.raises(InputError, match="got 1 calibrations of lines for 2 rounds"):
        attack(rounds=2, calibration={"lines": [[(1.0, 0.0)] * len(RADII)]})


@pytest.mark.parametrize("values", [{"rounds": -1}, {"candidates": 0}, {"settling": -1}])
def test_settings_out_of_range_are_refused(values: dict[str, int]) -> None:
    with pytest.raises(InputError, match=r"got \w+ -?\d of the learned attack; expected at least"):
        LearnedConfig(**values)  # type: ignore[arg-type]


def test_a_thinner_line_cloud_is_less_sure_about_the_map(lines: LineCloud, first: Recovery) -> None:
    last = first.confidence
    for fraction in (0.5, 0.1, 0.02):
        recovery = run(lines, attack(fraction=fraction))
        np.testing.assert_array_equal(recovery.xyz, first.xyz)
        assert (recovery.confidence < last).all()
        last = recovery.confidence


def test_the_spacing_of_a_map_follows_its_density() -> None:
    """Of uniform points in squares and cubes, whose dimensions lie on either side of that of maps."""
    densities = (1.0, 0.5, 0.2, 0.1, 0.05)
    ratios = [spacing_ratio(density) for density in densities]
    assert ratios[0] == 1 and ratios == sorted(ratios, reverse=True) and 0 < spacing_ratio(1e-9) < ratios[-1]
    rng = np.random.default_rng(0)
    flat, full = rng.random((8000, 2)), rng.random((8000, 3))
    for density, ratio in zip(densities[1:], ratios[1:], strict=True):
        count = round(density * len(flat))
        # Thick surfaces: the plane's spacing falls faster than the map's, the cube's more slowly.
        plane, cube = (
            spacing(np.pad(points, ((0, 0), (0, 3 - points.shape[1]))))
            / spacing(np.pad(points[:count], ((0, 0), (0, 3 - points.shape[1]))))
            for points in (flat, full)
        )
        assert 0.8 * plane < ratio < cube


def test_between_two_radii_the_logit_is_between_theirs() -> None:
    logit = torch.randn(50, len(RADII), generator=torch.Generator().manual_seed(0)).cummax(dim=1).values
    for place, radius in enumerate(RADII):
        torch.testing.assert_close(between_radii(logit, RADII, math.log(radius)), logit[:, place])
    places = torch.linspace(math.log(RADII[0]), math.log(RADII[-1]), 40)
    values = torch.stack([between_radii(logit, RADII, float(place)) for place in places], dim=1)
    assert (values.diff(dim=1) >= -1e-5).all()


def test_below_the_smallest_radius_the_logit_goes_on_falling() -> None:
    logit = torch.arange(len(RADII)).float()[None] + torch.tensor([[0.0], [-3.0]])
    one, other = (between_radii(logit, RADII, math.log(RADII[0]) - beyond) for beyond in (1.0, 2.0))
    assert (one < logit[:, 0]).all() and (other < one).all()
    torch.testing.assert_close(other - logit[:, 0], 2 * (one - logit[:, 0]))
