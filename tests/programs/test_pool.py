"""What the network is trained on: the sources of line clouds, the clouds, and the pool that goes through the rounds."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("hydra", reason="the training program needs the extra train: pip install 'l2p[train]'")


import l2p
from l2p.attacks.learned.learned import Learned, weighted_peak
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import LineTransformer, NetworkConfig
from l2p.errors import InputError
from l2p.geometry.frame import Frame
from l2p.judging.accuracy import spacing
from train.clouds import CloudSource, lifted
from train.losses import Sample
from train.pool import Entry, Pool
from train.sources import Sources, validation_sources
from train.train_config import DataSettings

DATA = DataSettings(
    seed=0,
    scheme="uniform",
    scenes=[],
    maps=[],
    map_turns=1,
    absent=0.35,
    val_maps=[],
    simulated=3,
    simulated_points=[120, 200],
    val=["sim:room:150:1"],
    val_fractions=[1.0, 0.5],
    min_lines=40,
    max_lines=150,
)
CONFIG = LearnedConfig(rounds=3, candidates=12)


@pytest.fixture(scope="module")
def sources() -> Sources:
    return Sources.of(DATA)


@pytest.fixture(scope="module")
def network() -> LineTransformer:
    """Frozen, with random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return LineTransformer(NetworkConfig(width=8, layers=1, heads=2)).eval().requires_grad_(False)


@pytest.fixture(scope="module")
def attack(network: LineTransformer) -> Learned:
    return Learned(network, CONFIG)


def lines_of(sources: Sources, number: int) -> tuple[int, int]:
    """Lines of a source, and points of its scene."""
    source = sources[number]
    points = {scene.source: scene.points for scene in sources.scenes}[source.scene]
    return max(1, round(points * source.fraction)), points


# Sources


def test_sources_are_endless_and_the_same_each_time(sources: Sources) -> None:
    again = Sources.of(DATA)
    for number in (0, 1, 7, 10**6):
        assert sources[number] == again[number]
    assert len({(sources[number].scene, sources[number].seed) for number in range(60)}) == 60
    other = Sources.of(replace(DATA, seed=1))
    assert [other[number] for number in range(5)] != [sources[number] for number in range(5)]


def test_scenes_come_in_turns_in_another_order_each_time(sources: Sources) -> None:
    turns = [[sources[3 * turn + place].scene for place in range(3)] for turn in range(8)]
    assert all(sorted(turn) == sorted(scene.source for scene in sources.scenes) for turn in turns)
    assert len({tuple(turn) for turn in turns}) > 1


def test_lines_of_thinned_clouds_are_spread_evenly_over_all_sizes() -> None:
    sources = Sources.of(replace(DATA, simulated=8, simulated_points=[100, 9000], max_lines=1000, min_lines=120))
    lines, points = np.array([lines_of(sources, number) for number in range(1600)]).T
    most = np.minimum(points, 1000)
    assert (np.minimum(most, 120) <= lines).all() and (lines <= most).all()
    assert (most < 120).any()
    lines = lines[most == 1000]
    assert 0.1 < np.mean(lines == 1000) < 0.3
    fewer = lines[lines < 1000]
    middle = np.sqrt(120 * 1000)
    assert abs(fewer[fewer < middle].sum() / fewer.sum() - 0.5) < 0.1


@pytest.fixture
def folder(tmp_path: Path, scene_points: np.ndarray) -> Path:
    """Three scenes in files."""
    for number, name in enumerate(("bell", "cup", "wood")):
        np.savez(tmp_path / f"{name}.npz", xyz=scene_points[number:])
    return tmp_path


def test_held_back_scenes_are_never_trained_on(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However they are named."""
    monkeypatch.chdir(folder)
    data = replace(DATA, scenes=[str(folder), "sim:room:150:1"], val=["cup.npz", "sim:room:150:1"], simulated=1)
    sources = Sources.of(data)
    trained = {sources[number].scene for number in range(20)}
    assert {Path(scene).name for scene in trained if "sim:" not in scene} == {"bell.npz", "wood.npz"}
    assert len(trained) == 3 and "sim:room:150:1" not in trained
    assert {source.scene for source in validation_sources(data)} == {str(folder / "cup.npz"), "sim:room:150:1"}


def test_scenes_that_are_all_held_back_are_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="got 3 val scenes, and no others to train on"):
        Sources.of(replace(DATA, scenes=[str(folder)], val=[str(folder)], simulated=0))


def test_held_back_clouds_are_cut_to_the_most_lines() -> None:
    data = replace(DATA, val=["sim:room:150:1", "sim:object:400:1"], val_fractions=[1.0, 0.9, 0.1])
    found = [(source.name, source.fraction, source.seed) for source in validation_sources(data)]
    assert found == [(name, fraction, 0) for name, fraction in [
        ("sim:room:150:1", 1.0), ("sim:room:150:1", 0.9), ("sim:room:150:1", 0.1),
        ("sim:object:400:1", 0.375), ("sim:object:400:1", 0.1),
    ]]  # fmt: skip


# Clouds


def test_the_truth_of_a_cloud_is_that_of_its_scene(attack: Learned) -> None:
    cloud = lifted(CloudSource("sim:room:200:0", 0.5, 3), attack)
    points = l2p.simulate("room", 200, 0).xyz
    hidden = l2p.hide(points, 3, 0.5)
    lines, index = hidden.map, hidden.truth.index
    frame = Frame.of(lines)
    truth = points[index]
    true_point = cloud.elements.lines.at(cloud.true_beta)
    np.testing.assert_allclose(true_point.numpy(), frame.enter_points(truth).numpy(), atol=1e-5)
    assert cloud.spacing * frame.unit == pytest.approx(spacing(truth))
    nearest = np.sort(np.linalg.norm(truth[:, None] - truth, axis=2), axis=1)
    np.testing.assert_allclose(cloud.radius.numpy() * frame.unit, nearest[:, 25], rtol=1e-5)


def test_samples_count_from_the_estimates_and_label_true_neighbours(attack: Learned) -> None:
    cloud = lifted(CloudSource("sim:room:200:0", 1.0, 3), attack)
    nodes, rows = cloud.first_nodes, torch.tensor([5, 90, 150])
    candidates = attack.candidates(cloud.state())
    sample = cloud.sample(attack, cloud.state(), candidates, rows)
    torch.testing.assert_close(sample.true_beta + nodes.beta[rows], cloud.true_beta[rows])
    truth = cloud.elements.lines.at(cloud.true_beta)
    assert (sample.spacing == torch.tensor(cloud.spacing)).all()
    for row, i in enumerate(rows.tolist()):
        for column, j in enumerate(candidates[i].tolist()):
            apart = float((truth[i] - truth[j]).norm() / cloud.radius[i])
            assert float(sample.label[row, column]) == pytest.approx(1 / (1 + np.exp((apart - 1.25) / 0.25)), abs=1e-5)


# The pool


def steps(pool: Pool, network: LineTransformer, lines: int = 32) -> Iterator[tuple[Sample, list[torch.Tensor]]]:
    """What training does with the pool, without learning; what is drawn, after it is kept."""
    while True:
        sample, rows = pool.draw(lines)
        judgement = network(sample.edges)
        pool.keep(rows, weighted_peak(judgement, pool.attack.config), judgement)
        yield sample, rows


def ended(pool: Pool, network: LineTransformer, place: int, count: int) -> list[tuple[Entry, list[int], Entry]]:
    """The rounds that end in one place of the pool: the entry before, the rows drawn of it, the entry after."""
    found, entry, drawn = [], pool.entries[place], []
    for _, rows in steps(pool, network):
        drawn += rows[place].tolist()
        if pool.entries[place] is not entry:
            found.append((entry, drawn, pool.entries[place]))
            entry, drawn = pool.entries[place], []
        if len(found) == count:
            return found
    return []


def test_every_line_of_a_cloud_is_drawn_once_a_round(
    sources: Sources, network: LineTransformer, attack: Learned
) -> None:
    rounds = ended(Pool(sources, attack, 2, seed=0), network, place=1, count=7)
    for before, drawn, _ in rounds:
        assert sorted(drawn) == list(range(len(before.nodes.beta)))
    orders = [drawn for before, drawn, _ in rounds if before.number == 1]
    assert len(orders) == 3 and orders[0] != orders[1] != orders[2]
    assert [(before.round, after.round) for before, _, after in rounds[:3]] == [(0, 1), (1, 2), (2, 0)]
    assert rounds[2][2].number not in (0, 1), "the next cloud that nobody has had"


def test_the_state_before_a_round_is_what_the_round_before_found(
    sources: Sources, network: LineTransformer, attack: Learned
) -> None:
    """As in the attack itself, though lines come in another order and with those of other clouds."""
    rounds = ended(Pool(sources, attack, 2, seed=0), network, place=0, count=3)
    for before, _, after in rounds[:2]:
        cloud = before.cloud
        assert after.cloud is cloud
        state = cloud.state(before.nodes)
        found = attack.judge(state)
        state = attack.next(state, found)
        nodes = state.nodes
        for name, left, right in zip(nodes._fields, nodes, after.nodes, strict=True):
            torch.testing.assert_close(left, right, atol=1e-5, rtol=1e-5, msg=lambda text, name=name: f"{name}: {text}")
        torch.testing.assert_close(found.found, before.found, atol=1e-5, rtol=1e-5)
        assert torch.equal(attack.candidates(state), after.candidates)
        assert not torch.equal(before.nodes.beta, after.nodes.beta)
    fresh = rounds[2][2]
    torch.testing.assert_close(fresh.nodes, fresh.cloud.first_nodes)


def stored(state: dict[str, Any]) -> dict[str, Any]:
    """Through a file, as Lightning does it."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize("after", [0, 2, 7, 11])
def test_a_stored_pool_goes_on_as_it_would_have(
    sources: Sources, network: LineTransformer, attack: Learned, after: int
) -> None:
    """From the middle of a round, and later clouds."""
    pool = Pool(sources, attack, 2, seed=0)
    for _ in islice(steps(pool, network), after):
        pass
    state = stored(pool.state_dict())
    other = Pool(sources, attack, 2, seed=0)
    other.load_state_dict(state)
    for (one, rows), (two, again) in islice(zip(steps(pool, network), steps(other, network), strict=True), 12):
        assert all(torch.equal(left, right) for left, right in zip(rows, again, strict=True))
        for left, right in zip((*one.edges, *one[1:]), (*two.edges, *two[1:]), strict=True):
            assert torch.equal(left, right)
    assert pool.drawn == other.drawn > 2


def test_a_loaded_pool_does_not_write_to_what_it_was_loaded_from(
    sources: Sources, network: LineTransformer, attack: Learned
) -> None:
    pool = Pool(sources, attack, 1, seed=0)
    next(steps(pool, network))
    state = stored(pool.state_dict())
    kept = [part.clone() for part in state["entries"][0]["found"]]
    pool.load_state_dict(state)
    next(steps(pool, network))
    assert all(torch.equal(left, right) for left, right in zip(kept, state["entries"][0]["found"], strict=True))


def test_processes_share_the_sources_without_overlap(
    sources: Sources, network: LineTransformer, attack: Learned
) -> None:
    numbers: list[list[int]] = []
    for rank in range(3):
        pool = Pool(sources, Learned(network, replace(CONFIG, rounds=1)), 2, seed=0, rank=rank, ranks=3)
        seen = [entry.number for entry in pool.entries]
        for _ in islice(steps(pool, network, lines=64), 6):
            seen += [entry.number for entry in pool.entries if entry.number not in seen]
        numbers.append(seen)
        assert seen == [rank + 3 * turn for turn in range(len(seen))] and len(seen) > 4
    assert len({number for seen in numbers for number in seen}) == sum(map(len, numbers))


def test_clouds_with_fewer_candidates_are_padded(network: LineTransformer, attack: Learned) -> None:
    """A line gets the same judgement as in a batch of its own."""
    sources = Sources.of(replace(DATA, min_lines=3))
    pool = Pool(sources, attack, 8, seed=0)
    widths = [entry.candidates.shape[1] for entry in pool.entries]
    assert min(widths) < max(widths) == 12
    sample, rows = pool.draw(16)
    whole, begin = network(sample.edges), 0
    for entry, part in zip(pool.entries, rows, strict=True):
        alone = entry.cloud.sample(attack, entry.state, entry.candidates, part)
        k, here = alone.label.shape[1], slice(begin, begin + len(part))
        begin += len(part)
        assert not sample.edges.valid[here, k:].any()
        assert torch.equal(sample.label[here, :k], alone.label)
        own = network(alone.edges)
        torch.testing.assert_close(whole.found[here], own.found, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(whole.vote[here, :k], own.vote, atol=1e-5, rtol=1e-5)
    assert begin == len(sample.true_beta)
