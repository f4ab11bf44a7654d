"""The peak of the votes: the batched search does what a plain loop does, and depends on nothing it should not."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from l2p.attacks.peak import PeakConfig, find_peak, settled

few = settings(max_examples=60, deadline=None)

# Whole numbers: ties are common, and shifts by whole numbers and scales by powers of two are exact.
votes_strategy = st.lists(st.integers(-30, 30), min_size=0, max_size=24)
# Of equal votes with different weights, the order says which one is trimmed.
distinct_votes = st.lists(st.integers(-30, 30), max_size=24, unique=True)
configs = st.builds(
    PeakConfig,
    threshold=st.sampled_from([0.0, 0.2, 0.3, 0.4, 0.7, 2.0]),
    minimum=st.integers(1, 6),
    trim=st.integers(0, 5),
)


def one_line(votes: object, weight: object = None, config: PeakConfig | None = None) -> float:
    """Place of the peak of one line's votes."""
    beta = torch.as_tensor(np.asarray(votes, dtype=np.float64)[None])
    weights = None if weight is None else torch.as_tensor(np.asarray(weight, dtype=np.float64)[None])
    return find_peak(beta, weights, config).item()


def loop_twin(beta: np.ndarray, weight: np.ndarray, config: PeakConfig) -> float:
    """Place of the peak of one line, one vote at a time."""
    votes = sorted((b, w) for b, w in zip(beta.tolist(), weight.tolist(), strict=True) if math.isfinite(b) and w > 0)
    trim = min(config.trim, max(0, (len(votes) - config.minimum) // 2))
    votes = votes[trim : len(votes) - trim]
    if not votes:
        return math.nan
    while len(votes) > config.minimum:
        low, high, value = loop_interval(votes)
        whole = len(votes)
        votes = votes[low : high + 1]
        if value < config.threshold or len(votes) == whole:
            break
    return weighted_median(votes)


def loop_interval(votes: list[tuple[float, float]]) -> tuple[int, int, float]:
    start, span = votes[0][0], votes[-1][0] - votes[0][0]
    if span == 0:
        return 0, len(votes) - 1, 0.0
    total = sum(w for _, w in votes)
    before, after, seen = [], [], 0.0
    for b, w in votes:
        before.append(seen / total - (b - start) / span)
        seen += w
        after.append(seen / total - (b - start) / span)
    pieces, begin = [], 0
    for j in range(1, len(votes)):
        if after[j - 1] > 0 and before[j] <= 0:
            pieces.append(range(begin, j))
            begin = j
    pieces.append(range(begin, len(votes)))
    found = []
    for piece in pieces:
        low = min(piece, key=lambda j: before[j])
        # The last of equals: F - U may be 0 both before its least and at the end.
        high = max((j for j in piece if j >= low), key=lambda j: (after[j], j))
        found.append((low, high, after[high] - before[low]))
    greatest = max(value for _, _, value in found)
    equal = [(low, high) for low, high, value in found if value >= greatest - 1e-6]
    return equal[0][0], equal[-1][1], greatest


def weighted_median(votes: list[tuple[float, float]]) -> float:
    half, seen = sum(w for _, w in votes) / 2, 0.0
    for j, (b, w) in enumerate(votes):
        seen += w
        if seen == half and j + 1 < len(votes):
            return (b + votes[j + 1][0]) / 2
        if seen >= half:
            return b
    raise AssertionError("the weights sum to more than their half")


@pytest.mark.parametrize("threshold", [0.0, 0.25, 0.4, 2.0])
@pytest.mark.parametrize(("minimum", "trim"), [(1, 0), (5, 5), (3, 1)])
def test_the_batch_agrees_with_the_loop_twin(threshold, minimum, trim):
    rng = np.random.default_rng(0)
    config = PeakConfig(threshold, minimum, trim)
    lines = 60
    beta = rng.standard_cauchy(size=(lines, 31))
    beta[: lines // 2, :12] = 3 + 0.1 * rng.normal(size=(lines // 2, 12))
    beta[rng.random(beta.shape) < 0.1] = np.nan
    beta[5, 4:], beta[6, 6:], beta[7, 1:], beta[8] = np.nan, np.inf, -np.inf, np.nan
    weight = rng.choice([0.0, 0.5, 1, 2], size=beta.shape)
    found = find_peak(torch.tensor(beta), torch.tensor(weight), config)
    expected = np.array([loop_twin(b, w, config) for b, w in zip(beta, weight, strict=True)])
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@given(votes_strategy, configs)
@few
def test_the_peak_lies_among_the_votes(votes, config):
    beta = one_line(votes, config=config)
    if not votes:
        assert math.isnan(beta)
        return
    assert min(votes) <= beta <= max(votes)
    # A vote, or the middle of two.
    assert (2 * beta) % 1 == 0


@given(votes_strategy, configs, st.integers(-1000, 1000), st.integers(-8, 8))
@few
def test_the_peak_moves_and_scales_with_the_votes(votes, config, shift, power):
    scale = 2.0**power
    beta = one_line(votes, config=config)
    moved = one_line([scale * (vote + shift) for vote in votes], config=config)
    np.testing.assert_array_equal(moved, scale * (beta + shift))


@given(votes_strategy, configs, st.integers(-20, 20), st.integers(0, 2**32 - 1))
@few
def test_only_the_proportions_of_the_weights_matter(votes, config, power, seed):
    weight = np.random.default_rng(seed).integers(0, 4, len(votes)).astype(float)
    np.testing.assert_array_equal(one_line(votes, weight, config), one_line(votes, 2.0**power * weight, config))
    np.testing.assert_array_equal(one_line(votes, config=config), one_line(votes, np.full(len(votes), 0.25), config))


@given(distinct_votes, configs, st.integers(0, 2**32 - 1))
@few
def test_the_order_of_the_votes_does_not_matter(votes, config, seed):
    rng = np.random.default_rng(seed)
    weight, order = rng.integers(1, 4, len(votes)), rng.permutation(len(votes))
    shuffled = np.array(votes)[order] if votes else votes
    np.testing.assert_array_equal(one_line(votes, weight, config), one_line(shuffled, weight[order], config))


@given(distinct_votes, configs, st.integers(0, 2**32 - 1))
@few
def test_a_vote_of_weight_zero_or_not_finite_is_absent(votes, config, seed):
    rng = np.random.default_rng(seed)
    weight = rng.integers(1, 4, len(votes)).astype(float)
    expected = one_line(votes, weight, config)
    order = rng.permutation(len(votes) + 4)
    more = np.array([*votes, 7, np.nan, np.inf, -np.inf], dtype=float)[order]
    np.testing.assert_array_equal(one_line(more, np.array([*weight, 0, 1, 1, 1])[order], config), expected)


@given(votes_strategy, st.data(), st.sampled_from([0.0, 0.3, 0.5]))
@few
def test_a_vote_twice_is_a_vote_of_weight_two(votes, data, threshold):
    # Trimming and the least number of votes count votes, not weights.
    config = PeakConfig(threshold, minimum=1, trim=0)
    twice = data.draw(st.lists(st.booleans(), min_size=len(votes), max_size=len(votes)))
    doubled = [vote for vote, double in zip(votes, twice, strict=True) for _ in range(1 + double)]
    one, other = one_line(votes, 1 + np.array(twice, dtype=float), config), one_line(doubled, config=config)
    np.testing.assert_array_equal(one, other)


@given(st.lists(votes_strategy, min_size=1, max_size=5), configs)
@few
def test_lines_do_not_see_each_other(lines, config):
    table = np.full((len(lines), max(map(len, lines))), np.nan)
    for row, votes in zip(table, lines, strict=True):
        row[: len(votes)] = votes
    together = find_peak(torch.tensor(table), config=config).numpy()
    np.testing.assert_array_equal(together, [one_line(votes, config=config) for votes in lines])


def test_degenerate_votes_have_a_defined_peak():
    nan = math.nan
    cases = [
        ([], nan),
        ([nan, math.inf, -math.inf], nan),
        ([4.0], 4),
        ([4.0, math.inf], 4),
        ([1.0, 4.0], 2.5),
        ([4.0] * 3, 4),
        ([4.0] * 50, 4),
    ]
    for votes, expected in cases:
        np.testing.assert_array_equal(one_line(votes), expected)


def test_two_weighted_votes_are_placed_at_the_heavier():
    assert one_line([1, 4], [1, 3]) == 4
    assert one_line([1, 4], [2, 2]) == 2.5


@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (0, 0)])
def test_no_lines_or_no_votes_are_no_error(shape):
    found = find_peak(torch.zeros(shape))
    assert found.shape == shape[:1] and found.isnan().all()


@pytest.mark.parametrize("seed", range(5))
def test_a_cluster_amid_scattered_votes_is_found(seed):
    rng = np.random.default_rng(seed)
    votes = np.concatenate([5 + 0.2 * rng.normal(size=60), rng.uniform(-20, 20, 20)])
    assert one_line(votes) == pytest.approx(5, abs=0.3)


# The rule of the paper's main text may keep both clusters in one interval; its appendix is about this case.
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("sizes", "place"), [((40, 20), -5), ((20, 40), 5)])
def test_of_two_clusters_the_larger_is_found(seed, sizes, place):
    rng = np.random.default_rng(seed)
    clusters = [centre + 0.2 * rng.normal(size=size) for centre, size in zip((-5, 5), sizes, strict=True)]
    votes = np.concatenate([*clusters, rng.uniform(-20, 20, 20)])
    assert one_line(votes) == pytest.approx(place, abs=0.3)


@pytest.mark.parametrize(("heavy", "place"), [(slice(0, 30), -5), (slice(30, 60), 5)])
def test_weights_choose_between_two_equal_clusters(heavy, place):
    rng = np.random.default_rng(0)
    votes = np.concatenate([rng.normal(-5, 0.2, 30), rng.normal(5, 0.2, 30)])
    weight = np.full(60, 0.3)
    weight[heavy] = 1
    assert one_line(votes, weight) == pytest.approx(place, abs=0.3)


def test_a_touch_of_both_distributions_before_the_least_does_not_lose_the_peak():
    # F meets U at the second vote and at the last one, with the least of F - U between them.
    assert one_line([0, 5, 8, 10], config=PeakConfig(minimum=2, trim=0)) == 9


def votes_around(seed: int, lines: int = 20, k: int = 12) -> tuple[torch.Tensor, ...]:
    """Places, weights and spreads, and starts near the first vote of each line."""
    draw = torch.Generator().manual_seed(seed)
    place, weight = torch.randn(lines, k, generator=draw).double(), torch.rand(lines, k, generator=draw).double()
    spread = 0.2 + torch.rand(lines, k, generator=draw).double()
    return place[:, 0] + 0.1, place, weight, spread


@pytest.mark.parametrize("seed", range(3))
def test_votes_settle_where_the_likelihood_is_greatest_nearby(seed):
    """Against a descent of its own, with the gradient from autograd."""
    start, place, weight, spread = votes_around(seed)

    def loss(beta):
        return (weight * torch.log1p(((beta[:, None] - place) / spread).square())).sum(dim=1)

    found = settled(start, place, weight, spread, 400).requires_grad_()
    torch.testing.assert_close(
        torch.autograd.grad(loss(found).sum(), found)[0], torch.zeros_like(start), atol=1e-6, rtol=0
    )
    last = loss(start)
    for steps in range(1, 12):
        now = loss(settled(start, place, weight, spread, steps))
        assert (now <= last + 1e-12).all(), "no step goes uphill"
        last = now


def test_settling_moves_scales_and_flips_with_the_votes():
    start, place, weight, spread = votes_around(7)
    found = settled(start, place, weight, spread, 6)
    moved = settled(-3 * start + 5, -3 * place + 5, 7 * weight, 3 * spread, 6)
    torch.testing.assert_close(moved, -3 * found + 5)
    assert torch.equal(settled(start, place, weight, spread, 0), start)


def test_finer_votes_settle_the_place_and_another_peak_does_not():
    """Two fine votes at 0, four rough ones around 0.3, and a crowd at 50."""
    place = torch.tensor([[0.0, 0.0, 0.2, 0.3, 0.3, 0.4, *[50.0] * 6]]).double()
    spread = torch.tensor([[0.02, 0.02, 0.5, 0.5, 0.5, 0.5, *[0.5] * 6]]).double()
    found = settled(torch.tensor([0.3]).double(), place, torch.ones(1, 12).double(), spread, 50)
    assert abs(float(found)) < 0.01
