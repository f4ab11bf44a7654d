"""The blocked searches find what two plain loops find, whatever the blocks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from l2p.geometry import nearest as search
from l2p.geometry.elements import Lines
from l2p.geometry.nearest import (
    Nearest,
    nearest_lines_to_lines,
    nearest_lines_to_points,
    nearest_points_to_lines,
    smallest,
)
from l2p.geometry.pairs import PARALLEL
from l2p.maps.lines import LineCloud
from l2p.work.work import Work

Pair = Callable[[Lines, torch.Tensor, int, int], float]


def line_to_line(lines: Lines, points: torch.Tensor, i: int, j: int) -> float:
    d, e = lines.direction[i].numpy(), lines.direction[j].numpy()
    cross = np.linalg.norm(np.cross(d, e))
    if cross <= PARALLEL:
        return np.inf
    return float(abs(d @ lines.moment[j].numpy() + e @ lines.moment[i].numpy()) / cross)


def line_to_point(lines: Lines, points: torch.Tensor, i: int, j: int) -> float:
    return float(np.linalg.norm(np.cross(points[j].numpy(), lines.direction[i].numpy()) - lines.moment[i].numpy()))


def point_to_line(lines: Lines, points: torch.Tensor, i: int, j: int) -> float:
    return line_to_point(lines, points, j, i)


def loop_twin(pair: Pair, lines: Lines, points: torch.Tensor) -> np.ndarray:
    """All distances, one pair at a time; infinite where there is no neighbour."""
    count = len(points)
    table = np.full((count, count), np.inf)
    for i in range(count):
        for j in range(count):
            if i != j:
                table[i, j] = pair(lines, points, i, j)
    return table


SEARCHES: dict[str, tuple[Callable[..., Nearest], Pair]] = {
    "lines to lines": (lambda lines, points, k, **how: nearest_lines_to_lines(lines, k, **how), line_to_line),
    "points to lines": (
        lambda lines, points, k, **how: nearest_points_to_lines(lines, points, k, **how),
        line_to_point,
    ),
    "lines to points": (
        lambda lines, points, k, **how: nearest_lines_to_points(points, lines, k, **how),
        point_to_line,
    ),
}
all_searches = pytest.mark.parametrize("name", SEARCHES)


def draw(count: int, kind: str = "random") -> tuple[Lines, torch.Tensor]:
    rng = np.random.default_rng(count)
    point, direction = rng.normal(size=(count, 3)), rng.normal(size=(count, 3))
    estimate = rng.normal(size=(count, 3))
    if kind == "duplicated":
        half = count // 2
        for array in (point, direction, estimate):
            array[:half] = array[half : 2 * half]
    if kind == "some parallel":
        direction[::3] = direction[0] * rng.choice([-2, 2], size=(len(direction[::3]), 1))
    if kind == "all parallel":
        direction[:] = direction[0]
    cloud = LineCloud.through(point, direction)
    return Lines(torch.tensor(cloud.direction), torch.tensor(cloud.moment)), torch.tensor(estimate)


def check(found: Nearest, table: np.ndarray, k: int, atol: float = 1e-12) -> None:
    """The answer holds the k least distances of each row, at the right columns, in order."""
    count = len(table)
    index, distance = found.index.numpy(), found.distance.numpy()
    assert index.shape == distance.shape == (count, max(0, min(k, count - 1)))
    expected = np.sort(table, axis=1)[:, : index.shape[1]]
    np.testing.assert_allclose(distance, expected, atol=atol)
    assert (index != np.arange(count)[:, None]).all()
    assert ((index == -1) == np.isinf(distance)).all()
    for row in range(count):
        some = index[row][index[row] >= 0]
        assert len(set(some)) == len(some)
        np.testing.assert_allclose(table[row, some], distance[row][: len(some)], atol=atol)


@all_searches
@pytest.mark.parametrize("kind", ["random", "duplicated", "some parallel", "all parallel"])
@pytest.mark.parametrize("count", [1, 2, 3, 23])
def test_each_search_agrees_with_its_loop_twin(name, kind, count):
    run, pair = SEARCHES[name]
    lines, points = draw(count, kind)
    table = loop_twin(pair, lines, points)
    for k in (0, 1, 2, count - 1, count, count + 7):
        check(run(lines, points, k), table, k)


@all_searches
@pytest.mark.parametrize("columns", [3, 8, 1 << 16])
def test_blocks_do_not_show_in_the_answer(name, columns, monkeypatch):
    monkeypatch.setattr(search, "_COLUMNS", columns)
    run, pair = SEARCHES[name]
    lines, points = draw(40, "some parallel")
    table = loop_twin(pair, lines, points)
    for k in (1, 5, 39):
        for tile in (1, 7, 100, 1 << 21):
            check(run(lines, points, k, tile=tile), table, k)


@all_searches
def test_single_precision_finds_the_same_distances(name):
    run, pair = SEARCHES[name]
    lines, points = draw(40)
    table = loop_twin(pair, lines, points)
    found = run(Lines(lines.direction.float(), lines.moment.float()), points.float(), 10)
    assert found.distance.dtype == torch.float32
    np.testing.assert_allclose(found.distance, np.sort(table, axis=1)[:, :10], atol=1e-5)


@all_searches
def test_many_lines_agree_with_the_full_table(name, monkeypatch):
    monkeypatch.setattr(search, "_COLUMNS", 700)
    run, _ = SEARCHES[name]
    lines, points = draw(1500)
    direction, moment = (part.numpy() for part in lines)
    if name == "lines to lines":
        sine = np.sqrt(np.maximum(1 - (direction @ direction.T) ** 2, 1e-300))
        table = np.abs(direction @ moment.T + moment @ direction.T) / sine
        table[sine <= PARALLEL] = np.inf
    else:
        table = np.linalg.norm(np.cross(points.numpy()[None], direction[:, None]) - moment[:, None], axis=2)
        table = table if name == "points to lines" else table.T
    np.fill_diagonal(table, np.inf)
    check(run(lines, points, 20, tile=1 << 16), table, 20, atol=1e-9)


def test_progress_counts_every_line_once(counter):
    lines, _ = draw(23)
    nearest_lines_to_lines(lines, 3, tile=100, work=Work(progress=counter))
    assert counter.done == counter.total == 23


def rows(kind: str, columns: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(columns)
    values = torch.rand(6, columns, generator=generator)
    if kind == "constant":
        values[:] = 0.5
    if kind == "few values":
        values = (values * 3).floor()
    if kind == "mostly infinite":
        values[values < 0.9] = torch.inf
    if kind == "infinite":
        values[:] = torch.inf
    if kind == "ascending":
        values = values.sort(dim=1).values
    return values


@pytest.mark.parametrize("kind", ["random", "constant", "few values", "mostly infinite", "infinite", "ascending"])
@pytest.mark.parametrize("columns", [1, 7, 8, 64, 131, 1031])
def test_smallest_is_topk(kind, columns):
    values = rows(kind, columns)
    ordered = values.sort(dim=1).values
    for k in {1, 2, 3, 4, 8, 50, columns // 16, columns // 2, columns - 1, columns}:
        if not 0 < k <= columns:
            continue
        chosen = smallest(values, k)
        assert chosen.shape == (6, k)
        assert all(len(set(row)) == k for row in chosen.tolist())
        assert torch.equal(torch.gather(values, 1, chosen).sort(dim=1).values, ordered[:, :k])
