"""Attacks on planes, permuted points and sphere clouds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import l2p
from l2p.attacks.alike import Classes, classes_of
from l2p.attacks.by_scheme import has_own_attack
from l2p.attacks.density_grid import blurred, flat, maximised
from l2p.attacks.from_permuted import PermutedConfig, axis_weights, line_cells, recover_permuted, voted
from l2p.attacks.from_planes import PlanesConfig, least_squares, plane_cells, recover_planes
from l2p.attacks.from_spheres import SpheresConfig, meeting_point, real, recover_spheres
from l2p.attacks.learned.embedding import compared
from l2p.attacks.plane_frame import plane_frame
from l2p.attacks.pooled import servers
from l2p.errors import InputError
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud

POINTS = 400
#: Coarse grids and few classes, so that a test takes a second.
PLANES = PlanesConfig(side=10, steps=4, classes=4)
PERMUTED = PermutedConfig(side=10, steps=4, classes=4)


@pytest.fixture(scope="module")
def scene() -> l2p.Scene:
    return room(POINTS)


def room(points: int) -> l2p.Scene:
    """A room whose descriptors follow the place."""
    xyz = l2p.simulate("room", points, seed=1).xyz
    rng = np.random.default_rng(0)
    wave = np.sin(xyz @ rng.normal(size=(3, 128)) + rng.uniform(0, 6, 128))
    descriptor = np.clip(60 + 40 * wave + rng.normal(0, 10, wave.shape), 0, 255).astype(np.uint8)
    return l2p.Scene(xyz, descriptor=descriptor, descriptor_kind="sift")


def turned(seed: int = 3) -> np.ndarray:
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return turn * np.linalg.det(turn)


# Kernels against plain loops


def test_cells_of_a_plane_are_those_of_a_loop(rng):
    side = 6
    normal = rng.normal(size=(20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = rng.uniform(-1.2, 1.2, size=20)
    cell, weight = plane_cells(torch.as_tensor(normal).float(), torch.as_tensor(offset).float(), side)
    center = (np.arange(side) + 0.5) * 2 / side - 1
    for row in range(20):
        axis = int(np.abs(normal[row]).argmax())
        one, two = (each for each in range(3) if each != axis)
        wanted = set()
        for i in range(side):
            for j in range(side):
                rest = offset[row] - normal[row, one] * center[i] - normal[row, two] * center[j]
                level = int(np.floor((rest / normal[row, axis] + 1) / 2 * side))
                if 0 <= level < side:
                    index = [0, 0, 0]
                    index[one], index[two], index[axis] = i, j, level
                    wanted.add(index[0] * side * side + index[1] * side + index[2])
        assert set(cell[row][weight[row] > 0].tolist()) == wanted


def test_cells_of_a_permuted_point_are_those_of_a_loop(rng):
    side = 5
    bins = torch.as_tensor(rng.integers(0, side, (8, 3)))
    cells = line_cells(bins, side)
    for row, own in enumerate(bins.tolist()):
        wanted = []
        for axis in range(3):
            for place in range(side):
                index = [*own]
                index[axis] = place
                wanted.append(index[0] * side * side + index[1] * side + index[2])
        assert cells[row].tolist() == wanted


def test_weights_of_axes_are_the_shares_of_equal_values():
    bins = torch.tensor([[0, 1, 2], [0, 2, 2], [1, 2, 2], [0, 0, 2]])
    assert axis_weights(bins, 3).tolist() == [[0.75, 0.25, 1], [0.75, 0.5, 1], [0.25, 0.5, 1], [0.75, 0.25, 1]]


def test_a_step_of_the_density_is_that_of_a_loop(rng):
    side, count = 4, 12
    classes = Classes(torch.as_tensor(rng.integers(0, 2, count)), torch.tensor([[1.5, 0.5], [0.5, 2.0]]))
    cell = torch.as_tensor(np.array([rng.permutation(side**3)[:9] for _ in range(count)]))
    weight = torch.as_tensor(rng.uniform(size=(count, 9))).float()
    density = torch.as_tensor(rng.uniform(size=(2, side**3))).float()
    blocks = (slice(0, 5), slice(5, count))
    found = maximised(density, classes, side, lambda: ((rows, cell[rows], weight[rows]) for rows in blocks))
    mass = np.zeros((2, side**3))
    for row in range(count):
        own = int(classes.label[row])
        part = density[own, cell[row]].numpy() * weight[row].numpy()
        for place, share in zip(cell[row].tolist(), part / part.sum(), strict=True):
            mass[own, place] += share
    around = blurred(torch.as_tensor(mass).float().view(2, side, side, side)).view(2, -1)
    seen = classes.ratio @ around / count
    torch.testing.assert_close(found, seen + 1e-3 * seen.mean(dim=1, keepdim=True))


def test_blur_keeps_the_mass_and_is_a_binomial():
    grid = torch.zeros(1, 5, 5, 5)
    grid[0, 2, 2, 2] = 64
    found = blurred(grid)
    assert found.sum() == 64
    assert found[0, 2, 2, 2] == 8 and found[0, 1, 2, 2] == 4 and found[0, 1, 1, 1] == 1


def test_classes_follow_the_appearance_not_the_order(rng):
    vector = torch.as_tensor(rng.normal(size=(60, 4))).float()
    order = torch.as_tensor(rng.permutation(60))
    one, other = (classes_of(compared(each, ("rgb",)), 60, 5, 1.0) for each in (vector, vector[order]))
    assert torch.equal(one.label[order], other.label)
    torch.testing.assert_close(one.ratio, other.ratio, rtol=1e-3, atol=1e-5)
    assert torch.equal(classes_of(None, 3, 5, 1.0).ratio, flat(Classes(one.label, torch.ones(1, 1)), 1))


def test_least_squares_to_true_neighbours_of_one_point_is_that_point(rng):
    point = np.array([0.3, -0.2, 0.5])
    normal = rng.normal(size=(30, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    others = torch.as_tensor(np.array([[j for j in range(30) if j != i] for i in range(30)]))
    found = least_squares(torch.as_tensor(normal).float(), torch.as_tensor(normal @ point).float(), others)
    np.testing.assert_allclose(found.numpy(), np.tile(point, (30, 1)), atol=1e-5)


# Planes


def test_random_planes_are_recovered_by_geometry_and_better_by_likeness(scene):
    hidden = l2p.hide(scene, 0, scheme="planes-random", descriptor=True)
    alone = l2p.evaluate(recover_planes(hidden.map.without({"descriptor"}), PLANES), hidden.truth)
    both = l2p.evaluate(recover_planes(hidden.map, PLANES), hidden.truth)
    # A random point of a plane is within 1 spacing of the true one in about 1 of 30.
    assert alone.within_1 > 0.1 and both.within_1 > 0.1
    assert alone.confidence_auc > 0.5


def test_points_lie_in_their_planes(scene):
    hidden = l2p.hide(scene, 0, scheme="planes-random", descriptor=True)
    for config in (PLANES, PlanesConfig(nearest=25)):
        recovery = recover_planes(hidden.map, config)
        np.testing.assert_allclose(hidden.map.distance(recovery.xyz), 0, atol=1e-9)
        assert not recovery.calibrated and not recovery.beta.any()


def test_planes_move_turn_and_scale_with_the_scene(scene):
    hidden = l2p.hide(scene, 0, scheme="planes-random").map
    turn, shift, scale = turned(), np.array([3.0, -20, 7]), 2.5
    normal = hidden.normal @ turn.T
    moved = PlaneCloud(normal, scale * hidden.offset + normal @ shift, scheme=hidden.scheme)
    one, other = recover_planes(hidden, PLANES), recover_planes(moved, PLANES)
    apart = np.linalg.norm(scale * one.xyz @ turn.T + shift - other.xyz, axis=1)
    # Equal up to rounding in single precision, which may decide between two equal cells.
    assert np.mean(apart < 1e-3 * scale) > 0.97


def test_planes_do_not_depend_on_order_and_are_the_same_again(scene):
    hidden = l2p.hide(scene, 0, scheme="planes-random", descriptor=True).map
    order = np.random.default_rng(5).permutation(len(hidden))
    one, again, other = (recover_planes(each, PLANES) for each in (hidden, hidden, hidden.rows(order)))
    assert np.array_equal(one.xyz, again.xyz) and np.array_equal(one.confidence, again.confidence)
    assert np.mean(np.linalg.norm(one.xyz[order] - other.xyz, axis=1) < 1e-3) > 0.97


def test_frame_of_planes_turns_with_them(rng):
    points = rng.normal(size=(500, 3)) * [3, 2, 1] + rng.exponential(size=(500, 3))
    normal = rng.normal(size=(500, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset, turn, shift = np.sum(normal * points, axis=1), turned(), np.array([1.0, 2, -3])
    one = plane_frame(normal, offset, 0.97)
    other = plane_frame(normal @ turn.T, 2 * offset + normal @ turn.T @ shift, 0.97)
    assert other.half == pytest.approx(2 * one.half)
    np.testing.assert_allclose(other.center, 2 * turn @ one.center + shift, atol=1e-6)
    np.testing.assert_allclose(other.axes, turn @ one.axes, atol=1e-6)


@pytest.mark.parametrize("turn", [np.eye(3), turned()])
def test_pooled_planes_give_every_point_exactly(scene, turn):
    hidden = l2p.hide(scene, 0, scheme="planes-pooled", descriptor=True)
    moved = replace(hidden.map, normal=hidden.map.normal @ turn.T)
    recovery = l2p.recover(moved)
    np.testing.assert_allclose(recovery.xyz, hidden.truth.xyz @ turn.T, atol=1e-9)
    assert (recovery.confidence == 1).all() and recovery.info["used"] == ["descriptor"]


def test_pooled_planes_of_repeated_descriptors_are_told_apart_by_place(scene):
    descriptor = scene.descriptor.copy()
    descriptor[1], descriptor[3], descriptor[4] = descriptor[0], descriptor[2], descriptor[2]
    hidden = l2p.hide(replace(scene, descriptor=descriptor), 0, scheme="planes-pooled", descriptor=True)
    recovery = recover_planes(hidden.map)
    several = recovery.confidence < 1
    assert several.sum() == 15 and set(np.round(1 / recovery.confidence[several])) == {2, 3}
    np.testing.assert_allclose(recovery.xyz[~several], hidden.truth.xyz[~several], atol=1e-9)


def test_pooled_planes_of_descriptors_computed_anew_are_joined_by_nearness(scene):
    hidden = l2p.hide(scene, 0, scheme="planes-pooled", descriptor=True)
    noise = np.random.default_rng(2).normal(0, 2, hidden.map.descriptor.shape)
    anew = np.clip(hidden.map.descriptor + noise, 0, 255).astype(np.uint8)
    recovery = recover_planes(replace(hidden.map, descriptor=anew))
    right = np.linalg.norm(recovery.xyz - hidden.truth.xyz, axis=1) < 1e-9
    assert right.mean() > 0.95
    assert recovery.confidence[right].mean() > 0.5


def test_pooled_planes_without_descriptors_are_guesses_and_say_so(scene):
    recovery = recover_planes(l2p.hide(scene, 0, scheme="planes-pooled").map, PLANES)
    assert "joined on equal descriptors only" in recovery.info["sentence"]


def test_parallel_planes_keep_two_coordinates_and_say_so(scene):
    hidden = l2p.hide(scene, 0, scheme="planes", descriptor=True)
    recovery = l2p.recover(hidden.map)
    assert "all planes are parallel" in recovery.info["sentence"]
    assert (recovery.confidence == 0).all() and not recovery.calibrated
    np.testing.assert_allclose(hidden.map.distance(recovery.xyz), 0, atol=1e-9)


def test_random_normals_are_no_servers(scene):
    assert servers(l2p.hide(scene, 0, scheme="planes-random").map.normal) is None
    assert servers(np.repeat(np.eye(3), 2, axis=0)) is not None
    assert servers(np.repeat(np.eye(3)[:2], 5, axis=0)) is None


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_fewer_than_three_planes_are_refused(rows):
    normal = np.eye(3)[:rows]
    if rows == 1:
        assert recover_planes(PlaneCloud(normal, np.ones(1))).confidence[0] == 0
        return
    with pytest.raises(InputError, match="three planes"):
        recover_planes(PlaneCloud(normal, np.ones(rows)))


# Permuted coordinates


def test_permuted_points_are_recovered_and_keep_two_coordinates():
    hidden = l2p.hide(room(1500), 0, scheme="permuted", descriptor=True)
    scores = l2p.evaluate(recover_permuted(hidden.map.without({"descriptor"}), PERMUTED), hidden.truth)
    stored = np.linalg.norm(hidden.map.xyz - hidden.truth.xyz, axis=1) <= scores.spacing
    assert scores.within_1 > 1.3 * stored.mean()
    for config in (PERMUTED, PermutedConfig(nearest=25)):
        recovery = recover_permuted(hidden.map, config)
        assert ((recovery.xyz == hidden.map.xyz).sum(axis=1) >= 2).all()


def test_permuted_points_move_and_scale_along_the_axes_in_any_order(scene):
    hidden = l2p.hide(scene, 0, scheme="permuted").map
    order = np.random.default_rng(5).permutation(len(hidden))
    moved = PermutedCloud(3 * hidden.xyz[order] + [5, 6, 7])
    one, other = recover_permuted(hidden, PERMUTED), recover_permuted(moved, PERMUTED)
    assert np.mean(np.linalg.norm(3 * one.xyz[order] + [5, 6, 7] - other.xyz, axis=1) < 1e-3) > 0.97


def test_a_vote_finds_the_coordinate_that_is_not_a_points_own(rng):
    stored = 0.01 * rng.normal(size=(30, 3))
    stored[0, 1] = 1.0
    others = np.array([[j for j in range(30) if j != i] for i in range(30)])
    xyz, _ = voted(stored, others)
    assert np.abs(xyz[0]).max() < 0.1


def test_one_permuted_point_is_refused_and_equal_ones_are_not():
    with pytest.raises(InputError, match="at least two"):
        recover_permuted(PermutedCloud(np.zeros((1, 3))))
    np.testing.assert_allclose(recover_permuted(PermutedCloud(np.ones((4, 3))), PERMUTED).xyz, 1, atol=0.1)


# Sphere clouds


def test_fakes_are_told_from_rays_and_depth_is_not_claimed():
    hidden = l2p.hide(room(1500), 0, scheme="sphere-50", descriptor=True)
    recovery = l2p.recover(hidden.map)
    scores = l2p.evaluate(recovery, hidden.truth)
    assert scores.fakes_auc > 0.6
    assert l2p.evaluate(recover_spheres(hidden.map, SpheresConfig(cosine=True)), hidden.truth).fakes_auc > 0.6
    assert "nothing tells how far" in recovery.info["sentence"] and not recovery.calibrated
    center = meeting_point(hidden.map)
    np.testing.assert_allclose(recovery.xyz, center + hidden.map.direction, atol=1e-9)


def test_without_fakes_all_rays_are_real(scene):
    hidden = l2p.hide(scene, 0, scheme="sphere")
    recovery = l2p.recover(hidden.map)
    assert (recovery.confidence == 1).all()
    assert l2p.evaluate(recovery, hidden.truth).fakes_auc is None
    np.testing.assert_allclose(meeting_point(hidden.map), scene.xyz.mean(axis=0), atol=1e-6)


def test_probability_of_rays_is_that_of_a_loop(rng):
    count, k, prior = 20, 10, 1 / 3
    near = np.array([rng.permutation([j for j in range(count) if j != i])[:k] for i in range(count)])
    angle = np.sort(rng.uniform(0.1, 1, (count, k)), axis=1)
    appearances = compared(torch.as_tensor(rng.normal(size=(count, 3))).float(), ("rgb",))
    config = SpheresConfig(steps=2)
    found = real(angle, near, appearances, prior, config)
    evidence = np.array([0.5 * (np.log(row[9]) - 1.5 * np.log(row[7])) for row in angle])
    chance = np.full(count, prior)
    for _ in range(2):
        last = chance.copy()
        for i in range(count):
            top = bottom = 0.5
            for j, far in zip(near[i], angle[i], strict=True):
                likeness = appearances.likeness(torch.tensor([i]), torch.tensor([[j]])).item()
                weight = last[j] * np.exp(-0.5 * (far / angle[i, 7]) ** 2)
                top, bottom = top + weight * np.exp(1.25 * likeness), bottom + weight
            odds = prior / (1 - prior) * np.exp(evidence[i] - np.median(evidence)) * top / bottom
            chance[i] = odds / (1 + odds)
    np.testing.assert_allclose(found, chance, rtol=1e-5)


def test_rays_do_not_depend_on_order_or_turns(scene):
    hidden = l2p.hide(scene, 0, scheme="sphere-33", descriptor=True).map
    order, turn = np.random.default_rng(5).permutation(len(hidden)), turned()
    moved = l2p.LineCloud(
        hidden.direction @ turn.T, hidden.moment @ turn.T, None, hidden.scheme, hidden.descriptor, "sift"
    ).rows(order)
    np.testing.assert_allclose(
        recover_spheres(moved).confidence, recover_spheres(hidden).confidence[order], rtol=1e-3, atol=1e-3
    )


def test_one_ray_is_recovered_and_none_is_refused(scene):
    hidden = l2p.hide(scene, 0, scheme="sphere-50").map
    assert len(recover_spheres(hidden.rows(np.array([0])))) == 1
    with pytest.raises(InputError, match="without lines"):
        recover_spheres(hidden.rows(np.zeros(0, dtype=np.int64)))


# Choice of the attack, and bad input


def test_each_map_gets_its_own_attack_and_no_other(scene):
    planes = l2p.hide(scene, 0, scheme="planes-random").map
    assert has_own_attack(planes) and not has_own_attack(l2p.hide(scene, 0).map)
    with pytest.raises(InputError, match="attack on lines"):
        l2p.recover(planes, method="tomography")


@pytest.mark.parametrize(
    ("scheme", "recover"),
    [
        ("planes-random", lambda cloud: recover_planes(cloud, PlanesConfig(nearest=5))),
        ("permuted", lambda cloud: recover_permuted(cloud, PermutedConfig(nearest=5))),
        ("sphere-50", lambda cloud: recover_spheres(cloud, SpheresConfig(cosine=True))),
    ],
)
def test_baselines_need_appearances(scene, scheme, recover):
    with pytest.raises(InputError, match="baseline for a map without"):
        recover(l2p.hide(scene, 0, scheme=scheme).map)


@pytest.mark.parametrize(
    "settings", [{"window": 2}, {"side": 0}, {"inside": 0.0}, {"inside": 2.0}, {"nearest": -1}, {"steps": 0}]
)
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(InputError):
        PlanesConfig(**settings)


def test_unknown_descriptors_are_not_used(scene):
    hidden = l2p.hide(replace(scene, descriptor_kind="disk"), 0, scheme="permuted", descriptor=True)
    assert recover_permuted(hidden.map, PERMUTED).info["used"] == []
