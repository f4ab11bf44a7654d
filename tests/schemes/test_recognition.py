"""What the lines of a file are: each kind is found at any size, place, rotation, scale, order and sign; uniform lines
raise no alarm."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2, kstest

import l2p
from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.schemes import meeting, recognition
from l2p.schemes.recognition import direction_statistic, recognise

Rng = np.random.Generator


def directions(count: int, rng: Rng) -> np.ndarray:
    return rng.normal(size=(count, 3))


def joined(*clouds: LineCloud) -> LineCloud:
    direction, moment = ([getattr(each, name) for each in clouds] for name in ("direction", "moment"))
    return LineCloud(np.concatenate(direction), np.concatenate(moment))


def uniform(points: np.ndarray, rng: Rng) -> LineCloud:
    return LineCloud.through(points, directions(len(points), rng))


def through_centres(count: int) -> Callable[[np.ndarray, Rng], LineCloud]:
    """Lines of points to centres in and around the map."""

    def lines(points: np.ndarray, rng: Rng) -> LineCloud:
        centers = points.mean(axis=0) + points.std() * directions(count, rng)
        return LineCloud.through(points, points - centers[np.arange(len(points)) % count])

    return lines


def parallel(points: np.ndarray, rng: Rng) -> LineCloud:
    return LineCloud.through(points, np.tile(directions(1, rng), (len(points), 1)))


def partly_parallel(points: np.ndarray, rng: Rng) -> LineCloud:
    third = len(points) // 3
    return joined(parallel(points[:third], rng), uniform(points[third:], rng))


def three_axes(points: np.ndarray, rng: Rng) -> LineCloud:
    return LineCloud.through(points, np.eye(3)[rng.integers(0, 3, len(points))])


def flattened(points: np.ndarray, rng: Rng) -> LineCloud:
    return LineCloud.through(points, directions(len(points), rng) * [1, 1, 0.1])


def half_the_same(points: np.ndarray, rng: Rng) -> LineCloud:
    lines = uniform(points, rng)
    return lines.rows(np.minimum(np.arange(len(points)), len(points) // 2))


def twice(points: np.ndarray, rng: Rng) -> LineCloud:
    return joined(uniform(points, rng), uniform(points[::2], rng))


KINDS: dict[str, tuple[Callable[[np.ndarray, Rng], LineCloud], str, str]] = {
    "uniform": (uniform, recognition.UNIFORM, "uniform"),
    "one centre": (through_centres(1), recognition.ONE_CENTRE, "sphere"),
    "two centres": (through_centres(2), recognition.FEW_CENTRES, "rays"),
    "seven centres": (through_centres(7), recognition.FEW_CENTRES, "rays"),
    "parallel": (parallel, recognition.PARALLEL, "unknown"),
    "partly parallel": (partly_parallel, recognition.PARALLEL, "unknown"),
    "three axes": (three_axes, recognition.FEW_DIRECTIONS, "unknown"),
    "flattened": (flattened, recognition.NOT_UNIFORM, "unknown"),
    "half the same": (half_the_same, recognition.REPEATED, "unknown"),
    "two releases": (twice, recognition.RELEASES, "uniform"),
}


def moved(lines: LineCloud, rng: Rng) -> LineCloud:
    """The same lines after a similarity, in another order, with other signs."""
    rotation = np.linalg.qr(directions(3, rng))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    scale, shift = 10 ** rng.uniform(-4, 4), rng.normal(size=3)
    shift *= 1000 * scale
    order, sign = rng.permutation(len(lines)), rng.choice([-1.0, 1.0], (len(lines), 1))
    direction = lines.direction @ rotation.T
    moment = scale * lines.moment @ rotation.T + np.cross(shift, direction)
    return LineCloud((sign * direction)[order], (sign * moment)[order])


@pytest.fixture(scope="module")
def rooms() -> dict[int, np.ndarray]:
    return {count: l2p.simulate("room", points=count, seed=1).xyz for count in (150, 900, 5000)}


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("count", [150, 900, 5000])
def test_each_kind_is_found_wherever_it_lies(name: str, count: int, rooms: dict[int, np.ndarray]) -> None:
    make, kind, scheme = KINDS[name]
    rng = np.random.default_rng(count)
    lines = make(rooms[count], rng)
    for seen in (lines, moved(lines, rng)):
        found = recognise(seen)
        assert (found.kind, found.scheme) == (kind, scheme), found.sentence
        assert found.expected == (kind == recognition.UNIFORM)
        assert f"{len(seen):,}" in found.sentence


def test_centres_and_families_are_those_of_the_lines(rooms: dict[int, np.ndarray]) -> None:
    points, rng = rooms[900], np.random.default_rng(0)
    centers, own = np.array([[0.0, 1, 2], [3, 0, 1], [1, 1, 1]]), rng.choice(3, len(points), p=[0.5, 0.3, 0.2])
    rays = LineCloud.through(points, points - centers[own])
    found = recognise(joined(rays, uniform(points[:40], rng)))
    np.testing.assert_allclose(found.centers, centers, atol=1e-6)
    assert found.family is not None
    np.testing.assert_array_equal(found.family[: len(points)], own)
    assert (found.family[len(points) :] == -1).all()
    assert found.sentence == "All but 40 of 940 lines pass through one of 3 points." and found.scheme == "rays"


def test_lines_that_only_half_pass_through_a_centre_have_no_attack_of_their_own(rooms: dict[int, np.ndarray]) -> None:
    points, rng = rooms[900], np.random.default_rng(0)
    found = recognise(joined(through_centres(1)(points, rng), uniform(points, rng)))
    assert (found.kind, found.scheme, found.expected) == (recognition.ONE_CENTRE, "unknown", False)
    assert "900 of 1,800" in found.sentence


def test_rays_of_a_map_that_has_points_twice_are_rays(rooms: dict[int, np.ndarray]) -> None:
    """The same point and the same centre make the same line."""
    points = np.repeat(rooms[150], 2, axis=0)
    assert recognise(through_centres(1)(points, np.random.default_rng(0))).kind == recognition.ONE_CENTRE
    assert recognise(parallel(points, np.random.default_rng(0))).kind == recognition.PARALLEL
    assert recognise(uniform(points, np.random.default_rng(0))).kind != recognition.REPEATED


@pytest.mark.parametrize("name", ["one centre", "two centres", "parallel", "half the same", "two releases"])
def test_single_precision_is_enough(name: str, rooms: dict[int, np.ndarray]) -> None:
    make, kind, _ = KINDS[name]
    lines = make(rooms[900], np.random.default_rng(2))
    assert recognise(LineCloud(lines.direction.astype(np.float32), lines.moment.astype(np.float32))).kind == kind


def test_uniform_lines_raise_no_alarm() -> None:
    rng = np.random.default_rng(0)
    for trial in range(200):
        count = int(np.exp(rng.uniform(np.log(50), np.log(2000))))
        points = directions(count, rng) if trial % 2 else _surface(count, rng)
        found = recognise(l2p.lift(points, seed=trial))
        assert found.expected and found.scheme == "uniform", (trial, found.sentence)
        assert found.kind == (recognition.FEW_LINES if count < recognition.FEW else recognition.UNIFORM)


def _surface(count: int, rng: Rng) -> np.ndarray:
    """Points on the faces of a box, a quarter of them in ten tight clusters."""
    points = rng.uniform(-1, 1, (count, 3)) * [4, 3, 2]
    points[np.arange(count), rng.integers(0, 3, count)] = 1.5
    points[: count // 4] = points[rng.integers(0, 10, count // 4)] + 0.02 * directions(count // 4, rng)
    return points


@pytest.mark.parametrize("form", ["%.9g", "%.8g", "%.7g", "%.6f"])
@pytest.mark.parametrize("offset", [0.0, 30.0])
def test_one_centre_is_recognised_through_the_rounding_of_a_text_file(form: str, offset: float, tmp_path: Path) -> None:
    points = _surface(2000, np.random.default_rng(6)) * 5 + offset
    np.savetxt(tmp_path / "lines.txt", np.c_[points, points - np.median(points, axis=0) - 0.3], fmt=form)
    found = recognise(l2p.load(tmp_path / "lines.txt"))
    assert (found.kind, found.scheme, found.expected) == (recognition.ONE_CENTRE, "sphere", False), found.sentence


@pytest.mark.parametrize(
    ("count", "seed"), [(100, 22), (100, 58), (300, 8), (300, 12), (300, 17), (300, 28), (300, 54)]
)
def test_two_centres_are_two_also_if_most_lines_pass_through_one(count: int, seed: int) -> None:
    """Here the middle of the lines is within 1e-7 of one centre, so that half of them seem to miss it by rounding."""
    rng = np.random.default_rng(seed)
    points, centers = rng.normal(size=(count, 3)), rng.normal(size=(2, 3))
    through = (np.arange(count) >= int(0.6 * count)).astype(int)
    found = recognise(LineCloud.through(points, points - centers[through]))
    assert (found.kind, found.scheme, len(found.centers)) == (recognition.FEW_CENTRES, "rays", 2)


def test_a_small_map_far_from_the_origin_is_no_centre() -> None:
    rng = np.random.default_rng(7)
    found = recognise(l2p.lift(_surface(1000, rng) * 0.05 + [5e5, 5.4e6, 100], seed=0))
    assert found.kind == recognition.UNIFORM


def test_the_statistic_of_uniform_directions_is_chi_squared() -> None:
    rng = np.random.default_rng(1)
    unit = [directions(300, rng) for _ in range(500)]
    found = [direction_statistic(each / np.linalg.norm(each, axis=1, keepdims=True)) for each in unit]
    assert kstest(found, chi2(5).cdf).pvalue > 1e-3
    assert chi2(5).sf(recognition._LARGEST_S) == pytest.approx(1e-6, rel=0.05)


@pytest.mark.parametrize("block", [1, 1000, 1 << 21])
def test_least_products_are_those_of_a_loop(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meeting, "_BLOCK", block)
    rng = np.random.default_rng(3)
    lines = uniform(directions(60, rng), rng)
    cloud = meeting.centred(lines.direction, lines.moment, rng)
    rows = np.array([0, 7, 59])
    slow = []
    for row in rows:
        least = np.inf
        for other in range(60):
            if other != row:
                product = cloud.direction[row] @ cloud.moment[other] + cloud.moment[row] @ cloud.direction[other]
                cross = np.cross(cloud.direction[row], cloud.direction[other])
                apart = abs((cloud.foot[row] - cloud.foot[other]) @ cross)
                assert abs(product) == pytest.approx(apart, abs=1e-9), "distance times sine of the angle"
                least = min(least, abs(product))
        slow.append(least)
    np.testing.assert_allclose(meeting.least_products(cloud, rows), slow, atol=1e-12)


def test_partners_of_independent_lines_are_as_near_as_chance_says() -> None:
    rng = np.random.default_rng(4)
    lines = uniform(directions(3000, rng), rng)
    cloud = meeting.centred(lines.direction, lines.moment, rng)
    expected = meeting.chance_meetings(cloud, np.arange(0, 3000, 10), rng)
    assert kstest(expected, "expon").pvalue > 1e-3


def test_equal_rows_are_those_of_a_loop() -> None:
    rng = np.random.default_rng(5)
    value = directions(80, rng)[rng.integers(0, 80, 120)] + 1e-8 * directions(120, rng)
    alike = np.abs(value[:, None] - value[None]).max(axis=2) < meeting.SAME
    equal, further = meeting.with_equal(value, rng)
    np.testing.assert_array_equal(equal, alike.sum(axis=1) > 1)
    groups = np.unique(alike, axis=0)
    assert len(value) - further.sum() == len(groups)
    assert all((~further[group]).sum() == 1 for group in groups)


def test_what_geometry_cannot_tell_the_file_may(rooms: dict[int, np.ndarray]) -> None:
    lines = uniform(rooms[900], np.random.default_rng(6))
    look = Appearance(np.zeros((900, 3), dtype=np.uint8))
    for seen in (
        LineCloud(lines.direction, lines.moment, scheme="ppl+"),
        LineCloud(lines.direction, lines.moment, look.rgb, second=look),
    ):
        found = recognise(seen)
        assert (found.kind, found.scheme, found.expected) == (recognition.PAIRS, "ppl", False)
    found = recognise(LineCloud(lines.direction, lines.moment, scheme="far"))
    assert (found.kind, found.scheme, found.expected) == (recognition.DECLARED, "unknown", False)
    assert "far" in found.sentence


def test_geometry_decides_against_the_file(rooms: dict[int, np.ndarray]) -> None:
    rays = through_centres(2)(rooms[900], np.random.default_rng(7))
    found = recognise(LineCloud(rays.direction, rays.moment, scheme="ppl"))
    assert found.scheme == "rays" and found.sentence.endswith("The file names the scheme ppl.")
    assert "file" not in recognise(LineCloud(rays.direction, rays.moment, scheme="rays-voxel")).sentence


def test_few_and_degenerate_lines() -> None:
    rng = np.random.default_rng(8)
    one = LineCloud.through(np.zeros((1, 3)), np.array([[0.0, 0, 1]]))
    assert recognise(one).sentence == "1 line is too few to tell; nothing speaks against uniform lines."
    assert recognise(one.rows(np.zeros(5, dtype=int))).kind == recognition.REPEATED
    for count in (2, 3, 10, 40):
        assert recognise(uniform(directions(count, rng), rng)).kind == recognition.FEW_LINES
    assert recognise(l2p.lift(np.zeros((4, 3)), seed=0)).kind == recognition.ONE_CENTRE
    with pytest.raises(InputError, match="without lines"):
        recognise(one.rows(np.zeros(0, dtype=int)))


@pytest.mark.parametrize("far", [1e-9, 1e6, 1e29])
def test_sizes_may_differ_hugely(far: float) -> None:
    rng = np.random.default_rng(9)
    points = directions(800, rng)
    points[:10] *= far
    assert recognise(l2p.lift(points, seed=0)).kind == recognition.UNIFORM
    found = recognise(LineCloud.through(points, points - np.array([0.0, 0.5, 1])))
    assert found.kind == recognition.ONE_CENTRE
