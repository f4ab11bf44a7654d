"""What is published beside the lines: likeness, lessons, and an attack that uses them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import knowledge

import l2p
from l2p.attacks.attack import Elements
from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.embedding import OTHER, SOURCES, TAUGHT, Appearances, Embedding, embedded, new_embedding
from l2p.attacks.learned.inputs import GEOMETRY, inputs_of
from l2p.attacks.learned.inputs.likeness import Likeness
from l2p.attacks.learned.knowledge import knowledges
from l2p.attacks.learned.learned import Learned, State
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import LineTransformer, NetworkConfig
from l2p.attacks.learned.teaching import TeachingConfig, contrast, taught
from l2p.attacks.run import run
from l2p.errors import InputError
from l2p.geometry.frame import Frame
from l2p.geometry.nearest import nearest_points_to_lines
from l2p.maps.appearance import Appearance
from l2p.work.work import ALONE, Work

LENGTH = 16
SIZES = NetworkConfig(
    width=8, heads=2, inputs=(*GEOMETRY, "likeness"), length=LENGTH, hidden=12, embedding=6, kind="sift"
)
CONFIG = LearnedConfig(
    rounds=2, alike_rounds=2, candidates=10, alike=24, teaching=TeachingConfig(least=50, batch=64, passes=8.0)
)


@pytest.fixture(scope="module")
def network() -> LineTransformer:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return LineTransformer(SIZES).eval().requires_grad_(False)


@pytest.fixture(scope="module")
def attack(network: LineTransformer) -> Learned:
    return Learned(network, CONFIG)


@pytest.fixture(scope="module")
def hidden(scene_points: np.ndarray) -> l2p.Hiding:
    """A map whose appearances follow the place, as those of real maps do, with noise of their own."""
    rng = np.random.default_rng(0)
    wave = np.sin(scene_points @ rng.normal(size=(3, LENGTH)) + rng.uniform(0, 6, LENGTH))
    descriptor = np.clip(60 + 40 * wave + rng.normal(0, 10, wave.shape), 0, 255).astype(np.uint8)
    rgb = np.clip(128 + 60 * wave[:, :3] + rng.normal(0, 20, (len(wave), 3)), 0, 255).astype(np.uint8)
    return l2p.hide(scene_points, seed=0, rgb=rgb, descriptor=descriptor, descriptor_kind="sift")


def elements_of(lines: l2p.LineCloud) -> Elements:
    frame = Frame.of(lines)
    return Elements.sorted(frame.enter(lines), frame, lines.appearance)


@pytest.fixture(scope="module")
def state(attack: Learned, hidden: l2p.Hiding) -> State:
    with torch.inference_mode():
        return attack.begin(elements_of(hidden.map), None, Work())


# Likeness


def test_likeness_is_the_product_less_half_of_both_backgrounds() -> None:
    draw = torch.Generator().manual_seed(0)
    seen = Appearances(torch.randn(9, 4, generator=draw), torch.randn(9, generator=draw))
    rows, others = torch.tensor([2, 5]), torch.tensor([[0, 1, 2], [8, 5, 3]])
    found = seen.likeness(rows, others)
    for row, i in enumerate(rows.tolist()):
        for column, j in enumerate(others[row].tolist()):
            slow = sum(float(a * b) for a, b in zip(seen.vector[i], seen.vector[j], strict=True))
            slow -= 0.5 * float(seen.background[i] + seen.background[j])
            assert float(found[row, column]) == pytest.approx(slow, abs=1e-5)


def test_the_likeness_of_the_map_as_a_whole_is_1(network: LineTransformer) -> None:
    attributes = {"rgb": torch.rand(300, 3, generator=torch.Generator().manual_seed(0))}
    seen = embedded(network.embedding, attributes, ("rgb",))
    for i in (0, 17, 299):
        ratio = [math.exp(float(seen.vector[i] @ other - seen.background[i])) for other in seen.vector]
        assert np.mean(ratio) == pytest.approx(1, abs=1e-4)


def test_likeness_is_symmetric_and_every_vector_equally_long(state: State) -> None:
    seen = state.elements.attributes["appearance"]
    several = torch.arange(20)
    table = seen.likeness(several, several.expand(20, -1))
    torch.testing.assert_close(table, table.T)
    length = seen.vector.norm(dim=1)
    torch.testing.assert_close(length, length[:1].expand_as(length))


def test_the_length_of_a_descriptor_tells_nothing(network: LineTransformer) -> None:
    descriptor = torch.rand(50, LENGTH, generator=torch.Generator().manual_seed(0)) + 0.1
    one, other = (network.embedding({"descriptor": value}) for value in (descriptor, 7.5 * descriptor))
    torch.testing.assert_close(one, other)


def test_an_absent_attribute_is_not_one_of_zeros(network: LineTransformer) -> None:
    rgb, none = torch.full((4, 3), 0.5), torch.zeros(4, LENGTH)
    alone, both = network.embedding({"rgb": rgb}), network.embedding({"rgb": rgb, "descriptor": none})
    assert not torch.allclose(alone, both)


def test_the_input_is_the_likeness_and_what_it_came_from(attack: Learned, state: State) -> None:
    rows = torch.arange(6)
    chosen = attack.candidates(state)[rows]
    elements = state.elements
    pairs = Candidates(elements.lines, state.nodes, state.posterior, rows, chosen, 0, elements.attributes)
    likeness, *sources = Likeness().of(pairs).columns
    torch.testing.assert_close(likeness, elements.attributes["appearance"].likeness(rows, chosen.long()))
    assert [bool((column == 1).all()) for column in sources] == [True, True, False, False]
    assert SOURCES == ("rgb", "descriptor", OTHER, TAUGHT)


# Candidates


def test_candidates_are_the_nearest_and_most_alike(attack: Learned, state: State) -> None:
    lines, nodes = state.elements.lines, state.nodes
    near = nearest_points_to_lines(lines, nodes.point, CONFIG.alike, scale=nodes.scale.sqrt())
    found = attack.candidates(state)
    seen = state.elements.attributes["appearance"]
    for i in (0, 3, 77):
        score = []
        for j, distance in zip(near.index[i].tolist(), near.distance[i].tolist(), strict=True):
            like = float(seen.likeness(torch.tensor([i]), torch.tensor([[j]])))
            score.append((math.log(distance) - CONFIG.liking * like, j))
        assert {j for _, j in sorted(score)[: CONFIG.candidates]} == set(found[i].tolist())
        order = [near.index[i].tolist().index(j) for j in found[i].tolist()]
        assert order == sorted(order), "candidates are in the order of their distances"


# Lessons


def test_contrast_is_infonce_in_both_directions() -> None:
    draw = torch.Generator().manual_seed(0)
    here, there = torch.randn(5, 3, generator=draw), torch.randn(5, 3, generator=draw)
    slow = 0.0
    for one, other in ((here, there), (there, here)):
        for i in range(5):
            products = [float(one[i] @ other[j]) for j in range(5)]
            slow -= (products[i] - math.log(sum(map(math.exp, products)))) / 10
    assert float(contrast(here, there)) == pytest.approx(slow, abs=1e-5)


@pytest.mark.parametrize("fresh", [False, True])
def test_a_lesson_teaches_what_neighbours_look_like(fresh: bool, hidden: l2p.Hiding, scene_points: np.ndarray) -> None:
    elements = elements_of(hidden.map)
    place = torch.as_tensor(hidden.truth.xyz[elements.row.numpy()]).float()
    published = {name: elements.attributes[name] for name in ("rgb", "descriptor")}
    # The lesson is on one half of the map, the question about the other.
    sure = (torch.arange(len(place)) % 2).float()
    pupil = new_embedding(LENGTH, 12, 6)
    config = TeachingConfig(share=0.5, least=50, batch=64, passes=40.0)
    wise = taught(pupil, published, place, sure, config, fresh)
    asked = torch.arange(0, len(place), 2)
    near = torch.cdist(place[asked], place[asked]).argsort(dim=1)[:, 1:6]
    before, after = (
        embedded(one, {name: value[asked] for name, value in published.items()}, ()) for one in (pupil, wise)
    )
    rows = torch.arange(len(asked))
    assert after.likeness(rows, near).mean() > before.likeness(rows, near).mean() + 0.2


def test_a_lesson_is_the_same_each_time_and_leaves_the_pupil_alone(state: State) -> None:
    published = {"rgb": state.elements.attributes["rgb"]}
    pupil = new_embedding(LENGTH, 12, 6)
    before = {name: value.clone() for name, value in pupil.state_dict().items()}
    torch.manual_seed(1)
    one = taught(pupil, published, state.nodes.point, state.nodes.confidence, CONFIG.teaching)
    torch.manual_seed(2)
    other = taught(pupil, published, state.nodes.point, state.nodes.confidence, CONFIG.teaching)
    for name, value in one.state_dict().items():
        assert torch.equal(value, other.state_dict()[name])
        assert torch.equal(before[name], pupil.state_dict()[name])


def test_few_lines_are_not_learned_from() -> None:
    config = TeachingConfig(share=0.5, least=100, batch=32, steps=1000, fresh_steps=10, passes=4.0)
    assert [config.steps_of(lines, False) for lines in (10, 199, 200, 400)] == [0, 0, 12, 25]
    assert config.steps_of(400, True) == 10


@pytest.mark.parametrize("name", ["neighbors", "least", "batch", "steps"])
def test_lessons_out_of_range_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"got teaching.{name} -1; expected at least"):
        TeachingConfig(**{name: -1})


# The attack


def test_appearance_is_used_and_can_be_left_out(attack: Learned, hidden: l2p.Hiding) -> None:
    lines = hidden.map
    seen = {
        names: run(lines.without(names), attack) for names in ((), ("rgb",), ("descriptor",), ("rgb", "descriptor"))
    }
    assert [found.info["used"] for found in seen.values()] == [["rgb", "descriptor"], ["descriptor"], ["rgb"], []]
    assert len({found.xyz.tobytes() for found in seen.values()}) == 4
    bare = l2p.LineCloud(lines.direction, lines.moment)
    np.testing.assert_array_equal(run(bare, attack).xyz, seen["rgb", "descriptor"].xyz)


def test_the_order_of_the_lines_changes_nothing(attack: Learned, hidden: l2p.Hiding) -> None:
    order = np.random.default_rng(0).permutation(len(hidden.map))
    whole, mixed = run(hidden.map, attack), run(hidden.map.rows(order), attack)
    np.testing.assert_allclose(mixed.xyz, whole.xyz[order], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(mixed.confidence, whole.confidence[order])


def test_a_resumed_attack_ends_with_the_same_points(attack: Learned, hidden: l2p.Hiding) -> None:
    elements = elements_of(hidden.map)
    with torch.inference_mode():
        first = attack.step(attack.begin(elements, None, ALONE), ALONE)
        resumed = attack.begin(elements, attack.saved(first), ALONE)
        assert torch.equal(
            first.elements.attributes["appearance"].vector, resumed.elements.attributes["appearance"].vector
        )
        assert torch.equal(attack.finish(first, ALONE).beta, attack.finish(resumed, ALONE).beta)


@pytest.mark.parametrize(
    ("kind", "rgb", "before", "after"),
    [
        ("sift", True, "rgb+descriptor", "rgb+descriptor"),
        ("sift", False, "descriptor", "descriptor"),
        ("orb", True, "rgb", "rgb+other"),
        ("orb", False, "lines", "other"),
        (None, True, "rgb", "rgb"),
    ],
)
def test_other_descriptors_are_learned_from_the_map(
    kind: str | None, rgb: bool, before: str, after: str, attack: Learned, hidden: l2p.Hiding
) -> None:
    full = hidden.map
    descriptor = None if kind is None else full.descriptor[:, :11]  # type: ignore[index]
    if kind == "sift":
        descriptor = full.descriptor
    appearance = Appearance(full.rgb if rgb else None, descriptor, kind)
    lines = l2p.LineCloud(
        full.direction, full.moment, appearance.rgb, "uniform", appearance.descriptor, appearance.descriptor_kind
    )
    with torch.inference_mode():
        state = attack.begin(elements_of(lines), None, ALONE)
        assert knowledge(state.elements) == before
        state = attack.step(state, ALONE)
    assert knowledge(state.elements) == after
    assert {before, after} <= set(knowledges(attack.network.config))
    assert TAUGHT in state.elements.attributes["appearance"].of


def test_bits_are_compared_bit_by_bit() -> None:
    rng = np.random.default_rng(0)
    bits = rng.integers(0, 256, (40, 4), dtype=np.uint8)
    numbers = rng.integers(0, 120, (40, 4), dtype=np.uint8)
    for kind, value, width in (("orb", bits, 32), ("unknown", bits, 32), ("unknown", numbers, 4), ("sift", bits, 4)):
        found = Appearance(None, value, kind).numbers()
        assert found is not None
        assert found.shape == (40, width), kind
        assert found.dtype == np.float32
    apart = np.abs(Appearance(None, bits, "orb").numbers()[0] - Appearance(None, bits, "orb").numbers()[1]).sum()  # type: ignore[index]
    assert apart == sum(bin(a ^ b).count("1") for a, b in zip(bits[0].tolist(), bits[1].tolist(), strict=True))


def test_descriptors_of_another_length_are_refused(attack: Learned, hidden: l2p.Hiding) -> None:
    full = hidden.map
    lines = l2p.LineCloud(full.direction, full.moment, None, "uniform", full.descriptor[:, :5], "sift")  # type: ignore[index]
    with pytest.raises(InputError, match=r"got descriptors of length 5; expected 16, .* \(--ignore descriptor\)"):
        run(lines, attack)


def test_each_knowledge_has_a_calibration_of_its_own(network: LineTransformer, hidden: l2p.Hiding) -> None:
    identity = [[(1.0, 0.0)] * len(SIZES.radii)] * CONFIG.rounds
    doubtful = [[(1.0, -3.0)] * len(SIZES.radii)] * CONFIG.rounds
    calibration = {known: doubtful if known == "rgb" else identity for known in knowledges(SIZES)}
    attack, plain = Learned(network, CONFIG, calibration), Learned(network, CONFIG)
    colours = hidden.map.without(["descriptor"])
    assert (run(colours, attack).confidence < run(colours, plain).confidence).all()
    np.testing.assert_array_equal(run(hidden.map, attack).confidence, run(hidden.map, plain).confidence)
    del calibration["rgb"]
    with pytest.raises(InputError, match="got 0 calibrations of rgb for 2 rounds; expected as many"):
        Learned(network, CONFIG, calibration)


def test_a_network_of_lines_alone_uses_nothing(scene_points: np.ndarray, hidden: l2p.Hiding) -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = LineTransformer(replace(SIZES, inputs=GEOMETRY))
    attack = Learned(network, CONFIG)
    assert attack.uses(hidden.map.appearance) == ()
    found, bare = run(hidden.map, attack), run(hidden.map.without(["rgb", "descriptor"]), attack)
    np.testing.assert_array_equal(found.xyz, bare.xyz)
    assert knowledges(network.config) == ("lines",)
    assert inputs_of(SIZES.inputs)[-1] == Likeness()


def test_a_new_embedding_is_always_the_same() -> None:
    torch.manual_seed(3)
    one = new_embedding(5, 4, 3)
    torch.manual_seed(4)
    other = new_embedding(5, 4, 3)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    assert isinstance(one, Embedding)


def test_attacks_and_files_agree(attack: Learned, hidden: l2p.Hiding, tmp_path: Path) -> None:
    l2p.save(hidden.map, tmp_path / "lines.npz")
    again = l2p.load(tmp_path / "lines.npz", l2p.LineCloud)
    np.testing.assert_array_equal(run(again, attack).xyz, run(hidden.map, attack).xyz)
