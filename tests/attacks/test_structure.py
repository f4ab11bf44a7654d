"""Lines through pairs of points and through centres: who votes, what the tomography makes of them, and the attacks."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

import l2p
from l2p.attacks.families import other_points_near_lines, other_points_near_points
from l2p.attacks.learned.embedding import compared
from l2p.attacks.learned.nodes import Estimates
from l2p.attacks.learned.pairing import assigned
from l2p.attacks.published import two_peaks
from l2p.attacks.structure import NO_STRUCTURE, Structure
from l2p.attacks.structured import expanded, frame_of, structure_of
from l2p.attacks.tomography import reconstruct as tomography
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.nearest import nearest_points_to_other_lines
from l2p.geometry.pairs import point_line_distance
from l2p.maps.lines import LineCloud
from l2p.schemes.recognition import recognise
from l2p.work.work import ALONE


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    return l2p.simulate("room", 700, seed=2)


@pytest.fixture(scope="module")
def pairs(scene):
    return l2p.hide(scene, 0, 1.0, "ppl", rgb=True)


@pytest.fixture(scope="module")
def rays(scene):
    return l2p.hide(scene, 0, 1.0, "rays", rgb=True)


def some_lines(count: int, seed: int = 0) -> tuple[Lines, torch.Tensor]:
    """Lines and points near the origin, which do not belong together."""
    draw = torch.Generator().manual_seed(seed)
    points, direction = torch.randn(count, 3, generator=draw), torch.randn(count, 3, generator=draw)
    direction = torch.nn.functional.normalize(direction, dim=1)
    through = torch.randn(count, 3, generator=draw)
    return Lines(direction, torch.linalg.cross(through, direction)), points


# Structure


def test_sorted_elements_keep_their_twins_and_families():
    twin = torch.tensor([1, 0, 3, 2, 5, 4])
    family = torch.tensor([0, 0, 1, 1, 0, 1])
    row = torch.tensor([4, 2, 0, 5, 1, 3])
    moved = Structure(twin, family, torch.zeros(2, 3)).sorted(row)
    assert moved.twin is not None and moved.family is not None
    assert row[moved.twin].tolist() == twin[row].tolist()
    assert moved.family.tolist() == family[row].tolist()
    assert NO_STRUCTURE.sorted(row) == NO_STRUCTURE


def test_lines_of_pairs_come_twice_with_one_appearance_each(pairs):
    single, row = expanded(pairs.map, "ppl")
    assert row.tolist() == np.repeat(np.arange(len(pairs.map)), 2).tolist()
    assert single.rgb is not None
    assert (single.rgb[0::2] == pairs.map.rgb).all() and (single.rgb[1::2] == pairs.map.second.rgb).all()
    assert (single.direction[0::2] == single.direction[1::2]).all()
    # Truth and appearances are in the same order.
    assert (np.repeat(pairs.truth.element.reshape(-1, 2)[:, 0], 2) == row).all()


def test_a_ray_that_misses_all_centres_gets_the_nearest(rays):
    found = recognise(rays.map)
    assert found.family is not None and len(found.centers) == 2
    lost = replace(found, family=np.full(len(rays.map), -1))
    frame = frame_of(rays.map, "rays", found)
    kept, filled = (structure_of(rays.map, "rays", each, frame).family for each in (found, lost))
    assert kept is not None and filled is not None and torch.equal(kept, filled)


def test_the_frame_of_rays_is_as_large_as_the_distance_of_the_centres(rays):
    found = recognise(rays.map)
    frame = frame_of(rays.map, "rays", found)
    assert frame.unit == pytest.approx(np.linalg.norm(found.centers[0] - found.centers[1]))
    np.testing.assert_allclose(frame.center, found.centers.mean(axis=0))


# Who votes


@pytest.mark.parametrize("count", [40, 5000])
def test_points_near_other_lines_are_those_of_a_plain_search(count):
    lines, points = some_lines(count)
    queries = lines.rows(slice(0, 20))
    scale = torch.linspace(0.5, 2, count)
    near = nearest_points_to_other_lines(queries, points, 7, scale=scale)
    for row in range(20):
        direction, moment = (part[row].expand_as(points) for part in queries)
        distance = point_line_distance(points, direction, moment) / scale
        np.testing.assert_allclose(near.distance[row], distance.sort().values[:7], rtol=1e-4, atol=1e-6)


def test_fewer_points_than_neighbours_are_padded():
    lines, points = some_lines(3)
    assert nearest_points_to_other_lines(lines, points, 7).index.shape == (3, 3)


def test_rays_of_one_family_do_not_vote_for_each_other():
    lines, points = some_lines(60)
    family = torch.arange(60) % 3
    by_line = other_points_near_lines(lines, points, 50, torch.ones(60), family, ALONE)
    by_point = other_points_near_points(points, 50, family, ALONE)
    for near in (by_line, by_point):
        seen = near.index >= 0
        assert (seen.sum(dim=1) == 40).all(), "all of the others, and padding"
        apart = family[near.index.clamp_min(0).long()] != family[:, None]
        assert apart[seen].all() and torch.isinf(near.distance[~seen]).all()


def test_appearances_find_their_places():
    """Points of two colours, each colour in a place of its own: all lines join the places, half of them exchanged."""
    draw = torch.Generator().manual_seed(1)
    count = 80
    place = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]]).repeat(count, 1)
    place += 0.05 * torch.randn(2 * count, 3, generator=draw)
    middle = (place[0::2] + place[1::2]) / 2
    direction = torch.nn.functional.normalize(place[1::2] - place[0::2], dim=1).repeat_interleave(2, dim=0)
    lines = Lines(direction, torch.linalg.cross(middle.repeat_interleave(2, dim=0), direction))
    true = ((place - lines.foot) * direction).sum(dim=1)
    twin = torch.arange(2 * count) ^ 1
    exchanged = (torch.rand(count, generator=draw) < 0.4).repeat_interleave(2)
    beta = torch.where(exchanged, true[twin], true)
    colour = torch.eye(2)[torch.arange(2 * count) % 2] * 2
    found = assigned(lines, Estimates(beta, beta.abs(), beta[:, None]), twin, compared(colour, ("rgb",)))
    right = (found.beta - true).abs() < 1e-6
    assert right.float().mean() > 0.95 or right.float().mean() < 0.05, "one place for each colour"
    assert torch.equal(found.confidence, found.beta.abs()), "all that belongs to an estimate moves with it"


# Tomography


def test_the_other_point_of_a_line_counts_by_the_squared_distance():
    draw = torch.Generator().manual_seed(0)
    along, beta = torch.rand(5, 9, generator=draw), torch.randn(5, 9, generator=draw)
    found = tomography._of_partner(along, beta)
    for line in range(5):
        share = along[line] / along[line].sum()
        twin = [sum(float(share[b] * (beta[line, a] - beta[line, b]) ** 2) for b in range(9)) for a in range(9)]
        np.testing.assert_allclose(found[line], twin, rtol=1e-4)


def test_the_two_places_of_a_line_are_the_best_of_all_pairs(pairs):
    recognition = recognise(pairs.map)
    single, _ = expanded(pairs.map, "ppl")
    frame = frame_of(single, "ppl", recognition)
    structure, lines = structure_of(single, "ppl", recognition, frame), frame.enter(single)
    _, level, density = tomography._converged(lines, tomography.TomographyConfig(levels=2), ALONE, structure)
    rows = slice(0, 12)
    found = tomography._pair(level, density, rows)
    along, beta = tomography._along(level, density, rows), level.beta[rows]
    for line in range(12):
        best = max(
            float(along[line, a] * along[line, b] * (beta[line, a] - beta[line, b]) ** 2)
            for a in range(beta.shape[1])
            for b in range(beta.shape[1])
        )
        at = [int((beta[line] - place).abs().argmin()) for place in found[line]]
        assert float(along[line, at[0]] * along[line, at[1]] * (found[line, 0] - found[line, 1]) ** 2) == pytest.approx(
            best, rel=1e-4
        )


def test_rays_take_their_density_from_the_other_family(rays):
    """Without the other family, nothing is known of the depth but the weight r^2."""
    recognition = recognise(rays.map)
    frame = frame_of(rays.map, "rays", recognition)
    lines, structure = frame.enter(rays.map), structure_of(rays.map, "rays", recognition, frame)
    both = tomography.reconstruct(lines, structure=structure)
    truth = frame.enter_points(rays.truth.xyz)
    error = ((both.beta * both.probability).sum(dim=1) - ((truth - lines.foot) * lines.direction).sum(dim=1)).abs()
    assert structure.center is not None and structure.family is not None
    blind = tomography.reconstruct(lines)
    lost = ((blind.beta * blind.probability).sum(dim=1) - ((truth - lines.foot) * lines.direction).sum(dim=1)).abs()
    assert error.median() < 0.5 * lost.median()


# Attacks


@pytest.mark.parametrize("method", ["tomography", "learned"])
def test_both_points_of_a_line_are_recovered(pairs, method):
    found = l2p.recover(pairs.map, method)
    assert found.element.tolist() == np.repeat(np.arange(len(pairs.map)), 2).tolist()
    assert (found.xyz[0::2] != found.xyz[1::2]).any(axis=1).mean() > 0.99
    assert found.info["recognised"]["scheme"] == "ppl"
    scores = l2p.evaluate(found, pairs.truth)
    assert scores.within_spacings["1"] > 0.4 and scores.both_within_1 > 0.2


@pytest.mark.parametrize("method", ["tomography", "learned", "published"])
def test_rays_are_recovered(rays, method):
    found = l2p.recover(rays.map, method)
    scores = l2p.evaluate(found, rays.truth)
    assert scores.within_spacings["1"] > 0.15, "as if they were uniform, hardly one of them"


@pytest.mark.parametrize("scheme", ["ppl", "rays"])
def test_points_do_not_depend_on_place_size_and_order(scheme, pairs, rays):
    lines = (pairs if scheme == "ppl" else rays).map
    order = np.random.default_rng(0).permutation(len(lines))
    turned = lines.rows(order)
    through, direction = 7 * turned.origin + [1.0, -2, 30], -turned.direction
    moved = LineCloud.through(through, direction, turned.appearance, lines.scheme, turned.second)
    first, second = (l2p.recover(each, "tomography") for each in (lines, moved))
    places = first.xyz.reshape(len(lines), -1, 3)[order] * 7 + [1.0, -2, 30]
    again = second.xyz.reshape(len(lines), -1, 3)
    apart = np.minimum(
        np.abs(places - again).max(axis=(1, 2)), np.abs(places - again[:, ::-1]).max(axis=(1, 2))
    )  # which of two points is the first is not told
    assert np.quantile(apart, 0.9) < 1e-3 * np.ptp(places.reshape(-1, 3), axis=0).max()


def test_two_peaks_are_those_of_a_plain_density():
    draw = torch.Generator().manual_seed(0)
    clusters = [0.3 + 0.02 * torch.randn(6, 40, generator=draw), -1 + 0.02 * torch.randn(6, 25, generator=draw)]
    votes = torch.cat(clusters, dim=1)
    found, height = two_peaks(votes, torch.ones_like(votes, dtype=torch.bool), 0.1, 3.0)
    grid = np.arange(-3, 3, 0.005)
    for row in range(6):
        density = np.exp(-0.5 * ((grid[:, None] - votes[row].numpy()) / 0.1) ** 2).sum(axis=1)
        top = [i for i in range(1, len(grid) - 1) if density[i] > density[i - 1] and density[i] >= density[i + 1]]
        best = grid[sorted(top, key=lambda i: -density[i])[:2]]
        np.testing.assert_allclose(found[row], best, atol=0.03)
    assert (height[:, 0] >= height[:, 1]).all() and (height <= 1).all()


def test_the_published_attacks_are_for_pairs_and_rays():
    lines = l2p.lift(l2p.simulate("room", 100, seed=0).xyz, seed=0)
    with pytest.raises(InputError, match="neither rays of a few centres nor pairs for the method published"):
        l2p.recover(lines, "published")


def test_two_processes_give_the_same_points(pairs, tmp_path):
    l2p.save(pairs.map, tmp_path / "lines.npz")
    for name, processes in (("one", "1"), ("two", "2")):
        words = ["recover", str(tmp_path / "lines.npz"), "-o", str(tmp_path / f"{name}.npz"), "--rounds", "1"]
        subprocess.run(
            [sys.executable, "-m", "l2p", *words, "--processes", processes, "--threads", "1"], check=True, timeout=300
        )
    one, two = (l2p.load(tmp_path / f"{name}.npz", l2p.Recovery) for name in ("one", "two"))
    np.testing.assert_array_equal(one.element, two.element)
    assert np.quantile(np.abs(one.xyz - two.xyz).max(axis=1), 0.99) < 1e-3
