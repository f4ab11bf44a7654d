"""The training program: through the real configs, on one tiny simulated scene."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

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
from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.run import run as attack
from l2p.errors import InputError
from train.lightning_parts import FigureTable
from train.train_config import CONFIGS, Settings, settings_of
from train.training import train_all

ROOT = Path(__file__).parents[2]
COMMAND = "python -m train"


def settings(*overrides: str, experiment: str = "debug") -> Settings:
    """The real config, composed as the command line does."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return settings_of(compose("train", [f"experiment={experiment}", *overrides]))


def facts(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


def figures(folder: Path) -> dict[tuple[str, str], str]:
    """Values by step and figure; the last row of a step counts."""
    with (folder / "figures.csv").open(newline="", encoding="utf-8") as file:
        return {(row["step"], row["figure"]): row["value"] for row in csv.DictReader(file)}


def assert_same_model(one: Path, other: Path) -> None:
    """To the last bit."""
    left, right = load_file(one / "model.safetensors"), load_file(other / "model.safetensors")
    assert left.keys() == right.keys()
    for name, value in left.items():
        assert torch.equal(value, right[name]), name
    assert facts(one)["results"] == facts(other)["results"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an uninterrupted debug run."""
    folder = tmp_path_factory.mktemp("run")
    assert train_all(settings(), folder, COMMAND, [UNINTERRUPTED]) == folder / "model.safetensors"
    return folder


class Stop(lightning.Callback):
    """Fails like a machine that is switched off, after a step."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: object) -> None:
        if trainer.global_step == self.step:
            raise OSError("switched off")


class Steps(lightning.Callback):
    """Keeps round and turn of the pool's clouds before each step that is done."""

    def __init__(self) -> None:
        self.places: list[dict[int, tuple[int, int]]] = []

    def on_train_batch_start(self, _: lightning.Trainer, module: Any, *__: object) -> None:
        self.places.append({entry.number: (entry.round, entry.turn) for entry in module.pool.entries})


UNINTERRUPTED = Steps()


# A run


def test_a_run_leaves_a_model_its_log_and_its_facts(trained: Path) -> None:
    found = facts(trained)
    assert {"command", "commit", "versions", "machine", "seed", "scenes", "config"} <= set(found)
    assert found["steps"] == 16 and found["processes"] == 1 and found["minutes"] < 5
    (result,) = found["results"]
    figures = {"median", "within", "confident_half", "calibration_error"}
    assert {"scene", "fraction", "known", "lines", *figures} == set(result) and result["known"] == "lines"
    assert len(result["median"]) == len(result["within"]) == 2
    whole = checkpoint.read(trained / "model.safetensors")
    assert whole.facts == found and len(whole.calibration["lines"]) == 2
    assert settings().resolved == found["config"]
    assert (trained / "config.yaml").is_file() and list(trained.glob("events.*"))
    assert not list(trained.rglob("*.part"))


def test_figures_are_those_of_the_losses_and_of_the_validations(trained: Path) -> None:
    found = figures(trained)
    parts = ("rate", "affinity", "position", "found", "probe", "median", "within")
    assert {name for _, name in found} == {
        *(f"train/{part}" for part in parts),
        *("val/score", "val/median", "val/within"),
    }
    assert {step for step, name in found if name == "val/median"} == {"7", "15"}
    last = float(found["15", "val/median"])
    assert last == pytest.approx(facts(trained)["results"][0]["median"][-1], abs=1e-4)
    assert float(found["15", "val/score"]) == pytest.approx(np.log(last), abs=1e-4)


def test_the_model_recovers_points(trained: Path, scene_points: np.ndarray) -> None:
    recovery = attack(l2p.lift(scene_points, seed=0), checkpoint.load(trained / "model.safetensors"))
    assert np.isfinite(recovery.xyz).all()
    assert recovery.info["settings"]["rounds"] == 2


# Interrupted


def test_runs_are_stopped_in_every_round_and_amid_clouds(trained: Path) -> None:
    """What the next test is about."""
    places = [place for saved in (0, 3, 9, 12) for place in UNINTERRUPTED.places[saved].items()]
    assert any(turn > 0 for _, (_, turn) in places) and {round for _, (round, _) in places} == {0, 1}
    assert any(cloud > 1 for cloud, _ in places)


@pytest.mark.parametrize(("step", "saved"), [(2, 0), (4, 3), (10, 9), (14, 12)])
def test_a_resumed_run_ends_with_the_same_weights(trained: Path, tmp_path: Path, step: int, saved: int) -> None:
    """Also if the kill falls into the middle of a cloud's round."""
    with pytest.raises(OSError, match="switched off"):
        train_all(settings(), tmp_path, COMMAND, [Stop(step)])
    assert not (tmp_path / "model.safetensors").exists()
    assert (tmp_path / "last.ckpt").exists() == (saved > 0)
    steps = Steps()
    train_all(settings(), tmp_path, COMMAND, [steps])
    assert steps.places == UNINTERRUPTED.places[saved:]
    assert_same_model(trained, tmp_path)
    assert figures(trained) == figures(tmp_path)


def test_a_finished_run_is_not_trained_again(tmp_path: Path) -> None:
    few = settings("steps=4", "save_every=2")
    (tmp_path / ".l2p-0123.tmp").write_bytes(b"half of a state, from a run that was killed")
    steps = Steps()
    train_all(few, tmp_path, COMMAND)
    assert not list(tmp_path.glob(".*"))
    weights, results = load_file(tmp_path / "model.safetensors"), facts(tmp_path)["results"]
    (tmp_path / "model.safetensors").unlink()
    train_all(few, tmp_path, COMMAND, [steps])
    assert not steps.places and facts(tmp_path)["steps"] == 4 and facts(tmp_path)["results"] == results
    assert all(torch.equal(value, weights[name]) for name, value in load_file(tmp_path / "model.safetensors").items())


def test_a_run_is_not_continued_with_another_config(trained: Path) -> None:
    with pytest.raises(InputError, match="was started with another seed; give name=ANOTHER"):
        train_all(settings("seed=1"), trained, COMMAND)


def test_two_processes_train_one_network_also_after_a_kill(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    last = folder / "last.ckpt"
    command = [sys.executable, "-m", "train", "experiment=debug", f"run={folder}"]
    command += ["save_every=4", "trainer.devices=2", "trainer.strategy=ddp"]
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    with (
        (tmp_path / "log").open("wb") as log,
        subprocess.Popen([*command, "steps=100000"], cwd=ROOT, env=env, stderr=log) as training,
    ):
        until = time.monotonic() + 120
        while not last.exists() and training.poll() is None and time.monotonic() < until:
            time.sleep(0.05)
        training.terminate()
        assert training.wait(timeout=60) == -signal.SIGTERM, (tmp_path / "log").read_text()
    saved = torch.load(last, weights_only=True)
    assert [{entry["number"] % 2 for entry in pool["entries"]} for pool in saved["pools"]] == [{0}, {1}]
    steps = saved["global_step"] + 2
    done = subprocess.run(
        [*command, f"steps={steps}"],
        capture_output=True, text=True, check=False, cwd=ROOT, env=env, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{folder / 'model.safetensors'}\n", "one process speaks"
    assert done.stderr.count("going on from") == 1
    assert facts(folder)["steps"] == steps and facts(folder)["processes"] == 2
    assert checkpoint.load(folder / "model.safetensors").config.rounds == 2
    assert not list(folder.glob("*process*"))


def test_a_table_that_a_kill_has_torn_is_mended(tmp_path: Path) -> None:
    table = tmp_path / "figures.csv"
    for before in (None, "", "step,figure,value\n", "step,figure,value\n7,rate,0.2", "step,fig"):
        table.unlink(missing_ok=True)
        if before is not None:
            table.write_text(before)
        FigureTable(tmp_path).log_metrics({"rate": 0.5}, step=8)
        assert figures(tmp_path) == {("8", "rate"): "0.5"}, before


# Ended


def test_time_ends_a_run(tmp_path: Path) -> None:
    train_all(settings("steps=100000", "minutes=1e-6"), tmp_path, COMMAND)
    assert facts(tmp_path)["steps"] == 1


def test_a_run_that_does_not_improve_is_stopped(tmp_path: Path) -> None:
    train_all(settings("learning_rate=0.0", "validate_every=1", "patience=2"), tmp_path, COMMAND)
    assert facts(tmp_path)["steps"] == 3


# Config


@pytest.mark.parametrize("override", ["nonsense=1", "network.nonsense=1", "learned.peak.nonsense=1", "steps=many"])
def test_unknown_keys_and_other_types_are_errors(override: str) -> None:
    with pytest.raises((HydraException, OmegaConfBaseException)):
        settings(override)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("simulated=0", "got no scenes and no simulated ones"),
        ("simulated_points=[500]", r"got simulated_points \[500\]; expected \[LEAST, MOST\]"),
        ("simulated_points=[5,500]", r"got simulated_points \[5, 500\]; expected .*, at least 100"),
        ("simulated_points=[500,300]", r"got simulated_points \[500, 300\]"),
        ("val=[]", "got no val scenes"),
        ("val_fractions=[]", "got val fraction 0.0"),
        ("val_fractions=[0.5,1.5]", r"got val fraction 1.5; expected a number in \(0, 1\]"),
        ("min_lines=1", "got min_lines 1; expected at least 2"),
        ("max_lines=10", "got max_lines 10; expected at least min_lines, 50"),
        ("steps=-1", "got steps -1; expected at least 0"),
        ("steps=0", "got steps 0; expected at least 1, or start=FILE"),
        ("minutes=0", "got minutes 0.0; expected more than 0, or null"),
        ("clouds=0", "got clouds 0; expected at least 1"),
        ("lines_per_batch=0", "got lines_per_batch 0; expected at least 1"),
        ("learning_rate=-1.0", "got learning_rate -1.0; expected a number that is not negative"),
        ("learning_rate=nan", "got learning_rate nan"),
        ("weight_decay=-1.0", "got weight_decay -1.0"),
        ("averaging=1.0", r"got averaging 1.0; expected a number in \[0, 1\)"),
        ("validate_every=0", "got validate_every 0; expected at least 1"),
        ("patience=0", "got patience 0; expected at least 1"),
        ("save_every=0", "got save_every 0; expected at least 1"),
        ("threads=0", "got threads 0; expected at least 1"),
        ("network.width=9", "got width 9 and 2 heads"),
        ("network.heads=0", "got width 8 and 0 heads"),
        ("learned.rounds=0", "got 0 learned.rounds; expected at least 1"),
        ("learned.candidates=0", "got candidates 0 of the learned attack; expected at least 1"),
    ],
)
def test_values_out_of_range_are_refused(override: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        settings(override)


def test_defaults_are_those_of_the_package() -> None:
    made = settings("learned={}", "network.width=8")
    assert made.learned == LearnedConfig(rounds=2, candidates=16)


def test_the_geometric_experiment_composes() -> None:
    made = settings(experiment="geometric")
    assert made.learned == LearnedConfig() and made.data.scenes and set(made.data.val).isdisjoint(made.data.scenes)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"):
        train_all(settings(f"scenes=[{tmp_path / 'nowhere'}]"), tmp_path / "run", COMMAND)


def test_the_command_line_ends_with_a_sentence(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "train", "experiment=debug", "val=[]", f"run={tmp_path / 'run'}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, timeout=120)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.splitlines()[-1].startswith("train: got no val scenes")
