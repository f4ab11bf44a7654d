"""What the attack takes for neighbours, how they vote, and how sure the vote is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from l2p.attacks import votes as neighborhoods
from l2p.attacks.attack import Attack, Elements, Estimate, locate
from l2p.attacks.heuristic import Heuristic, HeuristicConfig
from l2p.attacks.peak import PeakConfig, find_peak
from l2p.attacks.run import run
from l2p.attacks.votes import member, vote
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.nearest import nearest_lines_to_lines
from l2p.geometry.pairs import closest_points
from l2p.schemes.hide import hide
from l2p.work.work import ALONE, Work


def crossing(truth: np.ndarray, seed: int = 0) -> tuple[Lines, torch.Tensor]:
    """Lines of random direction through the points, and where on them the points are."""
    direction = np.random.default_rng(seed).normal(size=truth.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    beta = torch.tensor(np.sum(truth * direction, axis=1))
    return Lines(torch.tensor(direction), torch.tensor(np.cross(truth, direction))), beta


def in_order(lines: Lines, frame: Frame) -> Elements:
    """Lines in the order they have."""
    return Elements(lines, torch.arange(len(lines.direction)), frame)


@pytest.fixture(scope="module")
def clusters() -> tuple[Lines, torch.Tensor, torch.Tensor]:
    """Four tight clusters of 15 points, the place of each on its line, and its cluster mates."""
    rng = np.random.default_rng(1)
    centre = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4]]).repeat(15, axis=0)
    lines, beta = crossing(centre + 0.001 * rng.normal(size=(60, 3)))
    mates = torch.tensor([[j for j in range(60) if j // 15 == i // 15 and j != i] for i in range(60)])
    return lines, beta, mates


def test_neighbours_that_pass_through_the_same_place_find_it(clusters):
    lines, beta, mates = clusters
    estimate = vote(lines, mates)
    assert (estimate.beta - beta).abs().max() < 0.01
    assert torch.equal(estimate.neighbors, mates)
    assert (estimate.affinity == 1).all()


def test_a_vote_is_the_peak_of_the_closest_points(clusters):
    lines, _, _ = clusters
    neighbors = nearest_lines_to_lines(lines, 20).index
    affinity = torch.rand(60, 20, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    config = PeakConfig(threshold=0.4)
    votes = closest_points(lines, lines, neighbors)
    expected = find_peak(votes.beta, affinity * votes.valid, config)
    torch.testing.assert_close(vote(lines, neighbors, affinity, config).beta, expected)


def test_affinities_decide_whose_vote_counts(clusters):
    lines, _, mates = clusters
    strangers = torch.tensor([[j for j in range(60) if j // 15 != i // 15][:30] for i in range(60)])
    neighbors = torch.cat([mates, strangers], dim=1)
    affinity = torch.cat([torch.ones(60, 14), torch.zeros(60, 30)], dim=1).double()
    np.testing.assert_allclose(vote(lines, neighbors, affinity).beta, vote(lines, mates).beta, atol=1e-12)


@pytest.mark.parametrize("votes", [1, 50, 1000])
def test_blocks_do_not_show_in_the_vote(clusters, votes, monkeypatch):
    lines, _, _ = clusters
    neighbors = nearest_lines_to_lines(lines, 20).index
    whole = vote(lines, neighbors)
    monkeypatch.setattr(neighborhoods, "VOTES", votes)
    for part, expected in zip(vote(lines, neighbors), whole, strict=True):
        torch.testing.assert_close(part, expected)


def test_without_a_vote_a_line_is_placed_at_its_foot_and_not_trusted(clusters):
    lines, _, mates = clusters
    neighbors = mates.clone()
    neighbors[3] = -1
    # A line is parallel to itself.
    neighbors[4] = 4
    estimate = vote(lines, neighbors)
    assert (estimate.beta[3:5] == 0).all() and (estimate.confidence[3:5] == 0).all()
    assert (estimate.confidence[5:] > 0).all()


@pytest.mark.parametrize("count", [1, 5])
def test_no_neighbours_at_all_are_no_error(count):
    lines, _ = crossing(np.random.default_rng(0).normal(size=(count, 3)))
    estimate = vote(lines, torch.zeros(count, 0, dtype=torch.int64))
    assert (estimate.beta == 0).all() and (estimate.confidence == 0).all()
    assert estimate.neighbors.shape == estimate.affinity.shape == (count, 0)


def test_confidence_is_a_share_and_ranks_the_lines(scene_points):
    hidden = hide(scene_points, seed=3)
    lines, index = hidden.map, hidden.truth.index
    frame = Frame.of(lines)
    inside = frame.enter(lines)
    estimate = locate(Heuristic(), in_order(inside, frame), ALONE)
    assert estimate.confidence.min() >= 0 and estimate.confidence.max() <= 1
    truth = frame.enter_points(scene_points[index])
    error = (inside.at(estimate.beta) - truth).norm(dim=1)
    order = estimate.confidence.argsort(descending=True)
    half = len(order) // 2
    assert error[order[:half]].median() < 0.7 * error[order[half:]].median()


def test_all_votes_in_one_place_are_more_sure_than_scattered_ones(clusters):
    lines, _, mates = clusters
    neighbors = mates.clone()
    neighbors[0] = torch.arange(20, 34)
    confidence = vote(lines, neighbors).confidence
    assert confidence[0] < confidence[1:].min()


@pytest.mark.parametrize(
    ("kind", "density", "coarse", "fine"),
    [
        ("outdoor", 1.0, 500, 200),
        ("outdoor", 0.25, 500, 200),
        ("outdoor", 0.05, 100, 50),
        ("indoor", 1.0, 250, 100),
        ("indoor", 0.1, 250, 100),
        ("indoor", 0.05, 50, 25),
        ("indoor", 0.01, 50, 25),
    ],
)
def test_neighbour_counts_are_those_of_the_paper(kind, density, coarse, fine):
    config = HeuristicConfig(scene_kind=kind, fraction=density)
    assert (config.coarse, config.fine) == (coarse, fine)
    settings = Heuristic(config).settings()
    assert (settings["coarse"], settings["fine"], settings["rounds"]) == (coarse, fine, 3)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"scene_kind": "urban"}, "got scene kind 'urban'; expected one of indoor, outdoor"),
        ({"fraction": 0.0}, r"got fraction 0.0; expected a number in \(0, 1\]"),
        ({"fraction": 1.5}, r"got fraction 1.5; expected a number in \(0, 1\]"),
        ({"rounds": -1}, "got -1 rounds; expected 0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(setting, message):
    with pytest.raises(InputError, match=message):
        HeuristicConfig(**setting)


def located(heuristic: Heuristic, points: np.ndarray, seed: int = 3) -> tuple[Estimate, torch.Tensor]:
    hidden = hide(points, seed=seed)
    lines, index = hidden.map, hidden.truth.index
    frame = Frame.of(lines)
    estimate = locate(heuristic, in_order(frame.enter(lines), frame), ALONE)
    error = (frame.enter(lines).at(estimate.beta) - frame.enter_points(points[index])).norm(dim=1)
    return estimate, error


def test_without_rounds_the_nearest_lines_vote(scene_points):
    lines = hide(scene_points, seed=3).map
    inside = Frame.of(lines).enter(lines)
    estimate, _ = located(Heuristic(HeuristicConfig(rounds=0)), scene_points)
    expected = vote(inside, nearest_lines_to_lines(inside, 250).index)
    torch.testing.assert_close(estimate.beta, expected.beta)


def test_rounds_help(scene_points):
    coarse, fine = (
        np.mean([located(Heuristic(config), scene_points, seed)[1].median() for seed in range(5)])
        for config in (HeuristicConfig(rounds=0), HeuristicConfig())
    )
    assert fine < 0.95 * coarse


def test_neighbours_are_near_both_ways_or_all_near_the_line(scene_points):
    always, _ = located(Heuristic(HeuristicConfig(rounds=1, intersection=0)), scene_points)
    never, _ = located(Heuristic(HeuristicConfig(rounds=1, intersection=10**6)), scene_points)
    usual, _ = located(Heuristic(HeuristicConfig(rounds=1)), scene_points)
    assert (never.neighbors >= 0).all()
    kept, some = (always.neighbors >= 0).sum(dim=1), (usual.neighbors >= 0).sum(dim=1)
    assert (kept > 0).all() and (kept < 100).any()
    few = kept <= 10
    assert (some[few] == 100).all() and torch.equal(some[~few], kept[~few])
    own = torch.arange(len(kept))[:, None]
    assert (usual.neighbors != own).all()


def test_member_is_the_loop_over_sets():
    generator = torch.Generator().manual_seed(0)
    values = torch.randint(-1, 12, (40, 7), generator=generator)
    sets = torch.randint(-1, 12, (40, 5), generator=generator)
    expected = [[v >= 0 and v in s for v in row] for row, s in zip(values.tolist(), sets.tolist(), strict=True)]
    assert member(values, sets).tolist() == expected
    assert not member(values, sets[:, :0]).any()
    assert member(values[:, :0], sets).shape == (40, 0)


def test_an_attack_of_ones_own_needs_one_function_only(scene_points):
    class Feet(Attack):
        def finish(self, state: Elements, work: Work) -> Estimate:
            own = len(range(len(state))[work.own(len(state))])
            return vote(state.lines, torch.zeros(own, 0, dtype=torch.int64), work=work)

    lines = hide(scene_points, seed=0).map
    result = run(lines, Feet())
    distance = np.linalg.norm(result.xyz - Frame.of(lines).center, axis=1)
    nearest = np.linalg.norm(np.cross(Frame.of(lines).center, lines.direction) - lines.moment, axis=1)
    np.testing.assert_allclose(distance, nearest, atol=1e-6)
    assert result.info["method"] == "Feet" and result.info["settings"] == {}
