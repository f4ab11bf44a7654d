"""The line transformer: its answer depends on the candidates of a line and on nothing else."""

from __future__ import annotations

import pytest
import torch

from l2p.features import EDGE, STATE, Edges
from l2p.network import Judgement, LineTransformer, NetworkConfig

LINES, K = 7, 12


@pytest.fixture
def network() -> LineTransformer:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return LineTransformer(NetworkConfig(width=12, layers=2, heads=3)).eval()


@pytest.fixture
def edges() -> Edges:
    draw = torch.Generator().manual_seed(1)
    valid = torch.ones(LINES, K, dtype=torch.bool)
    valid[2, 5:] = False
    valid[3] = False
    return Edges(
        closest=torch.randn(LINES, K, generator=draw),
        foot=torch.randn(LINES, K, generator=draw),
        width=torch.rand(LINES, K, generator=draw) + 0.1,
        feature=torch.randn(LINES, K, len(EDGE), generator=draw),
        state=torch.randn(LINES, K, STATE, generator=draw),
        valid=valid,
        index=torch.arange(K).repeat(LINES, 1).masked_fill(~valid, -1),
    )


def judged(network: LineTransformer, edges: Edges) -> Judgement:
    with torch.inference_mode():
        return network(edges)


def picked(edges: Edges, rows: slice, columns: slice | torch.Tensor = slice(None)) -> Edges:
    return Edges(*(part[rows][:, columns] for part in edges))


def assert_close(one: Judgement, other: Judgement) -> None:
    for name, left, right in zip(one._fields, one, other, strict=True):
        torch.testing.assert_close(left, right, atol=1e-5, rtol=1e-5, msg=lambda text, name=name: f"{name}: {text}")


def test_any_batch_gives_the_same(network: LineTransformer, edges: Edges) -> None:
    single = [judged(network, picked(edges, slice(i, i + 1))) for i in range(LINES)]
    assert_close(judged(network, edges), Judgement(*(torch.cat(parts) for parts in zip(*single, strict=True))))


def test_padding_changes_nothing(network: LineTransformer, edges: Edges) -> None:
    some = picked(edges, slice(2, 3))
    short, padded = judged(network, picked(some, slice(None), slice(0, 5))), judged(network, some)
    trimmed = padded._replace(affinity=padded.affinity[:, :5], vote=padded.vote[:, :5])
    assert_close(short, trimmed)
    assert torch.sigmoid(padded.affinity[:, 5:]).eq(0).all()
    garbage = some._replace(foot=some.foot.masked_fill(~some.valid, 1e6))
    assert_close(padded, judged(network, garbage))


def test_order_of_candidates_changes_nothing(network: LineTransformer, edges: Edges) -> None:
    order = torch.randperm(K, generator=torch.Generator().manual_seed(2))
    one, other = judged(network, edges), judged(network, picked(edges, slice(None), order))
    assert_close(one._replace(affinity=one.affinity[:, order], vote=one.vote[:, order]), other)


def test_a_line_without_candidates_has_a_finite_state(network: LineTransformer, edges: Edges) -> None:
    answer = judged(network, edges)
    assert answer.state[3].isfinite().all() and answer.sure[3].isfinite()


def test_gradients_are_finite(network: LineTransformer, edges: Edges) -> None:
    answer = network.train()(edges)
    (answer.affinity[edges.valid].sum() + answer.vote[edges.valid].sum() + answer.sure.sum()).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


def test_heads_divide_the_width() -> None:
    with pytest.raises(ValueError, match="got width 10 and 4 heads"):
        NetworkConfig(width=10, heads=4)
