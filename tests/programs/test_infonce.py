"""Training of what an attack makes of colours and descriptors: embeddings, sources, and a start from other weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("hydra", reason="the training program needs the extra train: pip install 'l2p[train]'")
pytest.importorskip("lightning", reason="the training program needs the extra train: pip install 'l2p[train]'")

from test_train import COMMAND, Stop, assert_same_model, facts, settings
from tiny import knowledge

import l2p
from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.checkpoint import Checkpoint
from l2p.attacks.learned.embedding import embedded
from l2p.attacks.learned.inputs import GEOMETRY
from l2p.attacks.learned.knowledge import knowledges
from l2p.attacks.learned.learned import Learned
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import LineTransformer, NetworkConfig
from l2p.attacks.learned.teaching import TeachingConfig
from l2p.attacks.run import run
from l2p.errors import InputError
from train import infonce
from train.clouds import CloudSource, lifted, read
from train.infonce import Embeddings, EmbeddingSettings, fitted, fold_of, mirrored, observed, variance_of
from train.pool import Pool
from train.sources import Sources, validation_sources
from train.start import start_from
from train.train_config import DataSettings
from train.training import EMBEDDINGS, train_all

LENGTH = 12
SIZES = NetworkConfig(width=8, heads=2, inputs=(*GEOMETRY, "likeness"), length=LENGTH, hidden=16, embedding=6)
CONFIG = LearnedConfig(rounds=2, alike_rounds=2, candidates=10, alike=16, teaching=TeachingConfig(least=50, batch=64))
SHORT = EmbeddingSettings(steps=60, batch=64, folds=2)
ALL_INPUTS = f"network.inputs=[{','.join(SIZES.inputs)}]"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four maps whose colours and descriptors follow the place; one has colours alone."""
    place = tmp_path_factory.mktemp("maps")
    for number, name in enumerate(("ash", "birch", "cedar", "dale")):
        rng = np.random.default_rng(number)
        xyz = rng.normal(size=(260, 3))
        wave = np.sin(2 * xyz @ np.random.default_rng(9).normal(size=(3, LENGTH)))
        single = rng.normal(0, 0.2, (3, 260, LENGTH)) + wave + 2
        mean = (single / np.linalg.norm(single, axis=2, keepdims=True)).mean(axis=0)
        arrays = {
            "xyz": xyz,
            "rgb": np.clip(128 + 60 * wave[:, :3], 0, 255).astype(np.uint8),
            "track_length": np.full(260, 3),
        }
        if name != "dale":
            arrays |= {"descriptor": mean.astype(np.float32), "descriptor_kind": np.array("sift")}
        np.savez(place / f"{name}.npz", **arrays)
    return place


def data_of(folder: Path, **changes: object) -> DataSettings:
    return replace(
        DataSettings(
            seed=0,
            scheme="uniform",
            scenes=[],
            maps=[str(folder)],
            map_turns=2,
            absent=0.35,
            simulated=1,
            simulated_points=[120, 200],
            val=["sim:room:150:1"],
            val_maps=[str(folder / "ash.npz")],
            val_fractions=[1.0],
            min_lines=100,
            max_lines=260,
        ),
        **changes,
    )


# Sources


def test_every_attribute_is_sometimes_left_out(folder: Path) -> None:
    sources = Sources.of(data_of(folder))
    drawn = [sources[number] for number in range(1400)]
    maps = [source for source in drawn if "birch" in source.scene]
    assert len(maps) == 400, "twice in a turn of seven"
    for name in ("rgb", "descriptor"):
        assert np.mean([name in source.known for source in maps]) == pytest.approx(0.65, abs=0.08)
    assert {source.known for source in maps} == {(), ("rgb",), ("descriptor",), ("rgb", "descriptor")}
    assert np.mean([source.observed for source in maps]) == pytest.approx(0.5, abs=0.08)
    assert np.mean([source.unknown for source in maps]) == pytest.approx(0.25, abs=0.08)
    assert {source.known for source in drawn if "dale" in source.scene} == {(), ("rgb",)}
    assert {source.known for source in drawn if "sim:" in source.scene} == {()}
    assert not [source for source in drawn if "ash" in source.scene]


def test_held_back_maps_are_judged_by_every_attacker(folder: Path) -> None:
    sources = [source for source in validation_sources(data_of(folder)) if "ash" in source.scene]
    found = [(*source.known, source.unknown) for source in sources]
    assert sorted(found, key=str) == sorted(
        [(False,), ("rgb", False), ("descriptor", False), ("descriptor", True)]
        + [("rgb", "descriptor", unknown) for unknown in (False, True)],
        key=str,
    )


# Descriptors


def test_the_variance_of_observations_follows_from_the_length_of_their_mean() -> None:
    rng = np.random.default_rng(0)
    for count, noise in ((2, 0.02), (5, 0.05), (30, 0.05)):
        centre = np.abs(rng.normal(size=(4000, 1, 64)))
        single = centre / np.linalg.norm(centre, axis=2, keepdims=True)
        single = np.concatenate([single + noise * rng.normal(size=(4000, count, 64))])
        single /= np.linalg.norm(single, axis=2, keepdims=True)
        mean = single.mean(axis=1)
        # One point whose observations are all equal shows how long a single one is.
        mean = np.concatenate([mean, single[:1, 0]])
        scene = l2p.Scene(np.zeros((4001, 3)), track_length=np.full(4001, count, dtype=np.int32), descriptor=500 * mean)
        true = 1 - np.square(single.mean(axis=1) * np.sqrt(count / (count - 1))).sum(axis=1)
        spread = np.square(single - single.mean(axis=1, keepdims=True)).sum(axis=2).sum(axis=1) / (count - 1)
        assert float(variance_of(scene)[:-1].mean()) == pytest.approx(spread.mean(), rel=0.02), (count, true.mean())
        assert float(variance_of(scene)[-1]) == pytest.approx(0, abs=1e-5)


def test_an_observation_is_a_unit_vector_about_the_mean() -> None:
    draw = torch.Generator().manual_seed(0)
    mean = torch.rand(500, 128, generator=draw) + 0.2
    variance = torch.full((500,), 0.06)
    one = observed(mean, variance, draw)
    torch.testing.assert_close(one.norm(dim=1), torch.ones(500))
    assert (one >= 0).all()
    cosine = (one * torch.nn.functional.normalize(mean, dim=1)).sum(dim=1).mean()
    assert float(cosine) == pytest.approx((1 + 0.06) ** -0.5, abs=0.01)
    torch.testing.assert_close(observed(mean, 0 * variance, draw), torch.nn.functional.normalize(mean, dim=1))


# Embeddings


@pytest.fixture(scope="module")
def embeddings(folder: Path) -> Embeddings:
    return fitted({path.stem: read(str(path)) for path in sorted(folder.iterdir())}, SIZES, SHORT, seed=0)


def test_maps_are_embedded_by_what_did_not_see_them(embeddings: Embeddings, folder: Path) -> None:
    scenes = {path.stem: read(str(path)) for path in folder.iterdir()}
    fold = fold_of("birch", 2)
    others = {name: scene for name, scene in scenes.items() if fold_of(name, 2) != fold}
    assert len(others) < len(scenes)
    # Other descriptors of the map itself change what all maps teach, and not what the others do.
    changed = {**scenes, "birch": replace(scenes["birch"], descriptor=scenes["birch"].descriptor[::-1].copy())}  # type: ignore[index]
    again = fitted(changed, SIZES, SHORT, seed=0)
    for one, other, same in (
        (embeddings.whole, again.whole, False),
        (embeddings.blind_to("x/birch.npz"), again.blind_to("birch"), True),
    ):
        equal = all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
        assert equal is same


def test_the_order_of_the_scenes_changes_nothing(embeddings: Embeddings, folder: Path) -> None:
    scenes = {path.stem: read(str(path)) for path in sorted(folder.iterdir(), reverse=True)}
    again = fitted(scenes, SIZES, SHORT, seed=0)
    assert all(torch.equal(a, b) for a, b in zip(embeddings.whole.parameters(), again.whole.parameters(), strict=True))


def test_neighbours_are_more_alike_also_on_another_map(embeddings: Embeddings, folder: Path) -> None:
    scene = read(str(folder / "ash.npz"))
    attributes = {"descriptor": torch.as_tensor(scene.descriptor)}
    seen = embedded(embeddings.blind_to("ash"), attributes, ("descriptor",))
    place = torch.as_tensor(scene.xyz)
    near = torch.cdist(place, place).argsort(dim=1)
    rows = torch.arange(len(place))
    assert seen.likeness(rows, near[:, 1:6]).mean() > seen.likeness(rows, near[:, 100:]).mean() + 0.3


def test_what_is_saved_is_loaded(embeddings: Embeddings, tmp_path: Path) -> None:
    infonce.save(embeddings, tmp_path / "embeddings")
    again = infonce.load(tmp_path / "embeddings", SIZES)
    assert len(again.folds) == 2
    for one, other in zip((embeddings.whole, *embeddings.folds), (again.whole, *again.folds), strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


# Clouds


@pytest.fixture(scope="module")
def attack() -> Learned:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Learned(LineTransformer(SIZES).eval().requires_grad_(False), CONFIG)


@pytest.mark.parametrize("unknown", [False, True])
def test_a_cloud_has_what_its_source_says(unknown: bool, attack: Learned, embeddings: Embeddings, folder: Path) -> None:
    scene = str(folder / "birch.npz")
    source = CloudSource(scene, 0.8, 3, ("descriptor",), observed=True, unknown=unknown)
    cloud = lifted(source, attack, embeddings)
    assert cloud.elements.attributes["descriptor"].shape == (208, LENGTH)
    assert knowledge(cloud.elements) == ("lines" if unknown else "descriptor")
    assert "rgb" not in cloud.elements.attributes
    mean = lifted(replace(source, observed=False), attack, embeddings)
    assert not torch.equal(mean.elements.attributes["descriptor"], cloud.elements.attributes["descriptor"])
    if not unknown:
        assert cloud.embedding is embeddings.blind_to("birch")


def test_a_stored_pool_goes_on_as_it_would_have(attack: Learned, embeddings: Embeddings, folder: Path) -> None:
    """Also after a lesson."""
    sources = Sources.of(data_of(folder, absent=0.0, simulated=0))
    pool = Pool(sources, attack, 1, seed=0, embeddings=embeddings)
    for _ in range(8):
        sample, rows = pool.draw(40)
        judgement = attack.network(sample.edges)
        pool.keep(rows, torch.zeros(len(judgement.found)), judgement)
    assert pool.entries[0].round == 1
    again = Pool(sources, attack, 1, seed=0, embeddings=embeddings)
    again.load_state_dict(pool.state_dict())
    one, other = pool.draw(40)[0], again.draw(40)[0]
    assert torch.equal(one.edges.likeness, other.edges.likeness)
    assert one.edges.likeness.abs().max() > 0


# Starting from other weights


def test_a_network_starts_as_the_one_it_starts_from(tmp_path: Path, scene_points: np.ndarray) -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        old, new = LineTransformer(replace(SIZES, inputs=GEOMETRY)), LineTransformer(SIZES)
    identity = {"lines": [[(1.0, 0.0)] * len(SIZES.radii)] * 2}
    checkpoint.save(tmp_path / "old.safetensors", Checkpoint(old, CONFIG, identity))
    start_from(new, tmp_path / "old.safetensors")
    rgb = np.random.default_rng(0).integers(0, 256, (len(scene_points), 3)).astype(np.uint8)
    lines = l2p.lift(scene_points, seed=0, rgb=rgb)
    before, after = run(lines, Learned(old, CONFIG)), run(lines.without(["rgb"]), Learned(new, CONFIG))
    np.testing.assert_allclose(after.xyz, before.xyz, atol=1e-6)
    np.testing.assert_allclose(after.confidence, before.confidence, atol=1e-6)


@pytest.mark.parametrize("other", [{"width": 12}, {"inputs": (*GEOMETRY[:-1],)}, {"state": 5}])
def test_a_start_from_another_kind_of_network_is_refused(other: dict, tmp_path: Path) -> None:
    identity = {"lines": [[(1.0, 0.0)] * len(SIZES.radii)] * 2}
    old = LineTransformer(replace(SIZES, inputs=GEOMETRY))
    checkpoint.save(tmp_path / "old.safetensors", Checkpoint(old, CONFIG, identity))
    with pytest.raises(
        InputError, match="unlike the network to train; expected the same sizes, and some of its inputs"
    ):
        start_from(LineTransformer(replace(SIZES, **{"inputs": GEOMETRY, **other})), tmp_path / "old.safetensors")


# A run


def run_settings(folder: Path, *more: str):
    return settings(
        f"maps=[{folder}]", f"val_maps=[{folder / 'ash.npz'}]", "simulated=1", "val=[]", "map_turns=1", ALL_INPUTS,
        f"network.length={LENGTH}", "network.hidden=16", "network.embedding=6", "embedding.steps=20",
        "embedding.batch=64", "embedding.folds=2", "learned.teaching.least=50", "learned.teaching.batch=64",
        "learned.alike=20", "learned.alike_rounds=3", *more,
    )  # fmt: skip


def test_a_run_with_maps_ends_with_a_model_for_every_knowledge(folder: Path, tmp_path: Path) -> None:
    model = train_all(run_settings(folder), tmp_path / "run", COMMAND)
    attack = checkpoint.load(model)
    assert set(attack.calibration) == set(knowledges(attack.network.config))
    found = facts(tmp_path / "run")
    assert {row["known"] for row in found["results"]} == set(knowledges(attack.network.config))
    scenes = {name.split("/")[-1] for name in found["scenes"]}
    assert {"birch.npz", "cedar.npz", "dale.npz"} <= scenes and "ash.npz" not in scenes
    whole = infonce.load(tmp_path / "run" / EMBEDDINGS, attack.network.config).whole
    for one, other in zip(attack.network.embedding.parameters(), whole.parameters(), strict=True):
        assert torch.equal(one, other), "the embedding is not trained with the network"
    # Stopped and continued, it ends the same.
    with pytest.raises(OSError, match="switched off"):
        train_all(run_settings(folder), tmp_path / "again", COMMAND, [Stop(7)])
    train_all(run_settings(folder), tmp_path / "again", COMMAND)
    assert_same_model(tmp_path / "run", tmp_path / "again")
    # Without steps, the weights that it starts from get another embedding, and the record tells of the first training.
    fresh = train_all(run_settings(folder, "steps=0", f"start={model}", "seed=5"), tmp_path / "fresh", COMMAND)
    new = checkpoint.load(fresh).network
    for name, value in attack.network.state_dict().items():
        assert torch.equal(value, new.state_dict()[name]) != name.startswith("embedding."), name
    assert [each["steps"] for each in facts(tmp_path / "fresh")["before"]] == [found["steps"]]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("absent=1.5", r"got absent 1.5; expected a chance in \[0, 1\]"),
        ("map_turns=0", "got map_turns 0; expected at least 1"),
        ("network.embedding=0", "got length 128, hidden 256, embedding 0; expected at least 1"),
        ("learned.teaching.batch=1", "got teaching.batch 1; expected at least 2"),
        ("embedding.steps=-1", "got embedding.steps -1; expected at least 0"),
        ("embedding.batch=1", "got embedding.batch 1; expected at least 2"),
    ],
)
def test_values_out_of_range_are_refused(override: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        settings(override)


def test_the_experiments_compose() -> None:
    made = settings(experiment="appearance")
    assert made.network.appearance and made.data.maps and made.start
    assert set(made.data.val_maps).isdisjoint(made.data.maps)


def test_a_mirrored_descriptor_is_that_of_the_mirrored_patch() -> None:
    patch = np.random.default_rng(0).normal(size=(16, 16))
    here, there = (torch.tensor(_histograms(each), dtype=torch.float32)[None] for each in (patch, patch[::-1]))
    torch.testing.assert_close(mirrored(here), there)
    torch.testing.assert_close(mirrored(mirrored(here)), here)


def test_the_mean_descriptor_of_real_maps_is_its_own_mirror_image(shared: Path) -> None:
    scenes = [read(str(each)) for each in sorted((shared / "maps" / "train").iterdir())[:3]]
    rows = [scene.descriptor for scene in scenes if scene.descriptor is not None]
    mean = torch.tensor(np.concatenate(rows).mean(axis=0, keepdims=True))
    turned = mean.reshape(4, 4, 8).flip(1)[..., -torch.arange(8) % 8].reshape(1, -1)  # columns in place of rows
    apart, other = ((each - mean).norm() / mean.norm() for each in (mirrored(mean), turned))
    assert apart < 0.02 < other


def _histograms(patch: np.ndarray) -> np.ndarray:
    """Gradients of a patch of 16 x 16 pixels, by cell and direction: SIFT without weights and interpolation."""
    down, right = np.gradient(patch)
    direction = np.round(np.arctan2(down, right) / (2 * np.pi / 8)).astype(int) % 8
    found = np.zeros((4, 4, 8))
    for row in range(16):
        for column in range(16):
            found[row // 4, column // 4, direction[row, column]] += np.hypot(down, right)[row, column]
    return found.reshape(-1)
