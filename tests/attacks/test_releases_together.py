"""Several releases of one map: which lines meet in their point, and what is recovered of them together."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import l2p
from l2p.attacks.meetings import Meetings, meetings
from l2p.geometry.elements import Lines

#: The cheapest attack, where any will do for the lines that do not meet.
CHEAP = {"method": "tomography", "rounds": 0}


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return l2p.simulate("room", 500, 3).xyz


def entered(lines: l2p.LineCloud) -> Lines:
    return Lines(torch.as_tensor(lines.direction.copy()), torch.as_tensor(lines.moment.copy()))


def partner(found: Meetings, lines: int) -> np.ndarray:
    best = found.best(lines)
    surely = np.append(np.where(found.probability >= 0.5, found.other, -1), -1)
    return surely[best]


def true_partner(first: l2p.Hiding, second: l2p.Hiding) -> np.ndarray:
    row = {index: number for number, index in enumerate(second.truth.index)}
    return np.array([row.get(index, -1) for index in first.truth.index])


def released(points: np.ndarray, *fractions: float) -> list[l2p.Hiding]:
    return [l2p.hide(points, seed=seed, fraction=share) for seed, share in enumerate(fractions)]


def test_every_line_meets_that_of_its_point_and_nobody_tells_which(points):
    first, second = released(points, 1, 1)
    found = meetings(entered(first.map), entered(second.map))
    np.testing.assert_array_equal(partner(found, 500), true_partner(first, second))
    best = found.best(500)
    np.testing.assert_allclose(first.map.at(found.beta[best]), first.truth.xyz, atol=1e-9)


def test_a_partner_has_the_line_as_its_own(points):
    first, second = released(np.round(points, 2), 0.9, 0.6)
    there = meetings(entered(first.map), entered(second.map))
    back = meetings(entered(second.map), entered(first.map))
    pairs = {(a, b): p for a, b, p in zip(there.row, there.other, there.probability, strict=True)}
    swapped = {(b, a): p for a, b, p in zip(back.row, back.other, back.probability, strict=True)}
    assert pairs.keys() == swapped.keys() and len(pairs) > 250
    np.testing.assert_allclose([swapped[key] for key in pairs], list(pairs.values()), atol=1e-6)


def test_no_line_has_more_than_one_partner(points):
    first, second = released(np.round(points, 2), 1, 1)
    found = meetings(entered(first.map), entered(second.map))
    for row in (found.row, found.other):
        assert np.bincount(row, found.probability).max() < 1.01


def test_probabilities_are_honest_where_lines_meet_by_accident_too():
    """Coordinates of two decimals: many lines meet within the noise."""
    right, sure = [], []
    for seed in range(4):
        spread = np.round(np.random.default_rng(seed).uniform(size=(500, 3)) * [4, 3, 2], 2)
        first, second = (l2p.hide(spread, seed=2 * seed + number, fraction=0.7) for number in (0, 1))
        found = meetings(entered(first.map), entered(second.map))
        right.append(found.other == true_partner(first, second)[found.row])
        sure.append(found.probability)
    right, sure = np.concatenate(right), np.concatenate(sure)
    assert abs(right.sum() - sure.sum()) < 0.1 * right.sum()
    unsure = (sure > 0.1) & (sure < 0.9)
    assert unsure.sum() > 50 and abs(right[unsure].mean() - sure[unsure].mean()) < 0.15


def test_partners_do_not_depend_on_order_sign_place_and_size(points):
    first, second = (each.map for each in released(points, 1, 0.5))
    known = l2p.recover_releases([first, second], **CHEAP)
    rng = np.random.default_rng(0)
    order = rng.permutation(len(first))
    sign = rng.choice([-1.0, 1.0], size=(len(first), 1))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    size, shift = 30.0, np.array([100.0, -50.0, 20.0])

    def moved(lines: l2p.LineCloud) -> l2p.LineCloud:
        return l2p.LineCloud.through(size * lines.origin @ turn.T + shift, lines.direction @ turn.T)

    turned = moved(first)
    changed = l2p.LineCloud(turned.direction[order] * sign, turned.moment[order] * sign)
    found = l2p.recover_releases([changed, moved(second)], **CHEAP)
    met = known.confidence[order] > 0.9
    assert met.sum() > 240
    np.testing.assert_allclose(found.xyz[met], (size * known.xyz @ turn.T + shift)[order][met], atol=1e-6)
    assert found.info["met"] == known.info["met"]


def test_lines_whose_point_is_in_one_release_only_keep_the_place_of_the_attack(points):
    first, second = released(points, 0.6, 0.5)
    both = true_partner(first, second) >= 0
    maps = first.map, second.map
    direction, moment = (np.concatenate([getattr(each, name) for each in maps]) for name in ("direction", "moment"))
    together = l2p.LineCloud(direction, moment)
    alone, found = l2p.recover(together, **CHEAP), l2p.recover_releases([first.map, second.map], **CHEAP)
    error = np.linalg.norm(found.xyz - first.truth.xyz, axis=1)
    assert np.quantile(error[both], 0.95) < 1e-9
    kept = found.beta == alone.beta[: len(found)]
    assert kept[~both].mean() > 0.95 and not kept[both].any()
    assert abs(found.info["met"] - both.sum()) < 0.03 * len(both)


def test_three_releases_give_away_what_two_of_them_share(points):
    first, *others = released(points, 0.8, 0.5, 0.5)
    maps = [first.map, *(each.map for each in others)]
    shared = np.any([true_partner(first, each) >= 0 for each in others], axis=0)
    found = l2p.recover_releases(maps, **CHEAP)
    assert np.quantile(np.linalg.norm(found.xyz - first.truth.xyz, axis=1)[shared], 0.95) < 1e-9
    assert found.info["releases"] == [400, 250, 250]
    assert abs(found.info["met"] - shared.sum()) < 12 and shared.sum() > 250


def test_releases_of_different_maps_have_hardly_a_meeting(points):
    first, second = l2p.hide(points[:250], seed=0), l2p.hide(points[250:], seed=1)
    assert l2p.recover_releases([first.map, second.map], **CHEAP).info["met"] <= 2


def test_two_releases_in_one_file_are_found_within_it(points):
    first, second = released(points, 1, 1)
    together = Lines(*(torch.cat(both) for both in zip(entered(first.map), entered(second.map), strict=True)))
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(0))
    found = partner(meetings(together.rows(order)), 1000)
    index = np.concatenate([first.truth.index, second.truth.index])[order]
    np.testing.assert_array_equal(index[found], index)
    assert (found != np.arange(1000)).all() and (found[found] == np.arange(1000)).all()


def test_equal_descriptors_tell_the_partner_where_lines_meet_by_accident(points):
    rng = np.random.default_rng(0)
    descriptor = rng.integers(0, 256, (500, 16), dtype=np.uint8)
    scene = l2p.Scene(np.round(points, 1), descriptor=descriptor, descriptor_kind="toy")
    first, second = (l2p.hide(scene, seed=seed, descriptor=True) for seed in (0, 1))
    true = true_partner(first, second)
    described = first.map.descriptor, second.map.descriptor
    shares = []
    for known in (None, described):
        found = meetings(entered(first.map), entered(second.map), known)
        shares.append(np.mean(partner(found, 500) == true))
    assert shares[0] < 0.5 and shares[1] > 0.95


def test_parallel_lines_have_no_partner_and_nothing_breaks(points):
    along = np.tile([0.0, 0.0, 1.0], (40, 1))
    first, second = (l2p.LineCloud.through(points[:40] + shift, along) for shift in (0.0, 1e-3))
    assert not meetings(entered(first), entered(second)).row.size
    along[::2] = [0.0, 1.0, 0.0]
    third = l2p.LineCloud.through(points[:40], along)
    found = partner(meetings(entered(first), entered(third)), 40)
    assert (found[1::2] == -1).all()


@pytest.mark.parametrize("counts", [(1, 1), (1, 30), (3, 2)])
def test_few_lines_claim_nothing_and_break_nothing(points, counts):
    first, second = (l2p.lift(points[:count], seed=seed) for seed, count in enumerate(counts))
    found = l2p.recover_releases([first, second], **CHEAP)
    assert len(found) == counts[0] and np.isfinite(found.xyz).all()


def test_bad_releases_are_refused_in_one_sentence(points):
    lines = l2p.lift(points, seed=0)
    with pytest.raises(l2p.InputError, match=r"got 1 release\(s\); expected at least two"):
        l2p.recover_releases([lines])
    turned = l2p.LineCloud(-lines.direction, -lines.moment)
    with pytest.raises(l2p.InputError, match="got releases 1 and 3 with 500 equal lines"):
        l2p.recover_releases([lines, l2p.lift(points, seed=1), turned])
    with pytest.raises(l2p.InputError, match="without lines"):
        l2p.recover_releases([lines, lines.rows(np.zeros(0, dtype=np.int64))])
