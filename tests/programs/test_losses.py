"""What the network is trained for, and the calibration of what it says."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

pytest.importorskip("hydra", reason="the training program needs the extra train: pip install 'l2p[train]'")


from l2p.attacks.learned.edges import Edges, feature_names, vote_names
from l2p.attacks.learned.inputs import GEOMETRY, inputs_of
from l2p.attacks.learned.learned import Learned
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import Judgement, LineTransformer, NetworkConfig
from l2p.attacks.peak import PeakConfig
from train.clouds import CloudSource, lifted
from train.judging import Judged, calibrate, figures
from train.losses import BACKGROUND, Sample, affinity_loss, losses, position_loss, soft_labels

INPUTS = inputs_of(GEOMETRY)
EDGE, KINDS = feature_names(INPUTS), len(vote_names(INPUTS))
STATE, RADII, ONE = NetworkConfig.state, NetworkConfig.radii, NetworkConfig().one


def one_line(
    places: list[float], logits: list[float], true_beta: float, width: float = 0.2
) -> tuple[Sample, Judgement]:
    """A line in a cloud of spacing 0.5, whose candidates vote for one place each with all their votes."""
    k = len(places)
    edges = Edges(
        vote=torch.tensor(places)[None, :, None].repeat(1, 1, KINDS),
        foot=torch.tensor(places)[None],
        point_line=torch.zeros(1, k),
        scale=torch.full((1, k), width),
        confidence=torch.ones(1, k),
        feature=torch.zeros(1, k, len(EDGE)),
        state=torch.zeros(1, k, STATE),
        side=torch.ones(1, k),
        likeness=torch.zeros(1, k),
        valid=torch.ones(1, k, dtype=torch.bool),
    )
    judgement = Judgement(
        affinity=torch.zeros(1, k),
        place=torch.tensor(places)[None, :, None].repeat(1, 1, KINDS),
        spread=torch.full((1, k, KINDS), width),
        vote=torch.tensor(logits)[None, :, None].repeat(1, 1, KINDS),
        state=torch.zeros(1, STATE),
        found=torch.zeros(1, len(RADII)),
    )
    return Sample(edges, torch.full((1, k), 0.5), torch.tensor([true_beta]), torch.tensor([0.5])), judgement


def test_position_loss_is_the_mixture_over_a_floor() -> None:
    sample, judgement = one_line([0.1, 0.5], [0.0, 1.0], true_beta=0.3)
    spread = 0.2 * torch.linspace(-0.3, 0.2, KINDS).exp()
    weight, total = np.exp([0.0, 1.0]) / (KINDS * np.exp([0.0, 1.0]).sum()), 0.0
    for kind in range(KINDS):
        for place, share in zip((0.1, 0.5), weight, strict=True):
            width = spread[kind].item()
            total += share / (1 + ((place - 0.3) / width) ** 2) / (width / 0.5)
    expected = -np.log(total + np.exp(BACKGROUND))
    judgement = judgement._replace(spread=spread.expand(1, 2, KINDS))
    assert position_loss(judgement, sample).item() == pytest.approx(expected, rel=1e-5)


def test_position_loss_of_a_hopeless_line_is_bounded() -> None:
    sample, judgement = one_line([0.1], [0.0], true_beta=1e9)
    assert position_loss(judgement, sample).item() == pytest.approx(-BACKGROUND, abs=1e-4)


def test_position_loss_does_not_depend_on_the_unit_of_length() -> None:
    sample, judgement = one_line([0.1, 0.5], [0.0, 1.0], true_beta=0.3)
    larger = sample._replace(true_beta=40 * sample.true_beta, spacing=40 * sample.spacing)
    one = position_loss(judgement, sample)
    scaled = judgement._replace(place=40 * judgement.place, spread=40 * judgement.spread)
    other = position_loss(scaled, larger)
    torch.testing.assert_close(one, other)


def test_affinity_loss_leaves_padding_out() -> None:
    sample, judgement = one_line([0.1, 0.5], [0.0, 0.0], true_beta=0.3)
    padded = sample._replace(edges=sample.edges._replace(valid=torch.tensor([[True, False]])))
    judgement = judgement._replace(affinity=torch.tensor([[0.0, -torch.inf]]))
    assert affinity_loss(judgement, padded).item() == pytest.approx(np.log(2), rel=1e-6)


def test_soft_labels_fall_at_the_local_radius() -> None:
    label = soft_labels(torch.tensor([[0.0, 2.5, 10.0]]), torch.tensor([2.0]))
    assert label[0, 0] > 0.99 and label[0, 1] == 0.5 and label[0, 2] < 1e-6


def test_a_line_is_found_within_the_radii_that_its_error_is_below() -> None:
    """Votes at 0.5, the truth at 0.3, in a cloud of spacing 0.5: an error of 0.4 spacings."""
    sample, judgement = one_line([0.5, 0.5], [0.0, 0.0], true_beta=0.3)
    judgement = judgement._replace(found=torch.tensor([[-2.0, -1.0, 0.0, 1.0, 3.0]]))
    found = losses(sample, judgement, torch.zeros(1), LearnedConfig(peak=PeakConfig(trim=0)), RADII)
    assert found.moved.item() == pytest.approx(0.5) and found.error.item() == pytest.approx(0.4)
    inside = [radius >= 0.4 for radius in RADII]
    terms = [math.log1p(math.exp(-s if yes else s)) for s, yes in zip((-2, -1, 0, 1, 3), inside, strict=True)]
    assert found.found.item() == pytest.approx(sum(terms) / len(RADII), rel=1e-5)
    # The probe says log 1; a distance below 1 counts by half its square, and all of it a tenth.
    assert found.probe.item() == pytest.approx(0.1 * math.log(0.4) ** 2 / 2, rel=1e-4)
    assert found.total.item() == pytest.approx(sum(map(float, found[:4])), rel=1e-6)


def test_gradients_reach_every_weight() -> None:
    """Several processes could not average them otherwise."""
    network, probe = LineTransformer(NetworkConfig(width=8, layers=2, heads=2)), torch.nn.Linear(STATE, 1)
    attack = Learned(network, LearnedConfig(candidates=12))
    cloud = lifted(CloudSource("sim:room:150:0", 1.0, 0), attack)
    sample = cloud.sample(attack, cloud.state(), attack.candidates(cloud.state()), torch.arange(40))
    judgement = network(sample.edges)
    found = losses(sample, judgement, probe(judgement.state).squeeze(1), LearnedConfig(), RADII)
    found.total.backward()
    for name, part in [*network.named_parameters(), *probe.named_parameters()]:
        assert part.grad is not None and part.grad.isfinite().all() and part.grad.abs().max() > 0, name
    assert not found.moved.requires_grad and not found.error.requires_grad


# Calibration


def judged(logit: torch.Tensor, inside: torch.Tensor) -> Judged:
    """Lines within all radii or beyond all of them, with one logit for all radii."""
    return Judged(torch.where(inside, 0.0, 5.0), logit[:, None].repeat(1, len(RADII)).float())


def test_calibration_finds_the_probability() -> None:
    """Logits that are wrong by a known factor are put right, for each radius on its own."""
    draw = torch.Generator().manual_seed(0)
    logit = 2 * torch.randn(20000, len(RADII), generator=draw)
    known = [(0.5, 0.3), (1.0, 0.0), (2.0, -1.0), (0.7, 1.0), (1.3, -0.5)]
    for place, (a, b) in enumerate(known):
        inside = torch.rand(len(logit), generator=draw) < torch.sigmoid(a * logit[:, place] + b)
        error = torch.where(inside, 0.5, 1.5) * RADII[place]
        assert calibrate([Judged(error, logit)], RADII)[place] == pytest.approx((a, b), abs=0.1)


def test_every_cloud_counts_the_same_in_the_calibration() -> None:
    """Ten found lines weigh as much as a thousand that are not."""
    few, many = judged(torch.zeros(10), torch.ones(10).bool()), judged(torch.zeros(1000), torch.zeros(1000).bool())
    for _, offset in calibrate([few, many], RADII):
        assert offset == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("inside", [False, True])
def test_calibration_is_finite_where_all_lines_or_none_are_found(inside: bool) -> None:
    logit = torch.randn(100, generator=torch.Generator().manual_seed(0))
    for slope, offset in calibrate([judged(logit, torch.full((100,), inside))], RADII):
        assert slope > 0 and np.isfinite([slope, offset]).all() and (offset > 0) == inside


def test_figures_are_those_of_the_calibrated_last_round() -> None:
    rounds = [
        Judged(torch.tensor([4.0, 0.2, 3.0, 0.1]), torch.zeros(4, len(RADII))),
        Judged(torch.tensor([0.2, 0.4, 3.0, 9.0]), torch.tensor([2.0, -1.0, 1.0, -1.0])[:, None].repeat(1, len(RADII))),
    ]
    found = figures(CloudSource("sim:room:150:0", 0.5, 0), "lines", rounds, [(2.0, 1.0)] * len(RADII), ONE)
    assert found["known"] == "lines"
    assert found["lines"] == 4 and found["fraction"] == 0.5
    assert found["median"] == [0.2, 0.4] and found["within"] == [0.5, 0.5]
    assert found["confident_half"] == 0.5, "of the first and the third line"
    sure = 1 / (1 + np.exp(-(2 * np.array([2.0, -1.0, 1.0, -1.0]) + 1)))
    # Four lines, one in a bin: the mean distance of probability and truth.
    assert found["calibration_error"] == pytest.approx(np.abs(sure - [1, 1, 0, 0]).mean(), abs=1e-4)
