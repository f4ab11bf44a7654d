"""The line transformer: its answer depends on the candidates of a line and on nothing else."""

from __future__ import annotations

import math

import pytest
import torch

from l2p.attacks.learned.edges import Edges, feature_names, vote_names
from l2p.attacks.learned.inputs import GEOMETRY, inputs_of
from l2p.attacks.learned.network import Judgement, LineTransformer, NetworkConfig

LINES, K = 7, 12
INPUTS = inputs_of(GEOMETRY)
EDGE, VOTES = feature_names(INPUTS), vote_names(INPUTS)
STATE, RADII = NetworkConfig.state, NetworkConfig.radii
#: Lines with padding, and with nothing else.
SHORT, EMPTY = 2, 3


@pytest.fixture
def network() -> LineTransformer:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return LineTransformer(NetworkConfig(width=12, layers=2, heads=3)).eval()


@pytest.fixture
def edges() -> Edges:
    draw = torch.Generator().manual_seed(1)
    valid = torch.ones(LINES, K, dtype=torch.bool)
    valid[SHORT, 5:] = False
    valid[EMPTY] = False
    return Edges(
        vote=torch.randn(LINES, K, len(VOTES), generator=draw),
        foot=torch.randn(LINES, K, generator=draw),
        point_line=torch.rand(LINES, K, generator=draw),
        scale=torch.rand(LINES, K, generator=draw) + 0.1,
        confidence=torch.rand(LINES, K, generator=draw),
        feature=torch.randn(LINES, K, len(EDGE), generator=draw),
        state=torch.randn(LINES, K, STATE, generator=draw),
        side=torch.tensor([1.0, -1.0]).repeat(LINES)[:LINES, None].expand(LINES, K),
        likeness=2 * torch.randn(LINES, K, generator=draw),
        valid=valid,
    )


def judged(network: LineTransformer, edges: Edges) -> Judgement:
    with torch.inference_mode():
        return network(edges)


def columns(edges: Edges, which: slice | torch.Tensor) -> Edges:
    """Some of the candidates."""
    return Edges(*(column[:, which] for column in edges))


def rows(edges: Edges, which: slice) -> Edges:
    """Some of the lines."""
    return Edges(*(part[which] for part in edges))


def assert_close(one: Judgement, other: Judgement) -> None:
    for name, left, right in zip(one._fields, one, other, strict=True):
        torch.testing.assert_close(left, right, atol=1e-5, rtol=1e-5, msg=lambda text, name=name: f"{name}: {text}")


def slow_heads(edges: Edges, i: int, scale: float) -> tuple[list[list[float]], list[list[float]], list[float]]:
    """Of a line and a head: attention, logarithms of density, confident density and count, and the mean shift."""
    there = [k for k in range(K) if edges.valid[i, k]]
    t, w = edges.foot[i].tolist(), edges.scale[i].tolist()
    g, c = edges.point_line[i].tolist(), edges.confidence[i].tolist()
    near = [[(1 + ((t[j] - t[k]) ** 2 + g[k] ** 2) / (scale * w[k]) ** 2) ** -2 for k in there] for j in there]
    attention = [[value / (sum(row) + 1e-2) for value in row] for row in near]
    logarithms, shift = [], []
    for j, row in zip(there, near, strict=True):
        weight = [value / w[k] ** 3 for k, value in zip(there, row, strict=True)]
        confident = [c[k] * value for k, value in zip(there, weight, strict=True)]
        logarithms.append([math.log(sum(weight)), math.log(sum(confident)), math.log(sum(row))])
        mean = sum(t[k] * value for k, value in zip(there, confident, strict=True)) / sum(confident)
        shift.append(max(-3.0, min(3.0, (mean - t[j]) / w[j])))
    densest = [max(part[kind] for part in logarithms) for kind in (0, 1)] + [0.0]
    return attention, [[a - b for a, b in zip(part, densest, strict=True)] for part in logarithms], shift


def test_kernels_densities_and_shifts_are_those_of_the_formula(network: LineTransformer, edges: Edges) -> None:
    attention, around = network._kernels(edges)
    heads, dim = len(network.config.scales), 3
    value = torch.randn(LINES, K, heads * dim, generator=torch.Generator().manual_seed(5))
    gathered = attention.gathered(value)
    for i in range(LINES):
        there = edges.valid[i]
        assert (around[i][~there] == 0).all()
        for head, scale in enumerate(network.config.scales):
            if i == EMPTY:
                continue
            weights, logarithms, shifted = (torch.tensor(part) for part in slow_heads(edges, i, scale))
            part = slice(dim * head, dim * (head + 1))
            expected = weights @ value[i, there, part]
            torch.testing.assert_close(gathered[i, there, part], expected, atol=1e-5, rtol=1e-4)
            expected = 0.3 * logarithms.clamp(-15, 15)
            torch.testing.assert_close(around[i, there, 4 * head : 4 * head + 3], expected, atol=1e-5, rtol=1e-4)
            turned = edges.side[i, there] * shifted
            torch.testing.assert_close(around[i, there, 4 * head + 3], turned, atol=1e-5, rtol=1e-4)


def test_surroundings_by_likeness_are_those_of_the_formula(edges: Edges) -> None:
    network = LineTransformer(NetworkConfig(width=12, heads=3, inputs=(*GEOMETRY, "likeness"))).requires_grad_(False)
    network.power.fill_(0.7)
    _, around = network._kernels(edges)
    _, plain = LineTransformer(NetworkConfig(width=12, heads=3))._kernels(edges)
    assert torch.equal(around.unflatten(2, (3, 7))[..., :4], plain.unflatten(2, (3, 4)))
    for i in (line for line in range(LINES) if line != EMPTY):
        there = [k for k in range(K) if edges.valid[i, k]]
        t, w, g, c = (part[i].tolist() for part in (edges.foot, edges.scale, edges.point_line, edges.confidence))
        like = (0.7 * edges.likeness[i]).exp().tolist()
        for head, scale in enumerate(network.config.scales):
            level, mean, shift = [], [], []
            for j in there:
                near = {k: c[k] * (1 + ((t[j] - t[k]) ** 2 + g[k] ** 2) / (scale * w[k]) ** 2) ** -2 for k in there}
                sure = sum(value / w[k] ** 3 for k, value in near.items())
                alike = sum(like[k] * value / w[k] ** 3 for k, value in near.items())
                level.append(math.log(alike))
                # The densities are relative to the densest candidate's weight, which the ratio does not feel.
                mean.append(0.3 * math.log(alike / sure))
                middle = sum(t[k] * like[k] * value / w[k] ** 3 for k, value in near.items()) / alike
                shift.append(float(edges.side[i, j]) * max(-3.0, min(3.0, (middle - t[j]) / w[j])))
            level = [0.3 * max(value - max(level), -15) for value in level]
            expected = torch.tensor([level, mean, shift]).T
            torch.testing.assert_close(around[i, there, 7 * head + 4 : 7 * head + 7], expected, atol=1e-4, rtol=1e-4)


def test_without_appearance_its_inputs_say_nothing_new(edges: Edges) -> None:
    network = LineTransformer(NetworkConfig(width=12, heads=3, inputs=(*GEOMETRY, "likeness"))).requires_grad_(False)
    _, around = network._kernels(edges._replace(likeness=torch.zeros(LINES, K)))
    _, confident, _, shift, level, mean, alike = around.unflatten(2, (3, 7)).unbind(dim=3)
    torch.testing.assert_close(level, confident)
    torch.testing.assert_close(alike, shift)
    assert mean.abs().max() < 1e-6


def test_heads_are_spread_geometrically() -> None:
    assert NetworkConfig(width=6, heads=3, finest=0.5, widest=2.0).scales == pytest.approx([0.5, 1.0, 2.0])
    assert NetworkConfig(width=6, heads=1, finest=0.5, widest=2.0).scales == [0.5]


@pytest.mark.parametrize("name", GEOMETRY)
def test_a_network_has_the_columns_and_votes_of_its_inputs_alone(name: str) -> None:
    names = tuple(family for family in GEOMETRY if family != name)
    less = LineTransformer(NetworkConfig(width=12, heads=3, inputs=names))
    whole = LineTransformer(NetworkConfig(width=12, heads=3))
    lost = inputs_of(("position", name) if name != "position" else ("position",))[-1]
    weights = [network.state_dict()["embed.0.weight"].shape[1] for network in (whole, less)]
    assert weights[0] - weights[1] == len(lost.columns)
    assert len(whole.log_spread) - len(less.log_spread) == len(lost.votes)


def test_places_are_the_votes(network: LineTransformer, edges: Edges) -> None:
    assert torch.equal(judged(network, edges).place, edges.vote)


def test_any_batch_gives_the_same(network: LineTransformer, edges: Edges) -> None:
    single = [judged(network, rows(edges, slice(i, i + 1))) for i in range(LINES)]
    assert_close(judged(network, edges), Judgement(*(torch.cat(parts) for parts in zip(*single, strict=True))))


def test_padding_changes_nothing(network: LineTransformer, edges: Edges) -> None:
    some = rows(edges, slice(SHORT, SHORT + 1))
    short, padded = judged(network, columns(some, slice(0, 5))), judged(network, some)
    trimmed = {name: getattr(padded, name)[:, :5] for name in ("affinity", "place", "spread", "vote")}
    assert_close(short, padded._replace(**trimmed))
    assert torch.sigmoid(padded.affinity[:, 5:]).lt(1e-12).all()
    assert torch.softmax(padded.vote.flatten(1), dim=1).unflatten(1, padded.vote.shape[1:])[:, 5:].eq(0).all()


def test_what_stands_in_padding_changes_nothing(network: LineTransformer, edges: Edges) -> None:
    gone = ~edges.valid
    garbage = edges._replace(
        vote=edges.vote.masked_fill(gone[..., None], 1e6),
        foot=edges.foot.masked_fill(gone, 1e6),
        point_line=edges.point_line.masked_fill(gone, 1e6),
        scale=edges.scale.masked_fill(gone, 1e-6),
        confidence=edges.confidence.masked_fill(gone, 7.0),
        state=edges.state.masked_fill(gone[..., None], -50.0),
    )
    one, other = judged(network, edges), judged(network, garbage)
    assert_close(one, other._replace(place=other.place.where(edges.valid[..., None], one.place)))


def test_order_of_candidates_changes_nothing(network: LineTransformer, edges: Edges) -> None:
    order = torch.randperm(K, generator=torch.Generator().manual_seed(2))
    one, other = judged(network, edges), judged(network, columns(edges, order))
    moved = {name: getattr(one, name)[:, order] for name in ("affinity", "place", "spread", "vote")}
    assert_close(one._replace(**moved), other)


def test_a_flipped_direction_flips_places_alone(network: LineTransformer, edges: Edges) -> None:
    turned = edges._replace(vote=-edges.vote, foot=-edges.foot, side=-edges.side)
    one, other = judged(network, edges), judged(network, turned)
    assert_close(one, other._replace(place=-other.place))


def test_the_unit_of_length_changes_places_and_their_spread_alone(network: LineTransformer, edges: Edges) -> None:
    lengths = {name: 40 * getattr(edges, name) for name in ("vote", "foot", "point_line", "scale")}
    larger = edges._replace(**lengths)
    one, other = judged(network, edges), judged(network, larger)
    there = edges.valid[..., None]
    place, spread = ((o / 40).where(there, mine) for o, mine in ((other.place, one.place), (other.spread, one.spread)))
    assert_close(one, other._replace(place=place, spread=spread))


def test_logits_of_finding_do_not_fall_with_the_radius(network: LineTransformer, edges: Edges) -> None:
    for part in network.pool.parameters():
        torch.nn.init.normal_(part, std=10.0, generator=torch.Generator().manual_seed(4))
    found = judged(network, edges).found
    assert found.shape == (LINES, len(RADII)) and found.abs().max() > 10
    assert (found.diff(dim=1) >= 0).all()
    assert list(RADII) == sorted(RADII)


def test_a_line_without_candidates_has_a_finite_judgement(network: LineTransformer, edges: Edges) -> None:
    answer = judged(network, edges)
    assert all(part[EMPTY].isfinite().all() for part in answer)


def test_candidates_without_confidence_are_judged(network: LineTransformer, edges: Edges) -> None:
    nobody = edges._replace(confidence=torch.zeros(LINES, K))
    assert all(part.isfinite().all() for part in judged(network, nobody))
    assert (network._kernels(nobody)[1][..., 3::4] == 0).all()


def test_gradients_are_finite_and_reach_everything(network: LineTransformer, edges: Edges) -> None:
    answer = network.train()(edges)
    there = edges.valid
    parts = (answer.affinity[there], answer.spread[there], answer.vote[there], answer.found, answer.state)
    torch.stack([part.sum() for part in parts]).sum().backward()
    for name, part in network.named_parameters():
        assert part.grad is not None and part.grad.isfinite().all(), name


@pytest.mark.parametrize("sizes", [{"width": 10, "heads": 4}, {"heads": 0}, {"width": 0}])
def test_heads_divide_the_width(sizes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=r"got width \d+ and \d heads; expected a width that they divide"):
        NetworkConfig(**sizes)  # type: ignore[arg-type]


@pytest.mark.parametrize("sizes", [{"layers": -1}, {"finest": 0.0}, {"finest": 3.0}, {"widest": math.nan}])
def test_layers_and_widths_are_checked(sizes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected at least 0 layers, and widths that rise from above 0"):
        NetworkConfig(**sizes)  # type: ignore[arg-type]


@pytest.mark.parametrize("radii", [(1.0,), (0.5, 2.0), (1.0, 0.5), (0.0, 1.0)])
def test_radii_rise_and_have_1_among_them(radii: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="expected at least two that rise from above 0, 1 among them"):
        NetworkConfig(radii=radii)
