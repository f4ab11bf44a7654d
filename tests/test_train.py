"""The training program: through the real configs, on one tiny simulated scene."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("hydra", reason="the training program needs the extra train: pip install 'l2p[train]'")
pytest.importorskip("lightning", reason="the training program needs the extra train: pip install 'l2p[train]'")

import lightning
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from safetensors.torch import load_file

import l2p
from l2p import checkpoint
from l2p.attack import run as attack
from l2p.errors import InputError
from l2p.features import EDGE, STATE, Edges
from l2p.network import Judgement
from train.clouds import CloudSource, prepare
from train.config import CONFIGS, Settings, settings_of
from train.judging import calibrate
from train.losses import Sample, affinity_loss, position_loss, soft_labels
from train.program import train_all
from train.sources import training_sources, validation_sources
from train.states import StateStore


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One cache for all tests: lifting is no part of what they are about."""
    return tmp_path_factory.mktemp("cache")


def settings(cache: Path, *overrides: str) -> Settings:
    """The real config, composed as the command line does."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return settings_of(compose("train", ["experiment=debug", f"cache={cache}", *overrides]))


@pytest.fixture(scope="module")
def trained(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an uninterrupted debug run."""
    folder = tmp_path_factory.mktemp("run")
    assert train_all(settings(cache), folder, "python -m train") == folder / "model.safetensors"
    return folder


class Stop(lightning.Callback):
    """Fails like a machine that is switched off, after a step of a round."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: object) -> None:
        if trainer.global_step == self.step:
            raise OSError("switched off")


class Steps(lightning.Callback):
    """Counts the steps that are done."""

    count = 0

    def on_train_batch_end(self, *_: object) -> None:
        self.count += 1


def assert_same_model(one: Path, other: Path) -> None:
    left, right = load_file(one), load_file(other)
    assert left.keys() == right.keys()
    for name, value in left.items():
        assert torch.equal(value, right[name]), name


def test_a_run_leaves_a_model_its_log_and_its_facts(trained: Path) -> None:
    facts = json.loads((trained / "results.json").read_text())
    assert {"command", "commit", "versions", "machine", "seed", "scenes", "rounds", "config"} <= set(facts)
    assert [part["steps"] for part in facts["rounds"]] == [8, 8]
    assert {"median", "within", "confident_half", "calibration_error"} <= set(facts["rounds"][1]["results"][0])
    assert checkpoint.read(trained / "model.safetensors").facts == facts
    assert (trained / "config.yaml").is_file()
    with (trained / "round1" / "figures.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {"train/affinity", "train/position", "train/sure", "train/probe", "val/score", "val/median"} <= {
        row["figure"] for row in rows
    }
    assert list((trained / "round0").glob("events.*"))


def test_the_model_recovers_points(trained: Path, scene_points: np.ndarray) -> None:
    recovery = attack(l2p.lift(scene_points, seed=0), checkpoint.load(trained / "model.safetensors"))
    assert np.isfinite(recovery.xyz).all()
    assert recovery.info["settings"]["rounds"] == 2


@pytest.mark.parametrize(("step", "saved"), [(2, 0), (4, 3), (7, 6)])
def test_a_resumed_run_ends_with_the_same_weights(
    trained: Path, cache: Path, tmp_path: Path, step: int, saved: int
) -> None:
    with pytest.raises(OSError, match="switched off"):
        train_all(settings(cache), tmp_path, "python -m train", [Stop(step)])
    assert not (tmp_path / "round0.safetensors").exists()
    steps = Steps()
    train_all(settings(cache), tmp_path, "python -m train", [steps])
    assert steps.count == (8 - saved) + 8
    assert_same_model(trained / "model.safetensors", tmp_path / "model.safetensors")


def test_finished_rounds_are_not_trained_again(
    trained: Path, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("config.yaml", "round0.safetensors", "round1.safetensors"):
        (tmp_path / name).write_bytes((trained / name).read_bytes())
    monkeypatch.setattr("train.program._train_round", None)
    train_all(settings(cache), tmp_path, "python -m train")
    assert_same_model(trained / "model.safetensors", tmp_path / "model.safetensors")


def test_a_run_is_not_continued_with_another_config(trained: Path, cache: Path) -> None:
    with pytest.raises(InputError, match="was started with another seed; give name=ANOTHER"):
        train_all(settings(cache, "seed=1"), trained, "python -m train")


def test_time_ends_a_round(cache: Path, tmp_path: Path) -> None:
    train_all(settings(cache, "rounds=1", "steps=100000", "minutes=1e-6"), tmp_path, "python -m train")
    assert json.loads((tmp_path / "results.json").read_text())["rounds"][0]["steps"] == 1


def test_a_round_that_does_not_improve_is_stopped(cache: Path, tmp_path: Path) -> None:
    idle = ["rounds=1", "learning_rate=0.0", "validate_every=1", "patience=2"]
    train_all(settings(cache, *idle), tmp_path, "python -m train")
    assert json.loads((tmp_path / "results.json").read_text())["rounds"][0]["steps"] == 3


@pytest.mark.parametrize("override", ["nonsense=1", "network.nonsense=1", "round.peak.nonsense=1", "steps=many"])
def test_unknown_keys_and_other_types_are_errors(cache: Path, override: str) -> None:
    with pytest.raises((HydraException, OmegaConfBaseException)):
        settings(cache, override)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("simulated=0", "got no scenes and no simulated ones"),
        ("steps=0", "got steps 0; expected at least 1"),
        ("val=[]", "got no val scenes"),
        ("max_lines=10", "got max_lines 10; expected at least min_lines, 50"),
        ("total_lines=10", "got total_lines 10; expected at least max_lines"),
        ("val_fractions=[0.0]", "got val fraction 0.0"),
        ("simulated_points=[5]", r"got simulated_points \[5\]"),
        ("averaging=1.0", "got averaging 1.0"),
        ("network.width=9", "got width 9 and 2 heads"),
    ],
)
def test_values_out_of_range_are_refused(cache: Path, override: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        settings(cache, override)


def test_a_missing_folder_is_named(cache: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        train_all(settings(cache, f"scenes=[{tmp_path / 'nowhere'}]"), tmp_path / "run", "python -m train")


def test_the_command_line_ends_with_a_sentence(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "train", "experiment=debug", "val=[]", f"run={tmp_path / 'run'}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=CONFIGS.parent, timeout=120)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("train: got no val scenes")


def test_shipped_experiment_composes(cache: Path) -> None:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        made = settings_of(compose("train", ["experiment=shipped"]))
    assert made.rounds == 3 and made.round.peak == l2p.learned.RoundConfig().peak


def test_scenes_are_lifted_thinly_and_densely(cache: Path) -> None:
    data = settings(cache, "simulated=5", "liftings=3", "simulated_points=[300,2000]", "max_lines=1000").data
    sources = training_sources(data)
    assert len({(source.scene, source.seed) for source in sources}) == 15
    lines = [source.fraction * int(source.scene.split(":")[2]) for source in sources]
    assert min(lines) >= 49 and max(lines) <= 1001
    assert training_sources(data) == sources
    assert [source.fraction for source in validation_sources(data)] == [1.0]


def test_clouds_are_drawn_until_the_total_is_reached(cache: Path) -> None:
    few = ["simulated=5", "liftings=3", "simulated_points=[300,2000]", "max_lines=1000"]
    everything = training_sources(settings(cache, *few).data)
    drawn = training_sources(settings(cache, *few, "total_lines=3000").data)
    lines = [source.fraction * int(source.scene.split(":")[2]) for source in drawn]
    assert 2000 < sum(lines) <= 3001 and set(drawn) < set(everything)


def test_states_are_kept_on_disk(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = StateStore(tmp_path, settings(cache).round)
    source = CloudSource("sim:room:100:0", 1.0, 0)
    state = store.state(source, [])
    monkeypatch.setattr("train.states.first_nodes", None)
    monkeypatch.setattr("train.clouds.reconstruct", None)
    again = store.state(source, [])
    for left, right in zip(state.nodes, again.nodes, strict=True):
        assert torch.equal(left, right)
    assert torch.equal(state.candidates, again.candidates)
    assert not list(tmp_path.rglob("*.part"))


def test_the_truth_of_a_cloud_is_that_of_its_scene(tmp_path: Path) -> None:
    cloud = prepare(CloudSource("sim:room:200:0", 0.5, 3), tmp_path)
    points = l2p.simulate("room", 200, 0).xyz
    _, index = l2p.lift_indexed(points, 3, 0.5)
    apart = torch.pdist(cloud.true_point)
    expected = torch.pdist(torch.as_tensor(points[index], dtype=torch.float32))
    ratio = (apart / expected).numpy()
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=1e-3)


def one_line(votes: list[float], logits: list[float], true_beta: float, width: float = 0.2) -> tuple[Sample, Judgement]:
    """A line whose candidates vote for the same place with both votes."""
    k = len(votes)
    place = torch.tensor([votes])
    edges = Edges(
        closest=place,
        foot=place,
        width=torch.full((1, k), width),
        feature=torch.zeros(1, k, len(EDGE)),
        state=torch.zeros(1, k, STATE),
        valid=torch.ones(1, k, dtype=torch.bool),
        index=torch.arange(k)[None],
    )
    label = torch.full((1, k), 0.5)
    truth = torch.tensor([true_beta])
    vote = torch.tensor(logits)[None, :, None].expand(1, k, 2)
    judgement = Judgement(torch.zeros(1, k), vote, torch.zeros(1, STATE), torch.zeros(1))
    return Sample(edges, label, truth, torch.zeros(1), torch.tensor(0.5)), judgement


def test_position_loss_is_the_mixture_over_a_floor() -> None:
    sample, judgement = one_line([0.1, 0.5], [0.0, 1.0], true_beta=0.3)
    spread = torch.tensor([-0.3, 0.2])
    weight, total = np.exp([0.0, 1.0]) / (2 * np.exp([0.0, 1.0]).sum()), 0.0
    for kind in range(2):
        for vote, share in zip((0.1, 0.5), weight, strict=True):
            width = 0.2 * np.exp(spread[kind].item())
            total += share / (1 + ((vote - 0.3) / width) ** 2) / (width / 0.5)
    expected = -np.log(total + np.exp(-5.0))
    assert position_loss(judgement, sample, spread).item() == pytest.approx(expected, rel=1e-5)


def test_position_loss_of_a_hopeless_line_is_bounded() -> None:
    sample, judgement = one_line([0.1], [0.0], true_beta=1e9)
    assert position_loss(judgement, sample, torch.zeros(2)).item() == pytest.approx(5.0, abs=1e-4)


def test_affinity_loss_leaves_padding_out() -> None:
    sample, judgement = one_line([0.1, 0.5], [0.0, 0.0], true_beta=0.3)
    padded = sample._replace(edges=sample.edges._replace(valid=torch.tensor([[True, False]])))
    judgement = judgement._replace(affinity=torch.tensor([[0.0, -torch.inf]]))
    assert affinity_loss(judgement, padded).item() == pytest.approx(np.log(2), rel=1e-6)


def test_soft_labels_fall_at_the_local_radius() -> None:
    label = soft_labels(torch.tensor([[0.0, 2.5, 10.0]]), torch.tensor([2.0]))
    assert label[0, 0] > 0.99 and label[0, 1] == 0.5 and label[0, 2] < 1e-6


def test_calibration_finds_the_probability(tmp_path: Path, rng: np.random.Generator) -> None:
    """Confidences that are too sure by a known factor are put right."""
    store = StateStore(tmp_path, settings(tmp_path).round)
    state = store.state(CloudSource("sim:room:1500:0", 1.0, 0), [])
    logit = torch.as_tensor(rng.normal(size=len(state.candidates)))
    inside = torch.as_tensor(rng.uniform(size=len(logit))) < torch.sigmoid(0.5 * logit + 0.3)
    beta = state.cloud.true_beta + torch.where(inside, 0.0, 5 * state.cloud.spacing)
    nodes = state.nodes._replace(confidence=torch.sigmoid(logit).float(), beta=beta)
    after = type(state)(state.cloud, nodes, state.candidates)
    assert calibrate([after]) == pytest.approx((0.5, 0.3), abs=0.15)


@pytest.mark.parametrize("found", [0.0, 100.0])
def test_calibration_is_finite_where_all_lines_or_none_are_found(tmp_path: Path, found: float) -> None:
    store = StateStore(tmp_path, settings(tmp_path).round)
    state = store.state(CloudSource("sim:room:100:0", 1.0, 0), [])
    beta = state.cloud.true_beta + found * state.cloud.spacing
    slope, offset = calibrate([type(state)(state.cloud, state.nodes._replace(beta=beta), state.candidates)])
    assert slope > 0 and np.isfinite([slope, offset]).all()
