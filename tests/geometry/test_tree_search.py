"""The search by a tree of boxes finds what all pairs give, whatever the guesses, the blocks and the points."""

from __future__ import annotations

import pytest
import torch

from l2p.geometry import nearest as search
from l2p.geometry import tree as point_tree
from l2p.geometry import tree_search as point_search
from l2p.geometry.elements import Lines
from l2p.geometry.nearest import nearest_points_to_lines
from l2p.geometry.pairs import point_line_distance
from l2p.geometry.tree import plant, reach
from l2p.geometry.tree_search import nearest_points
from l2p.work.work import ALONE, Work


def draw(kind: str, count: int = 300) -> tuple[Lines, torch.Tensor, torch.Tensor]:
    """Lines, a point for each that need not lie on it, and scales."""
    generator = torch.Generator().manual_seed(count)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    direction, through, points, scale = normal(count, 3), normal(count, 3), normal(count, 3), torch.ones(count).double()
    if kind == "clustered":
        points = normal(5, 3)[torch.randint(5, (count,), generator=generator)] + 0.01 * points
    if kind == "on a surface":
        points[:, 2] = 0.1 * points[:, 0].sin()
    if kind == "on a plane along the axes":
        points[:, 2] = 1
        direction[::2] = torch.eye(3).double()[torch.arange(len(direction[::2])) % 3]
    if kind == "collinear":
        points = points[:, :1] * torch.tensor([1.0, 2.0, -0.5]).double()
    if kind == "in groups that coincide":
        points = points[torch.arange(count) // 9]
    if kind == "all coincide":
        points[:] = points[0]
    if kind == "all coincide on the lines":
        points[:], through[:] = 0, 0
    if kind == "scales":
        scale = torch.exp(2.0 * normal(count)).clamp(1e-2, 1e2)
    if kind == "far outliers":
        points[::20] *= 10 ** (6 * torch.rand(len(points[::20]), 1, generator=generator).double())
        scale = points.norm(dim=1).sqrt()
    if kind == "far lines":
        through[::3] *= 1e4
    if kind == "nearly along the axes":
        direction = torch.eye(3).double()[torch.arange(count) % 3] + 0.005 * direction
    if kind == "on their lines":
        through = points
    direction = torch.nn.functional.normalize(direction, dim=1)
    return Lines(direction, torch.linalg.cross(through, direction)), points, scale


KINDS = [
    *("random", "clustered", "on a surface", "on a plane along the axes", "collinear"),
    *("in groups that coincide", "all coincide", "all coincide on the lines"),
    *("scales", "far outliers", "far lines", "nearly along the axes", "on their lines"),
]
all_kinds = pytest.mark.parametrize("kind", KINDS)


def table(lines: Lines, points: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Distances of all pairs in units of the points' scale, infinite for a line's own point."""
    shape = (len(lines.direction), len(points), 3)
    direction, moment = (part[:, None].expand(shape) for part in lines)
    distance = point_line_distance(points.expand(shape), direction, moment) / scale
    return distance.fill_diagonal_(torch.inf)


def check(index: torch.Tensor, distances: torch.Tensor, k: int) -> None:
    """Each row holds k different points, and these are the nearest."""
    assert index.shape == (len(distances), k) and index.dtype == torch.int32
    ordered = index.sort(dim=1).values
    assert (ordered[:, 1:] > ordered[:, :-1]).all()
    # Points a rounding apart may stand for each other.
    found = torch.gather(distances, 1, index.long()).sort(dim=1).values
    nearest = distances.sort(dim=1).values[:, :k]
    torch.testing.assert_close(found, nearest, rtol=1e-11, atol=1e-11)


def run(lines: Lines, points: torch.Tensor, scale: torch.Tensor, k: int) -> torch.Tensor:
    return nearest_points(plant(points, scale), lines, k, ALONE, "points")


@pytest.fixture
def deep(monkeypatch):
    """Trees of many levels from few points."""
    monkeypatch.setattr(point_tree, "LEAF", 6)
    monkeypatch.setattr(point_tree, "_LEAVES", 4)
    monkeypatch.setattr(point_tree, "_BOXES", 2)
    monkeypatch.setattr(point_tree, "_SAMPLE", 40)


@all_kinds
def test_all_pairs_give_the_same(kind, deep):
    case = draw(kind)
    distances = table(*case)
    for k in (1, 40):
        check(run(*case, k), distances, k)


@pytest.mark.parametrize("count", [2, 3, 5, 6, 7, 31, 33, 100])
def test_few_points(count):
    case = draw("random", count)
    for k in {1, count // 2, count - 1}:
        check(run(*case, k), table(*case), k)


@all_kinds
def test_distances_and_order_are_those_of_all_pairs_to_the_bit(kind, deep, monkeypatch):
    lines, points, scale = draw(kind)
    found = []
    for many in (1, len(points) + 1):
        monkeypatch.setattr(search, "MANY", many)
        found.append(nearest_points_to_lines(lines, points, 20, scale=scale))
    tree, pairs = found
    if "coincide" in kind:
        torch.testing.assert_close(tree.distance, pairs.distance, rtol=0, atol=1e-12)
    else:
        assert torch.equal(tree.distance, pairs.distance)
        assert torch.equal(tree.index, pairs.index)


def test_single_precision_finds_the_same_distances(deep):
    lines, points, scale = draw("far outliers")
    index = run(Lines(lines.direction.float(), lines.moment.float()), points.float(), scale.float(), 20)
    distances = table(lines, points, scale)
    found = torch.gather(distances, 1, index.long()).sort(dim=1).values
    torch.testing.assert_close(found, distances.sort(dim=1).values[:, :20], rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", ["random", "in groups that coincide", "far outliers"])
@pytest.mark.parametrize("radius", [0.0, 1e-9, 1e-3, 1e9])
def test_answer_does_not_depend_on_the_guess(kind, radius, deep, monkeypatch):
    monkeypatch.setattr(point_search, "_guess", lambda tree, lines, k, work: torch.full_like(lines.direction[:, 0], radius))
    case = draw(kind)
    check(run(*case, 10), table(*case), 10)


@pytest.mark.parametrize("block", [1, 5])
def test_blocks_that_reach_nothing_at_first(block, deep, monkeypatch):
    monkeypatch.setattr(point_search, "_guess", lambda tree, lines, k, work: torch.full_like(lines.direction[:, 0], 1e-9))
    monkeypatch.setattr(point_search, "_BLOCK", block)
    case = draw("far lines", 30)
    check(run(*case, 10), table(*case), 10)


def test_lines_that_are_left_are_measured_against_all_points(deep, monkeypatch):
    monkeypatch.setattr(point_search, "_GROWTH", ())
    monkeypatch.setattr(point_search, "_DEVIATIONS", 0.0)
    case = draw("clustered")
    check(run(*case, 10), table(*case), 10)


@pytest.mark.parametrize("kind", ["random", "far outliers"])
@pytest.mark.parametrize(("block", "pairs", "tile"), [(1, 1 << 22, 1 << 12), (7, 300, 1), (99, 2000, 500), (64, 1, 1)])
def test_blocks_do_not_show_in_the_answer(kind, block, pairs, tile, deep, monkeypatch):
    case = draw(kind, 60)
    for name, value in (("_BLOCK", block), ("_PAIRS", pairs), ("_ALL", 0), ("_TILE", tile)):
        monkeypatch.setattr(point_search, name, value)
    monkeypatch.setattr(point_tree, "_TILE", tile)
    check(run(*case, 10), table(*case), 10)


def test_no_block_holds_more_pairs_than_it_may(deep, monkeypatch):
    sizes = []

    def watch(hits, k, lines):
        sizes.append(len(hits.place))
        return choose(hits, k, lines)

    choose = point_search._choose
    monkeypatch.setattr(point_search, "_choose", watch)
    monkeypatch.setattr(point_search, "_PAIRS", 3000)
    monkeypatch.setattr(point_search, "_ALL", 0)
    run(*draw("clustered"), 20)
    assert len(sizes) > 1 and max(sizes) <= 3000


@all_kinds
def test_every_leaf_within_the_radius_is_reached(kind, deep):
    """A smaller radius leaves out no leaf within it either, by the margins of a larger one."""
    lines, points, scale = draw(kind)
    tree = plant(points, scale)
    distances = table(lines, points, scale)[:, tree.index.long()].amin(dim=2)  # (lines, leaves)
    radius = distances.quantile(0.1, dim=1)
    pairs = reach(tree, lines, 2 * radius, 1 << 22)
    assert pairs is not None and (pairs.leaf.diff() >= 0).all()
    for share in (2, 1, 0.5):
        margin = torch.full_like(distances, -torch.inf)
        margin[pairs.line.long(), pairs.leaf.long()] = pairs.margin
        assert (margin >= (2 - share) * radius[:, None] - 1e-12)[distances < share * radius[:, None]].all()


@pytest.mark.parametrize("count", [2, 6, 7, 299, 300])
def test_tree_holds_every_point_once(count, deep):
    _, points, scale = draw("scales", count)
    tree = plant(points, scale)
    real = ~tree.points[:, 3].isnan()
    assert torch.equal(tree.index[real].long().sort().values, torch.arange(count))
    place = tree.points.mT[real] * scale[tree.index[real].long(), None]
    torch.testing.assert_close(place[:, :3], points[tree.index[real].long()])


def test_same_points_give_the_same_tree():
    _, points, scale = draw("random")
    first, second = plant(points, scale), plant(points, scale)
    assert torch.equal(first.index, second.index) and torch.equal(first.sample, second.sample)


def test_progress_counts_every_line_once(deep, counter, monkeypatch):
    monkeypatch.setattr(point_search, "_DEVIATIONS", 0.0)
    monkeypatch.setattr(search, "MANY", 1)
    lines, points, scale = draw("random")
    nearest_points_to_lines(lines, points, 10, scale=scale, work=Work(progress=counter))
    assert counter.done == counter.total == 300


def test_search_takes_the_tree_for_many_points_and_few_neighbors(monkeypatch):
    seen = []
    monkeypatch.setattr(search, "nearest_points", lambda *given: seen.append(given[2]) or nearest_points(*given))
    monkeypatch.setattr(search, "MANY", 160)
    for count, k in ((159, 3), (160, 0), (160, 3), (160, 10), (160, 11), (160, 500)):
        lines, points, scale = draw("scales", count)
        found = nearest_points_to_lines(lines, points, k, scale=scale)
        k = min(k, count - 1)
        expected = table(lines, points, scale).sort(dim=1).values[:, :k]
        torch.testing.assert_close(found.distance, expected, rtol=1e-12, atol=1e-12)
    assert seen == [3, 10]


def test_without_scales_distances_are_the_plain_ones(monkeypatch):
    monkeypatch.setattr(search, "MANY", 1)
    lines, points, scale = draw("on a surface")
    found = nearest_points_to_lines(lines, points, 5)
    torch.testing.assert_close(found.distance, table(lines, points, scale).sort(dim=1).values[:, :5])
