"""Surfaces through estimates that err along their lines: exact where they can be, and not led astray."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from l2p.geometry.local_planes import _DOUBT, _LEAST, _REFITS, _ROUGHNESS, crossing, fitted, least_axis


def around(count: int, draw: torch.Generator, noise: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
    """Estimates of points in the plane z = 0, wrong along their random lines."""
    place = torch.cat([torch.rand(count, 2, generator=draw), torch.zeros(count, 1)], dim=1).double()
    direction = torch.randn(count, 3, generator=draw).double()
    direction = direction / direction.norm(dim=1, keepdim=True)
    wrong = noise * torch.randn(count, 1, generator=draw).double()
    return place + wrong * direction, direction, torch.rand(count, generator=draw).double()


@pytest.fixture
def draw() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def slow_fit(points: np.ndarray, direction: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre and normal, an estimate at a time."""
    first = [c + _LEAST for c in confidence]
    weight, step = list(first), 0
    while True:
        centre = np.sum([w * p for w, p in zip(weight, points, strict=True)], axis=0) / sum(weight)
        spread = [w * np.outer(p - centre, p - centre) for w, p in zip(weight, points, strict=True)]
        value, vector = np.linalg.eigh(np.sum(spread, axis=0) / sum(weight))
        if step == _REFITS:
            return centre, vector[:, 0]
        for j, (p, d) in enumerate(zip(points, direction, strict=True)):
            steep = (vector[:, 0] @ d) ** 2
            off = (vector[:, 0] @ (p - centre)) ** 2
            weight[j] = first[j] * _ROUGHNESS / (_ROUGHNESS + steep) / (1 + off / (_DOUBT * value[0]))
        step += 1


def test_it_is_its_slow_twin(draw: torch.Generator) -> None:
    some = [around(20, draw, 0.1) for _ in range(5)]
    surface = fitted(*(torch.stack(parts) for parts in zip(*some, strict=True)))
    for i, parts in enumerate(some):
        centre, normal = slow_fit(*(part.numpy() for part in parts))
        np.testing.assert_allclose(surface.centre[i], centre, atol=1e-9)
        assert abs(surface.normal[i].numpy() @ normal) == pytest.approx(1, abs=1e-9)


def test_points_in_a_plane_give_the_plane(draw: torch.Generator) -> None:
    points, direction, confidence = around(30, draw)
    surface = fitted(points[None], direction[None], confidence[None])
    torch.testing.assert_close(surface.normal[0].abs(), torch.tensor([0.0, 0, 1]).double(), atol=1e-9, rtol=0)
    assert abs(float(surface.centre[0, 2])) < 1e-12
    assert 0 < float(surface.planarity[0]) <= 1 and 0 <= float(surface.linearity[0]) < 1


def plain(points: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of the origin from the plane with all estimates alike, and the slope of that plane."""
    centre = points.mean(dim=1)
    normal = torch.linalg.eigh(torch.einsum("nka,nkb->nab", points - centre[:, None], points - centre[:, None]))[1]
    return (centre * normal[:, :, 0]).sum(dim=1).abs(), normal[:, :2, 0].norm(dim=1)


@pytest.mark.parametrize("lost", [0, 4])
def test_errors_along_the_lines_and_lost_estimates_move_it_less_than_the_plain_fit(
    draw: torch.Generator, lost: int
) -> None:
    some = [around(17, draw, 0.15) for _ in range(400)]
    points, direction, confidence = (torch.stack(parts) for parts in zip(*some, strict=True))
    points[:, :lost, 2] += torch.rand(400, lost, generator=draw).double()
    surface = fitted(points, direction, torch.ones_like(confidence))
    off, slope = plain(points)
    assert (surface.centre * surface.normal).sum(dim=1).abs().median() < 0.7 * off.median()
    assert surface.normal[:, :2].norm(dim=1).median() < 0.9 * slope.median()


def test_what_nobody_is_sure_of_counts_for_little(draw: torch.Generator) -> None:
    points, direction, _ = around(30, draw)
    points[:10, 2] += 0.3
    sure = torch.cat([torch.zeros(10), torch.ones(20)]).double()
    trusted, alike = (fitted(points[None], direction[None], c[None]) for c in (sure, torch.ones(30).double()))
    assert trusted.centre[0, 2].abs() < alike.centre[0, 2].abs()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_estimates_have_some_surface(count: int, draw: torch.Generator) -> None:
    points, direction, confidence = around(count, draw)
    for places in (points, points[:1].expand(count, 3)):
        surface = fitted(places[None], direction[None], confidence[None])
        assert all(part.isfinite().all() for part in surface)


def test_lines_cut_surfaces_where_they_meet_and_grazing_ones_at_the_least_slope(draw: torch.Generator) -> None:
    points, direction, confidence = around(30, draw, 0.1)
    surface = fitted(points[None], direction[None], confidence[None])
    way, foot = direction[None, :5], points[None, 5:10]
    planes = surface.at(torch.zeros(1, 5, dtype=torch.int64))
    met = crossing(planes, way, foot, points[None, 10:15])
    at = foot + met.cut[..., None] * way
    steep = (planes.normal * way).sum(-1).abs() > 0.06
    assert ((at - planes.centre) * planes.normal).sum(-1).abs()[steep].max() < 1e-9
    torch.testing.assert_close(met.off[0], ((foot - planes.centre) * planes.normal).sum(-1))
    assert met.slope.abs().min() >= 0.05


def spreads(kind: str, draw: torch.Generator) -> Tensor:
    """Symmetric matrices with the variances of some shape, turned at random; one of them is not turned."""
    shapes = {"any": (1, 3, 7), "flat": (0, 2, 5), "disc": (0, 1, 1), "needle": (0, 0, 1), "cigar": (1e-6, 2e-6, 1)}
    shapes |= {"ball": (1, 1, 1), "point": (0, 0, 0), "tiny": (1e-24, 3e-24, 7e-24), "huge": (1e20, 3e20, 7e20)}
    turn = torch.linalg.qr(torch.randn(500, 3, 3, generator=draw).double())[0]
    turn[0] = torch.eye(3)
    return turn @ torch.diag(torch.tensor(shapes[kind]).double()) @ turn.transpose(1, 2)


@pytest.mark.parametrize("kind", ["any", "flat", "disc", "needle", "cigar", "ball", "point", "tiny", "huge"])
def test_the_closed_form_finds_what_eigh_finds(kind: str, draw: torch.Generator) -> None:
    matrix = spreads(kind, draw)
    mixed = torch.stack([matrix[:, 0, 1], *matrix[:, :2, 2].T], dim=1)
    value, axis = least_axis(matrix.diagonal(dim1=1, dim2=2), mixed)
    expected = torch.linalg.eigvalsh(matrix)
    size = expected[:, 2:].max()
    # Where two are equal, half of the digits are lost, as in any root of a polynomial.
    assert ((value - expected).abs() <= 3e-8 * size).all() and (value >= 0).all()
    assert (value.diff(dim=1) >= -3e-8 * size).all()
    torch.testing.assert_close(axis.norm(dim=1), torch.ones(500).double())
    assert ((matrix @ axis[:, :, None])[..., 0] - value[:, :1] * axis).norm(dim=1).max() <= 3e-8 * size
