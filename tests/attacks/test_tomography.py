"""Tomography: the EM update and its invariants, refinement, degenerate clouds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import l2p
from l2p.attacks.attack import Elements, locate
from l2p.attacks.tomographic import TomographicConfig, Tomography
from l2p.attacks.tomography import octree
from l2p.attacks.tomography import reconstruct as tomography
from l2p.attacks.tomography.posterior import modes
from l2p.attacks.tomography.reconstruct import TomographyConfig, reconstruct
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.nearest import nearest_points_to_points
from l2p.maps.lines import LineCloud
from l2p.schemes.hide import hide
from l2p.work.work import ALONE

#: Expectation maximisation alone, without a prior.
PLAIN = TomographyConfig(start=8, levels=1, iterations=3, smoothing=0.0, shrinkage=0.0)


def framed(points: np.ndarray, seed: int = 0) -> tuple[Lines, np.ndarray]:
    """Lines in their frame, and the true points there."""
    hidden = hide(points, seed, 1.0)
    cloud, index = hidden.map, hidden.truth.index
    frame = Frame.of(cloud)
    return frame.enter(cloud), (points[index] - frame.center) / frame.unit


@pytest.fixture
def lines(scene_points) -> Lines:
    return framed(scene_points)[0]


def loop_mlem(lines: Lines, half: float, side: int, iterations: int) -> np.ndarray:
    """List-mode MLEM, a line and a sample at a time."""
    direction, foot = lines.direction.numpy(), lines.foot.numpy()
    density = np.ones((side, side, side))
    for _ in range(iterations):
        mass = np.zeros_like(density)
        for d, o in zip(direction, foot, strict=True):
            axis = np.argmax(np.abs(d))
            cells = []
            for plane in (np.arange(side) + 0.5) * 2 * half / side - half:
                place = np.floor((o + (plane - o[axis]) / d[axis] * d + half) * side / (2 * half)).astype(int)
                if ((place >= 0) & (place < side)).all():
                    cells.append(tuple(place))
            projection = sum(density[cell] for cell in cells)
            for cell in cells:
                mass[cell] += density[cell] / projection
        density = mass
    return density


def test_one_level_is_plain_mlem(lines):
    half, _, density = tomography._converged(lines, PLAIN)
    twin = loop_mlem(lines, half, 8, PLAIN.iterations)
    np.testing.assert_allclose(density[0].numpy(), twin.ravel(), atol=2e-3)


@pytest.mark.parametrize("levels", [1, 3])
def test_mass_is_conserved(lines, levels):
    config = replace(PLAIN, levels=levels, crowd=0.0)
    posterior, (_, _, density) = reconstruct(lines, config), tomography._converged(lines, config)
    seen = float((posterior.probability.sum(dim=1) > 0).sum())
    assert seen > 0.9 * len(lines.direction)
    assert float(density.sum()) == pytest.approx(seen, rel=1e-4)


def test_likelihood_never_falls(lines):
    level = tomography._first_level(lines, 2.0, 32)
    density, likelihood = torch.ones(1, 32**3), []
    for _ in range(12):
        density = tomography._back_projection(level, density)
        along = tomography._along(level, density, slice(None)).sum(dim=1)
        likelihood.append(float(along[along > 0].double().log().sum()))
    assert all(np.diff(likelihood) > -1e-3)
    assert likelihood[-1] > likelihood[0] + 1


def test_posterior_is_a_distribution_in_the_order_of_the_line(lines):
    posterior = reconstruct(lines)
    total = posterior.probability.sum(dim=1)
    assert torch.logical_or((total - 1).abs() < 1e-4, total == 0).all()
    assert (posterior.probability >= 0).all()
    assert (posterior.step > 0).all()


def test_an_isolated_blob_is_found(rng):
    blob = rng.normal((0.7, -0.4, 0.2), 0.01, size=(300, 3))
    points = np.concatenate([blob, rng.uniform(-1, 1, size=(150, 3))])
    hidden = hide(points, 0, 1.0)
    cloud, index = hidden.map, hidden.truth.index
    result = l2p.recover(cloud, method="tomography")
    own = index < 300
    error = np.linalg.norm(result.xyz - points[index], axis=1)[own]
    assert np.median(error) < 0.01
    assert (error < 0.05).mean() > 0.95
    assert result.confidence[own].mean() > result.confidence[~own].mean()


def moved(cloud: LineCloud, rng: np.random.Generator) -> tuple[LineCloud, np.ndarray, np.ndarray]:
    """The lines turned, scaled, shifted, flipped and shuffled; and the map back."""
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    order = rng.permutation(len(cloud))
    shift = np.array([300.0, -50.0, 20.0])
    sign = rng.choice([-1.0, 1.0], size=len(cloud))[:, None]
    there = LineCloud.through(cloud.origin[order] @ turn.T * 7 + shift, sign * cloud.direction[order] @ turn.T)
    return there, order, turn


def test_rotation_scale_order_and_sign_do_not_matter(scene_points, rng):
    cloud = l2p.lift(scene_points, seed=0)
    here = l2p.recover(cloud, method="tomography")
    other, order, turn = moved(cloud, rng)
    there = l2p.recover(other, method="tomography")
    back = (there.xyz - (300.0, -50.0, 20.0)) / 7 @ turn
    apart = np.linalg.norm(back - here.xyz[order], axis=1)
    # Rounding may turn a tie between two places of a line.
    assert (apart < 1e-3).mean() > 0.97
    np.testing.assert_allclose(np.median(there.confidence), np.median(here.confidence), atol=0.01)


def test_blocks_do_not_change_the_answer(lines, monkeypatch):
    whole = reconstruct(lines)
    monkeypatch.setattr(tomography, "SAMPLES", 1000)
    parts = reconstruct(lines)
    torch.testing.assert_close(parts.beta, whole.beta)
    torch.testing.assert_close(parts.probability, whole.probability, atol=1e-3, rtol=1e-3)


def test_a_line_that_misses_the_box_has_no_confidence(scene_points):
    cloud = l2p.lift(scene_points, seed=0)
    far = LineCloud.through(np.array([[1e4, 0.0, 0.0], [0.0, 1e5, 0.0]]), np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 1.0]]))
    both = LineCloud(np.concatenate([cloud.direction, far.direction]), np.concatenate([cloud.moment, far.moment]))
    inside = Frame.of(both).enter(both)
    assert (reconstruct(inside).probability[-2:] == 0).all()
    result = l2p.recover(both, method="tomography")
    # Lines far from all others are a part of their own, whose points are hardly within 1 spacing of the map.
    assert (result.confidence[-2:] < 1e-3).all()
    assert np.isfinite(result.xyz).all()
    assert (result.confidence[:-2] > 0).mean() > 0.9


@pytest.mark.parametrize("count", [1, 2, 3])
def test_very_few_lines(rng, count):
    result = l2p.recover(l2p.lift(rng.normal(size=(count, 3)), seed=0), method="tomography")
    assert result.xyz.shape == (count, 3)
    assert np.isfinite(result.xyz).all() and np.isfinite(result.confidence).all()


def test_two_lines_meet_where_they_are_closest():
    cloud = LineCloud.through(np.array([[5.0, 1, 0], [0, 1, 3.0]]), np.array([[1.0, 0, 0], [0, 0, 1]]))
    result = l2p.recover(cloud, method="tomography")
    np.testing.assert_allclose(result.xyz, [[0, 1, 0], [0, 1, 0]], atol=1e-5)


def test_parallel_and_repeated_lines_give_finite_points(rng):
    points = rng.normal(size=(40, 3))
    parallel = LineCloud.through(points, np.tile([0.0, 0.6, 0.8], (40, 1)))
    repeated = LineCloud.through(np.zeros((40, 3)), np.tile([1.0, 0, 0], (40, 1)))
    for cloud in (parallel, repeated):
        result = l2p.recover(cloud, method="tomography")
        assert np.isfinite(result.xyz).all() and np.isfinite(result.confidence).all()


def test_rounds_of_zero_leave_the_modes(lines, scene_points):
    method = Tomography(TomographicConfig(rounds=0))
    elements = Elements(lines, torch.arange(len(lines.direction)), Frame.of(l2p.lift(scene_points, seed=0)))
    estimate = locate(method, elements, ALONE)
    torch.testing.assert_close(estimate.beta, modes(reconstruct(lines))[0])


def test_more_levels_are_finer(lines):
    coarse = reconstruct(lines, TomographyConfig(levels=2, crowd=0.0))
    fine = reconstruct(lines, TomographyConfig(levels=4, crowd=0.0))
    torch.testing.assert_close(fine.step * 4, coarse.step)


def test_smoothing_and_interpolation_are_convolutions():
    cells = octree.root(4, torch.device("cpu"))
    mass = torch.zeros(4, 4, 4)
    mass[1, 1, 1] = 1
    kernel = torch.tensor([0.1, 0.8, 0.1, 0.0])
    expected = kernel[:, None, None] * kernel[:, None] * kernel
    torch.testing.assert_close(octree.smooth(mass.flatten(), cells, 0.1), expected.flatten())
    assert float(octree.interpolate(torch.rand(64), cells).sum()) == pytest.approx(32, rel=0.5)
    torch.testing.assert_close(octree.interpolate(mass.flatten(), cells).sum(), torch.tensor(1.0))


def test_children_know_their_neighbours(rng):
    """Every pair of rows, found by the places of the cells in a loop."""
    above = octree.root(4, torch.device("cpu"))
    place = torch.from_numpy(rng.integers(0, 8, size=(3, 60))).int()
    row = (place[0] // 2 * 4 + place[1] // 2) * 4 + place[2] // 2
    cells, own = octree.children(above, above.octants(row, place)[None], samples=7)
    where = {tuple(p): i for i, p in enumerate(cells.place.T.tolist())}
    assert set(where) == set(map(tuple, place.T.tolist()))
    assert own[0].tolist() == [where[tuple(p)] for p in place.T.tolist()]
    for axis, step in enumerate(np.eye(3, dtype=int)):
        for p, i in where.items():
            assert cells.after[axis, i] == where.get(tuple(np.add(p, step)), cells.count)
            assert cells.before[axis, i] == where.get(tuple(np.subtract(p, step)), cells.count)


def test_nearest_points_leave_self_out(rng):
    points = torch.from_numpy(np.repeat(rng.normal(size=(10, 3)), 3, axis=0)).float()
    found = nearest_points_to_points(points, 4)
    assert (found.index != torch.arange(30)[:, None]).all()
    distance = torch.cdist(points.double(), points.double()).fill_diagonal_(torch.inf).sort(dim=1).values[:, :4]
    torch.testing.assert_close(found.distance.double(), distance, atol=1e-5, rtol=1e-5)
    assert nearest_points_to_points(points[:1], 4).index.shape == (1, 0)


def test_the_density_does_not_depend_on_the_order_of_the_lines(lines):
    """To the last bit, unlike a sum of rounded numbers."""
    order = torch.randperm(len(lines.direction), generator=torch.Generator().manual_seed(0))
    one, other = (tomography._converged(each, TomographyConfig())[2] for each in (lines, lines.rows(order)))
    assert torch.equal(one, other)


def test_too_many_cells_are_not_halved(lines, monkeypatch):
    config = TomographyConfig()
    most = tomography._converged(lines, config)[1].cells[3].count
    monkeypatch.setattr(tomography, "MOST_CELLS", most - 1)
    _, level, _ = tomography._converged(lines, config)
    assert len(level.cells) == 4 and level.cells[-1].count == most
    assert torch.isfinite(reconstruct(lines).probability).all()
