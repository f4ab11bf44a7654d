"""The bounds know the answer: they are near it, in the right order, and honest about what they replace."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import torch
from tiny import learned, seeing
from torch import Tensor

from l2p.attacks.attack import Attack
from l2p.attacks.heuristic import Heuristic
from l2p.attacks.learned.embedding import Embedding
from l2p.attacks.learned.learned import Learned
from l2p.attacks.run import run
from l2p.errors import InputError
from l2p.geometry.points import nearest_neighbors
from l2p.judging.accuracy import errors, spacing
from l2p.judging.references import BANDWIDTHS, POWERS, CandidateOracle, LeaveOneOut, Oracle
from l2p.maps.appearance import Appearance
from l2p.maps.lines import LineCloud
from l2p.schemes.hide import hide


@pytest.fixture(scope="module")
def room(on_walls) -> np.ndarray:
    return on_walls(1500)


@pytest.fixture(scope="module")
def lifted(room) -> tuple[LineCloud, np.ndarray]:
    hidden = hide(room, seed=1)
    lines, index = hidden.map, hidden.truth.index
    return lines, room[index]


def median(lifted: tuple[LineCloud, np.ndarray], method: Attack) -> float:
    """Median error in spacings."""
    lines, truth = lifted
    return float(np.median(errors(run(lines, method).xyz, truth))) / spacing(truth)


def test_true_neighbours_give_the_points_of_a_surface(lifted):
    lines, truth = lifted
    error = errors(run(lines, Oracle(truth, 10)).xyz, truth) / spacing(truth)
    assert np.median(error) < 0.15 and (error < 1).mean() > 0.95


def test_the_oracle_places_points_by_least_squares_too(lifted):
    lines, truth = lifted
    found = run(lines, Oracle(truth, 10, rule="least_squares"))
    near = nearest_neighbors(truth, 10).index
    for i in range(0, len(lines), 100):
        o, d = lines.origin[i], lines.direction[i]
        across = np.cross(d, lines.direction[near[i]])
        sine2 = np.square(across).sum(axis=1)
        t = (np.cross(lines.origin[near[i]] - o, lines.direction[near[i]]) * across).sum(axis=1) / sine2
        np.testing.assert_allclose(found.xyz[i], o + (sine2 * t).sum() / sine2.sum() * d, atol=1e-4)
    assert found.neighbors is not None
    np.testing.assert_array_equal(np.sort(found.neighbors), np.sort(near))


def test_outliers_harm_least_squares_more_than_the_peak(lifted):
    _, truth = lifted
    peak, mean = (median(lifted, Oracle(truth, 50, 0.3, rule=rule)) for rule in ("peak", "least_squares"))
    assert mean > 1.5 * peak


def test_least_squares_do_not_depend_on_order_sign_place_and_scale(lifted):
    lines, truth = lifted
    rng = np.random.default_rng(2)
    order, sign = rng.permutation(len(truth)), rng.choice([-1.0, 1.0], len(truth))
    moved = LineCloud.through(7 * truth + [5.0, -3, 2], sign[:, None] * lines.direction)
    alike = [run(lines, Oracle(truth, 25, rule="least_squares")).xyz]
    alike.append((run(moved, Oracle(7 * truth + [5.0, -3, 2], 25, rule="least_squares")).xyz - [5.0, -3, 2]) / 7)
    shuffled = LineCloud.through(truth[order], lines.direction[order])
    alike.append(run(shuffled, Oracle(truth[order], 25, rule="least_squares")).xyz[order.argsort()])
    for other in alike[1:]:
        np.testing.assert_allclose(other, alike[0], atol=1e-4)


def test_the_candidate_oracle_lies_between_oracle_and_attack(lifted):
    _, truth = lifted
    attack = Heuristic()
    best, candidates, worst = (median(lifted, m) for m in (Oracle(truth, 50), CandidateOracle(truth, attack), attack))
    assert best < candidates < worst


def test_the_candidate_oracle_votes_with_true_candidates_only(lifted):
    lines, truth = lifted
    result = run(lines, CandidateOracle(truth, Heuristic(), k=20, candidates=100))
    true = nearest_neighbors(truth, 20).index
    assert result.neighbors is not None
    for used, neighbors in zip(result.neighbors, true, strict=True):
        assert set(used[used >= 0]) <= set(neighbors)


def test_a_line_without_true_candidates_keeps_the_word_of_the_attack(lifted):
    lines, truth = lifted
    attack = run(lines, Heuristic())
    result = run(lines, CandidateOracle(truth, Heuristic(), k=2, candidates=5))
    assert result.neighbors is not None
    none = (result.neighbors < 0).all(axis=1)
    assert none.any() and not none.all()
    np.testing.assert_array_equal(result.xyz[none], attack.xyz[none])


def test_leave_one_out_is_better_than_the_attack_and_worse_than_few_true_neighbours(lifted):
    _, truth = lifted
    assert median(lifted, Oracle(truth, 10)) < median(lifted, LeaveOneOut(truth)) < median(lifted, Heuristic())


def test_leave_one_out_finds_the_place_where_the_line_meets_the_scene():
    # All points but few lie in one plane, and a line meets it once.
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, size=(1500, 3)) * [1, 1, 0.001]
    hidden = hide(points, seed=1)
    lines, index = hidden.map, hidden.truth.index
    error = errors(run(lines, LeaveOneOut(points[index])).xyz, points[index]) / spacing(points)
    steep = np.abs(lines.direction[:, 2]) > 0.5
    assert np.median(error[steep]) < 0.05
    assert (error[steep] < 0.5).mean() > 0.98


def test_leave_one_out_does_not_use_the_lines_own_point(lifted):
    """A point far from all others cannot be placed: its line goes where the others are."""
    _, truth = lifted
    far = truth.copy()
    far[7] = [40.0, 0, 0]
    direction = np.random.default_rng(5).normal(size=far.shape)
    direction[7] = [1, 0.01, 0]
    result = run(LineCloud.through(far, direction), LeaveOneOut(far))
    assert np.linalg.norm(result.xyz[7]) < 5


class Looks(Embedding):
    """An embedding of colours: points whose colours are near each other look alike, more so if ``sharp``."""

    def __init__(self, sharp: float) -> None:
        super().__init__(length=128, width=1, size=6)
        self.sharp = sharp

    def forward(self, attributes: Mapping[str, Tensor]) -> Tensor:
        angle = 6 * attributes["rgb"]
        return self.sharp * torch.cat([angle.sin(), angle.cos()], dim=1)


def looks(sharp: float = 1.0) -> Learned:
    """A learned attack with this embedding."""
    attack = seeing()
    attack.network.embedding = Looks(sharp)
    return attack


def colored(truth: np.ndarray) -> np.ndarray:
    """Colours that change slowly along each axis."""
    low, high = truth.min(axis=0), truth.max(axis=0)
    return np.round(255 * (truth - low) / (high - low)).astype(np.uint8)


def slow_joint(lines: LineCloud, truth: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Places of the points by loops over widths, powers, lines and other points."""
    angle = 6 * (rgb / 255)
    vector = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
    background = np.log(np.exp(vector @ vector.T).mean(axis=1))
    likeness = vector @ vector.T - 0.5 * (background[:, None] + background)
    o, d, unit = lines.origin, lines.direction, spacing(truth)
    best, least = np.zeros(0), np.inf
    for width in unit * np.array(BANDWIDTHS):
        for power in POWERS:
            beta = np.zeros(len(truth))
            for i in range(len(truth)):
                others = [j for j in range(len(truth)) if j != i]
                foot = (truth[others] - o[i]) @ d[i]
                apart = np.linalg.norm(truth[others] - o[i] - foot[:, None] * d[i], axis=1)
                weight = np.exp(-0.5 * (apart / width) ** 2 + power * likeness[i, others])
                density = [(weight * np.exp(-0.5 * ((foot - at) / width) ** 2)).sum() for at in foot]
                beta[i] = foot[int(np.argmax(density))]
                for _ in range(5):
                    pull = weight * np.exp(-0.5 * ((foot - beta[i]) / width) ** 2)
                    beta[i] = (pull * foot).sum() / pull.sum()
            error = np.median(np.abs(beta - ((truth - o) * d).sum(axis=1)))
            if error < least:
                best, least = beta, error
    return lines.at(best)


def test_the_joint_bound_is_the_mode_of_kernel_times_likelihood_ratio(room):
    some = room[25::25]  # an odd number: medians of an even one differ between torch and numpy
    hidden = hide(some, seed=1, rgb=colored(some))
    lines, truth = hidden.map, hidden.truth.xyz
    assert lines.rgb is not None
    found = run(lines, LeaveOneOut(truth, k=200, sees=looks()))
    expected = slow_joint(lines, truth, lines.rgb)
    # Two places of almost equal density may change their order in single precision.
    assert (np.linalg.norm(found.xyz - expected, axis=1) < 1e-3).mean() > 0.97


def test_appearance_makes_the_bound_better_and_its_absence_leaves_it_to_the_bit(room):
    hidden = hide(room, seed=1, rgb=colored(room))
    lines, truth = hidden.map, hidden.truth.xyz
    alone = run(lines.without(["rgb"]), LeaveOneOut(truth))
    joint = run(lines, LeaveOneOut(truth, sees=looks()))
    assert median((lines, truth), LeaveOneOut(truth, sees=looks())) < 0.8 * median((lines, truth), LeaveOneOut(truth))
    assert joint.info["used"] == ["rgb"] and alone.info["used"] == []
    for same in (LeaveOneOut(truth), LeaveOneOut(truth, sees=looks())):
        other = run(lines if same.sees is None else lines.without(["rgb"]), same)
        for name in ("xyz", "confidence", "affinity", "neighbors"):
            np.testing.assert_array_equal(getattr(other, name), getattr(alone, name))


def test_the_joint_bound_does_not_depend_on_order_sign_place_and_scale(room):
    truth, rgb = room[::6], colored(room)[::6]
    rng = np.random.default_rng(2)
    direction, sign = rng.normal(size=truth.shape), rng.choice([-1.0, 1.0], (len(truth), 1))
    here = run(LineCloud.through(truth, direction, Appearance(rgb)), LeaveOneOut(truth, sees=looks())).xyz
    there, order = 7 * truth + [5.0, -3, 2], rng.permutation(len(truth))
    lines = LineCloud.through(there[order], (sign * direction)[order], Appearance(rgb[order]))
    found = (run(lines, LeaveOneOut(there[order], sees=looks())).xyz[order.argsort()] - [5.0, -3, 2]) / 7
    assert (np.linalg.norm(found - here, axis=1) < 1e-3).mean() > 0.99


def test_a_likelihood_ratio_beyond_all_floats_is_no_harm(room):
    hidden = hide(room[::5], seed=1, rgb=colored(room[::5]))
    found = run(hidden.map, LeaveOneOut(hidden.truth.xyz, sees=looks(sharp=1e3)))
    assert np.isfinite(found.xyz).all() and ((found.confidence >= 0) & (found.confidence <= 1)).all()


def test_the_bound_sees_by_the_embedding_of_a_learned_attack(room):
    hidden = hide(
        room, seed=1, rgb=colored(room), descriptor=np.ones((len(room), 128), np.uint8), descriptor_kind="sift"
    )
    seen = run(hidden.map, LeaveOneOut(hidden.truth.xyz, sees=seeing()))
    assert seen.info["used"] == ["rgb", "descriptor"]
    assert not np.array_equal(seen.xyz, run(hidden.map, LeaveOneOut(hidden.truth.xyz)).xyz)
    other = run(hidden.map, LeaveOneOut(hidden.truth.xyz, sees=seeing(kind="orb")))
    assert other.info["used"] == ["rgb"], "descriptors of another kind say nothing"
    with pytest.raises(InputError, match="sees appearance by a network, which uses lines alone; expected a checkpoint"):
        LeaveOneOut(room, sees=learned())


@pytest.mark.parametrize(("outliers", "wrong"), [(0.0, 0), (0.25, 10), (0.5, 20), (1.0, 40)])
def test_a_share_of_the_neighbours_is_wrong(room, outliers, wrong):
    neighbors = Oracle(room, 40, outliers).neighbors()
    true = nearest_neighbors(room, 40).index
    assert neighbors.shape == (1500, 40)
    assert (neighbors != np.arange(1500)[:, None]).all()
    assert (neighbors >= 0).all() and (neighbors < 1500).all()
    kept = (neighbors == true).sum(axis=1)
    # An outlier drawn at random may hit the very neighbour that it replaces.
    assert (kept >= 40 - wrong).all() and kept.mean() < 40 - wrong + 0.5
    if wrong == 20:
        # Near and far neighbours are replaced alike.
        np.testing.assert_allclose((neighbors == true).mean(axis=0), 0.5, atol=0.06)


def test_the_seed_decides_the_outliers(room):
    one, same, other = (Oracle(room, 20, 0.5, seed).neighbors() for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


@pytest.mark.parametrize("count", [1, 2, 3, 10])
def test_few_lines_have_bounds(count):
    points = np.random.default_rng(3).normal(size=(count, 3))
    hidden = hide(points, seed=1)
    lines, index = hidden.map, hidden.truth.index
    truth = points[index]
    oracles = (Oracle(truth, 50), Oracle(truth, 50, 0.5), Oracle(truth, 50, rule="least_squares"))
    lines = LineCloud(lines.direction, lines.moment, rgb=np.zeros((count, 3), np.uint8))
    bounds = (CandidateOracle(truth, Heuristic()), LeaveOneOut(truth), LeaveOneOut(truth, sees=seeing()))
    for method in (*oracles, *bounds):
        result = run(lines, method)
        assert np.isfinite(result.xyz).all() and np.isfinite(result.confidence).all()


def test_points_in_one_place_have_bounds():
    # The 50th neighbour of most points is at distance 0, which leaves the kernel no width of its own.
    points = np.ones((120, 3))
    points[:30] = np.random.default_rng(0).normal(size=(30, 3))
    lines = LineCloud.through(points, np.random.default_rng(1).normal(size=(120, 3)))
    for method in (Oracle(points, 10), CandidateOracle(points, Heuristic()), LeaveOneOut(points)):
        result = run(lines, method)
        assert np.isfinite(result.xyz).all() and np.isfinite(result.confidence).all()
    at_one = errors(run(lines, LeaveOneOut(points)).xyz, points)[30:]
    assert np.median(at_one) < 0.1


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda points: Oracle(points, 0), "got k = 0; expected at least 1 neighbour"),
        (lambda points: Oracle(points, 5, 1.5), r"got outliers = 1.5; expected a share in \[0, 1\]"),
        (lambda points: Oracle(points, 5, -0.1), r"got outliers = -0.1; expected a share in \[0, 1\]"),
        (
            lambda points: Oracle(points, 5, rule="mode"),
            "got rule 'mode' of the oracle; expected peak or least_squares",
        ),
        (lambda points: Oracle(points * np.nan, 5), r"got 1500 line\(s\) with a points that is NaN, infinite"),
        (lambda points: LeaveOneOut(points * np.inf), r"got \d+ line\(s\) with a points that is NaN, infinite"),
    ],
)
def test_bounds_that_make_no_sense_are_refused(room, build, message):
    with np.errstate(invalid="ignore"), pytest.raises(InputError, match=message):
        build(room)


@pytest.mark.parametrize("bound", [Oracle, LeaveOneOut, lambda points: CandidateOracle(points, Heuristic())])
def test_the_true_points_must_be_those_of_the_lines(lifted, bound):
    lines, truth = lifted
    with pytest.raises(
        InputError, match="got 1499 true points for 1500 lines; expected them in the order of the lines"
    ):
        run(lines, bound(truth[:-1]))


def test_bounds_name_their_settings(room):
    assert Oracle(room, 10, 0.5, 3).settings() == {"k": 10, "outliers": 0.5, "seed": 3, "rule": "peak"}
    assert CandidateOracle(room, Heuristic()).settings()["attack"]["rounds"] == 3
    assert LeaveOneOut(room).settings()["k"] == 128
