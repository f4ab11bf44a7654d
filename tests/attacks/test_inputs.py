"""Features of candidates: each against its definition in plain loops, and what they must not depend on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

import l2p
from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.checkpoint import Checkpoint
from l2p.attacks.learned.edges import Edges, edges_of, feature_names, vote_names
from l2p.attacks.learned.inputs import GEOMETRY, INPUTS, inputs_of
from l2p.attacks.learned.inputs.family import Inputs, Kind, Values
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import LineTransformer, NetworkConfig
from l2p.attacks.learned.nodes import Estimates, Nodes, NodesConfig, nodes_of
from l2p.attacks.run import run
from l2p.attacks.tomography.posterior import Posterior
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.local_planes import Surface, fitted

LINES, K = 80, 10
FAMILIES = inputs_of(GEOMETRY)
EDGE, VOTES = feature_names(FAMILIES), vote_names(FAMILIES)
CONFIG, STATE = NodesConfig(), 8
SCALE, WIDE = CONFIG.scale, CONFIG.wide
ROWS = torch.arange(0, LINES, 3)


class Scene(NamedTuple):
    """What features are made from, in double precision, so that only mistakes differ."""

    lines: Lines
    beta: Tensor
    confidence: Tensor
    state: Tensor
    posterior: Posterior
    candidates: Tensor

    @property
    def nodes(self) -> Nodes:
        return nodes_of(self.lines, Estimates(self.beta, self.confidence, self.state), CONFIG)

    def edges(self) -> Edges:
        return edges_of(self.pairs(), FAMILIES)

    def pairs(self, rows: Tensor = ROWS, **attributes: Tensor) -> Candidates:
        return Candidates(self.lines, self.nodes, self.posterior, rows, self.candidates[rows], attributes=attributes)


@pytest.fixture(scope="module")
def scene(scene_points: np.ndarray) -> Scene:
    """Estimates beside their points, and for each line some others; a few are padding."""
    draw = torch.Generator().manual_seed(0)
    hidden = l2p.hide(scene_points[::5], seed=0)
    cloud, index = hidden.map, hidden.truth.index
    frame = Frame.of(cloud)
    lines = frame.enter(cloud, dtype=torch.float64)
    truth = frame.enter_points(scene_points[::5][index], dtype=torch.float64)
    beta = (truth * lines.direction).sum(dim=1) + 0.05 * torch.randn(LINES, generator=draw).double()
    probability = torch.rand(LINES, 30, generator=draw).double()
    posterior = Posterior(
        beta=beta[:, None] + torch.randn(LINES, 30, generator=draw).double(),
        probability=probability / probability.sum(dim=1, keepdim=True),
        step=torch.ones(LINES).double(),
    )
    others = torch.stack([torch.randperm(LINES - 1, generator=draw)[:K] for _ in range(LINES)])
    candidates = (torch.arange(LINES)[:, None] + 1 + others) % LINES
    candidates[6, 4:] = -1
    state = torch.randn(LINES, STATE, generator=draw).double()
    return Scene(lines, beta, torch.rand(LINES, generator=draw).double(), state, posterior, candidates)


def assert_close(one: Edges, other: Edges) -> None:
    """The same where there are candidates."""
    assert torch.equal(one.valid, other.valid)
    for name, left, right in zip(one._fields, one, other, strict=True):
        if name != "valid":
            left, right = left[one.valid], right[one.valid]
        torch.testing.assert_close(left, right, atol=1e-7, rtol=1e-6, msg=lambda text, name=name: f"{name}: {text}")


def compressed(value: Any) -> float:
    return math.copysign(math.log1p(abs(value)), value)


def slow_cut(scene: Scene, surface: Surface, i: int, j: int) -> float:
    """Where line i meets the plane of candidate j, by solving for it; grazing lines at the least slope."""
    o, d = scene.lines.foot[i].numpy(), scene.lines.direction[i].numpy()
    normal, centre = surface.normal[j].numpy(), surface.centre[j].numpy()
    slope, foot = normal @ d, float((scene.nodes.point[j].numpy() - o) @ d)
    if abs(slope) >= 0.05:
        return float(normal @ (centre - o) / slope)
    return foot + float(normal @ (centre - o - foot * d)) / math.copysign(0.05, slope)


def slow_votes(scene: Scene, nodes: Nodes, i: int, j: int) -> dict[str, float]:
    """Where candidate j says that the point of line i is."""
    o, d = scene.lines.foot[i].numpy(), scene.lines.direction[i].numpy()
    other, along = scene.lines.foot[j].numpy(), scene.lines.direction[j].numpy()
    scale, foot = float(nodes.scale[j]), float((nodes.point[j].numpy() - o) @ d)
    cuts = (slow_cut(scene, surface, i, j) for surface in (nodes.surface, nodes.wide))
    cut, wide_cut = (foot + max(-3 * scale, min(3 * scale, cut - foot)) for cut in cuts)
    closest = np.linalg.lstsq(np.stack([d, -along], axis=1), other - o, rcond=None)[0][0]
    return {"closest": float(closest), "foot": foot, "cut": cut, "wide_cut": wide_cut}


def slow_surface(scene: Scene, surface: Surface, side: float, i: int, j: int) -> dict[str, float]:
    """What is told of a surface of candidate j."""
    o, d = scene.lines.foot[i].numpy(), scene.lines.direction[i].numpy()
    normal, centre, scale = surface.normal[j].numpy(), surface.centre[j].numpy(), float(scene.nodes.scale[j])
    votes = slow_votes(scene, scene.nodes, i, j)

    def off(place: np.ndarray) -> float:
        return compressed(abs(normal @ (place - centre)) / scale)

    return {
        "incidence": max(0.05, float(abs(normal @ d))),
        "planarity": float(surface.planarity[j]),
        "linearity": float(surface.linearity[j]),
        "cut": side * compressed((slow_cut(scene, surface, i, j) - float(scene.beta[i])) / scale),
        "foot_off_plane": off(o + votes["foot"] * d),
        "closest_off_plane": off(o + votes["closest"] * d),
        "own_off_plane": off(scene.nodes.point[i].numpy()),
    }


def slow_feature(scene: Scene, nodes: Nodes, side: float, i: int, j: int) -> dict[str, Any]:
    """Every feature by its name."""
    o, d = scene.lines.foot[i].numpy(), scene.lines.direction[i].numpy()
    other, along = scene.lines.foot[j].numpy(), scene.lines.direction[j].numpy()
    here, point = nodes.point[i].numpy(), nodes.point[j].numpy()
    scale, beta, typical = float(nodes.scale[j]), float(scene.beta[i]), float(nodes.scale.median())
    votes = slow_votes(scene, nodes, i, j)
    closest, foot = votes["closest"], votes["foot"]
    across = np.cross(d, along)
    line_line = abs((other - o) @ across) / np.linalg.norm(across)
    point_line = np.linalg.norm(o + foot * d - point)

    def mass(place: float) -> float:
        samples = zip(scene.posterior.beta[i].tolist(), scene.posterior.probability[i].tolist(), strict=True)
        return math.log(sum(share for at, share in samples if place - scale <= at < place + scale) + 1e-4)

    return {
        "foot": side * compressed((foot - beta) / scale),
        "closest": side * compressed((closest - beta) / scale),
        "foot_closest": compressed(abs(closest - foot) / scale),
        "line_line": compressed(line_line / scale),
        "point_line": compressed(point_line / scale),
        "line_point": compressed(np.linalg.norm(here - other - ((here - other) @ along) * along) / scale),
        "point_point": compressed(np.linalg.norm(here - point) / scale),
        "cosine": abs(d @ along),
        "posterior_at_foot": mass(foot),
        "posterior_at_closest": mass(closest),
        "confidence": float(scene.confidence[j]),
        "own_confidence": float(scene.confidence[i]),
        "crowd": float(nodes.crowd[j]),
        "log_scale": math.log(scale / typical),
        "log_scale_ratio": math.log(scale / float(nodes.scale[i])),
        "log_line_line": math.log(line_line / typical + 1e-3),
        "log_point_line": math.log(point_line / typical + 1e-3),
        **slow_surface(scene, nodes.surface, side, i, j),
        **{f"wide_{name}": value for name, value in slow_surface(scene, nodes.wide, side, i, j).items()},
    }


def some_pairs(scene: Scene) -> Iterator[tuple[int, int, int, int]]:
    """Row, column and the two lines of every seventh pair: the loops below are slow."""
    for row, i in enumerate(ROWS.tolist()):
        for column, j in enumerate(scene.candidates[i].tolist()):
            if j >= 0 and (3 * row + column) % 7 == 0:
                yield row, column, i, j


def test_votes_are_where_the_candidates_say_the_point_is(scene: Scene) -> None:
    seen, nodes = scene.edges(), scene.nodes
    for row, column, i, j in some_pairs(scene):
        slow = slow_votes(scene, nodes, i, j)
        expected = [slow[name] - float(scene.beta[i]) for name in VOTES]
        np.testing.assert_allclose(seen.vote[row, column].numpy(), expected, rtol=1e-6, atol=1e-8)
        foot = slow["foot"] - float(scene.beta[i])
        np.testing.assert_allclose(seen.foot[row, column].numpy(), foot, rtol=1e-6, atol=1e-8)


def test_features_are_what_their_names_say(scene: Scene) -> None:
    seen, nodes = scene.edges(), scene.nodes
    for row, column, i, j in some_pairs(scene):
        slow = slow_feature(scene, nodes, float(seen.side[row, 0]), i, j)
        assert slow.keys() == set(EDGE)
        expected = [slow[name] for name in EDGE]
        np.testing.assert_allclose(seen.feature[row, column].numpy(), expected, rtol=1e-5, atol=1e-7)


def test_candidates_bring_their_own_distance_scale_confidence_and_state(scene: Scene) -> None:
    seen, nodes = scene.edges(), scene.nodes
    chosen = scene.candidates[ROWS]
    there, j = seen.valid, chosen[seen.valid]
    assert torch.equal(there, chosen >= 0)
    assert torch.equal(seen.scale[there], nodes.scale[j])
    assert torch.equal(seen.confidence[there], scene.confidence[j])
    assert torch.equal(seen.state[there], scene.state[j])
    i = ROWS[:, None].expand_as(chosen)[there]
    off = torch.linalg.cross(nodes.point[j], scene.lines.direction[i]) - scene.lines.moment[i]
    torch.testing.assert_close(seen.point_line[there], off.norm(dim=1))


def test_surroundings_are_those_of_the_nearest_estimates(scene: Scene) -> None:
    nodes = scene.nodes
    points, confidence, direction = nodes.point.numpy(), scene.confidence.numpy(), scene.lines.direction.numpy()
    for i, point in enumerate(points):
        distance = np.linalg.norm(points - point, axis=1)
        near = np.argsort(distance)
        assert float(nodes.scale[i]) == pytest.approx(distance[near[SCALE]])
        assert float(nodes.crowd[i]) == pytest.approx(confidence[near[: SCALE + 1]].mean())
        for surface, count in ((nodes.surface, SCALE), (nodes.wide, WIDE)):
            some = near[: count + 1]
            columns = [torch.as_tensor(column[some])[None] for column in (points, direction, confidence)]
            expected = fitted(columns[0], columns[1], columns[2], CONFIG.surface)
            for found, part in zip(Surface(*(part[i : i + 1] for part in surface)), expected, strict=True):
                torch.testing.assert_close(found.abs(), part.abs(), atol=1e-6, rtol=1e-6)


def test_wide_surfaces_are_those_of_the_nearest_leader() -> None:
    """Of every second estimate, when there are more of them than one surface takes."""
    draw = torch.Generator().manual_seed(0)
    foot = torch.randn(3 * WIDE, 3, generator=draw).double()
    direction = torch.nn.functional.normalize(torch.randn(foot.shape, generator=draw).double(), dim=1)
    lines = Lines(direction, torch.linalg.cross(foot, direction))
    beta, confidence = (foot * direction).sum(dim=1), torch.rand(len(foot), generator=draw).double()
    nodes = nodes_of(lines, Estimates(beta, confidence, torch.zeros(len(foot), STATE).double()), CONFIG)
    for i, point in enumerate(foot):
        leader = 2 * int((foot[::2] - point).norm(dim=1).argmin())
        some = (foot - foot[leader]).norm(dim=1).argsort()[: WIDE + 1]
        expected = fitted(foot[some][None], direction[some][None], confidence[some][None], CONFIG.surface)
        for found, part in zip(nodes.wide, expected, strict=True):
            torch.testing.assert_close(found[i].abs(), part[0].abs(), atol=1e-6, rtol=1e-6)


def test_a_rigid_motion_and_scale_change_lengths_alone(scene: Scene, rng: np.random.Generator) -> None:
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn = torch.as_tensor(turn * np.linalg.det(turn))
    shift, factor = torch.tensor([3.0, -1.0, 20.0]).double(), 7.0
    direction = scene.lines.direction @ turn.T
    foot = factor * scene.lines.foot @ turn.T + shift
    # Positions are counted from the foot of the moved line.
    ahead = (foot * direction).sum(dim=1)
    moved = scene._replace(
        lines=Lines(direction, torch.linalg.cross(foot, direction)),
        beta=factor * scene.beta + ahead,
        posterior=scene.posterior._replace(beta=factor * scene.posterior.beta + ahead[:, None]),
    )
    seen = moved.edges()
    back = seen._replace(**{name: getattr(seen, name) / factor for name in ("vote", "foot", "point_line", "scale")})
    assert_close(scene.edges(), back)


def test_flipped_directions_flip_votes_and_sides_alone(scene: Scene) -> None:
    sign = torch.where(torch.arange(LINES) % 2 == 0, -1.0, 1.0).double()
    flipped = scene._replace(
        lines=Lines(*(sign[:, None] * part for part in scene.lines)),
        beta=sign * scene.beta,
        posterior=scene.posterior._replace(beta=sign[:, None] * scene.posterior.beta),
    )
    seen, own = flipped.edges(), sign[ROWS]
    unflipped = seen._replace(
        vote=own[:, None, None] * seen.vote, foot=own[:, None] * seen.foot, side=own[:, None].float() * seen.side
    )
    assert_close(scene.edges(), unflipped)


def test_order_of_lines_changes_indices_alone(scene: Scene) -> None:
    order = torch.randperm(LINES, generator=torch.Generator().manual_seed(3))
    place = order.argsort()  # where each line has gone
    shuffled = Scene(
        lines=scene.lines.rows(order),
        beta=scene.beta[order],
        confidence=scene.confidence[order],
        state=scene.state[order],
        posterior=Posterior(*(part[order] for part in scene.posterior[:3])),
        candidates=torch.where(scene.candidates < 0, -1, place[scene.candidates.clamp_min(0)])[order],
    )
    assert_close(scene.edges(), edges_of(shuffled.pairs(place[ROWS]), FAMILIES))


def test_order_of_candidates_changes_their_order_alone(scene: Scene) -> None:
    seen = scene._replace(candidates=scene.candidates.flip(1)).edges()
    assert_close(scene.edges(), Edges(*(column.flip(1) for column in seen)))


def test_padding_changes_nothing(scene: Scene) -> None:
    more = scene._replace(candidates=torch.nn.functional.pad(scene.candidates, (0, 3), value=-1)).edges()
    assert not more.valid[:, K:].any() and (more.feature[~more.valid] == 0).all()
    assert_close(scene.edges(), Edges(*(column[:, :K] for column in more)))


def test_other_rows_change_nothing(scene: Scene) -> None:
    assert_close(Edges(*(part[4:5] for part in scene.edges())), edges_of(scene.pairs(ROWS[4:5]), FAMILIES))


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_and_coinciding_estimates_have_finite_surroundings(scene: Scene, count: int) -> None:
    lines = Lines(*(part[:1].repeat(count, 1) for part in scene.lines))
    estimates = Estimates(scene.beta[:1].repeat(count), scene.confidence[:count], scene.state[:count])
    nodes = nodes_of(lines, estimates, CONFIG)
    assert (nodes.scale > 0).all() and nodes.crowd.isfinite().all()
    for surface in (nodes.surface, nodes.wide):
        assert all(part.isfinite().all() for part in surface)
        torch.testing.assert_close(surface.normal.norm(dim=1), torch.ones(count).double())


# Families


@dataclass(frozen=True)
class Resemblance:
    """A toy: how like the colours of a pair are; a whole new input is this class and a row of INPUTS."""

    columns: ClassVar = {"resemblance": Kind.NUMBER, "color_distance": Kind.LENGTH}
    votes: ClassVar = ()
    needs: ClassVar = ("rgb",)
    least: float = 0.5

    def of(self, pairs: Candidates) -> Values:
        rgb = pairs.attributes["rgb"]
        apart = (pairs.own(rgb) - pairs.other(rgb)).norm(dim=-1)
        return Values([1 / (self.least + apart), apart * pairs.scale])


@pytest.fixture
def resemblance(monkeypatch: pytest.MonkeyPatch) -> tuple[Inputs, ...]:
    monkeypatch.setitem(INPUTS, "resemblance", f"{__name__}:Resemblance")
    return inputs_of((*GEOMETRY, "resemblance"))


def test_a_new_input_is_one_file_and_one_row(scene: Scene, resemblance: tuple[Inputs, ...]) -> None:
    rgb = torch.rand(LINES, 3, generator=torch.Generator().manual_seed(5)).double()
    names = feature_names(resemblance)
    seen = edges_of(scene.pairs(rgb=rgb), resemblance)
    for row, i in enumerate(ROWS.tolist()):
        for column, j in enumerate(scene.candidates[i].tolist()):
            if j >= 0:
                apart = float((rgb[i] - rgb[j]).norm())
                found = dict(zip(names, seen.feature[row, column].tolist(), strict=True))
                assert found["resemblance"] == pytest.approx(1 / (0.5 + apart))
                assert found["color_distance"] == pytest.approx(math.log1p(apart))
                assert found["has_rgb"] == 1
    old = [names.index(name) for name in EDGE]
    torch.testing.assert_close(seen.feature[..., old], scene.edges().feature)


def test_an_absent_attribute_leaves_its_columns_0(scene: Scene, resemblance: tuple[Inputs, ...]) -> None:
    seen, names = edges_of(scene.pairs(), resemblance), feature_names(resemblance)
    for name in ("resemblance", "color_distance", "has_rgb"):
        assert (seen.feature[..., names.index(name)] == 0).all()
    assert_close(scene.edges(), seen._replace(feature=seen.feature[..., [names.index(name) for name in EDGE]]))


def test_a_network_with_a_new_input_attacks_and_is_saved_with_its_constants(
    scene_points: np.ndarray, resemblance: tuple[Inputs, ...], tmp_path: Path
) -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = LineTransformer(NetworkConfig(width=8, heads=2, inputs=(*GEOMETRY, "resemblance")))
    inputs: tuple[Any, ...] = (*inputs_of(GEOMETRY), Resemblance(least=0.25))
    config, calibration = LearnedConfig(rounds=2), {"lines": [[(1.0, 0.0)] * 5] * 2}
    checkpoint.save(tmp_path / "like.safetensors", Checkpoint(network, config, calibration, {}, inputs))
    attack = checkpoint.load(tmp_path / "like.safetensors")
    assert attack.inputs == inputs
    rgb = np.random.default_rng(0).integers(0, 256, (len(scene_points), 3)).astype(np.uint8)
    with_colors, without = (run(l2p.lift(scene_points, seed=0, rgb=colors), attack) for colors in (rgb, None))
    assert np.isfinite(with_colors.xyz).all() and np.isfinite(without.xyz).all()
    assert not np.array_equal(with_colors.xyz, without.xyz)
    assert (with_colors.info["used"], without.info["used"]) == (["rgb"], [])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("position", "nose"), "got input 'nose' of a network; expected some of position"),
        (("position", "position"), "expected each of them once"),
        (("distance", "angle"), "none of which votes"),
    ],
)
def test_unknown_repeated_and_voteless_inputs_are_refused(names: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        inputs_of(names)


@pytest.mark.parametrize("constants", [{}, {"least": "small"}, {"least": 1e-3, "most": 1}])
def test_constants_of_another_family_are_refused(constants: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="of input distance; expected numbers for"):
        inputs_of(("position", "distance"), {"position": {}, "distance": constants})
