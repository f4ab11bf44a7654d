"""The first minutes with ``python -m train`` and ``python -m eval``: what is missing, unknown, shown, interrupted."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("hydra", reason="the programs need the extra train: pip install 'l2p[train]'")
pytest.importorskip("lightning", reason="the programs need the extra train: pip install 'l2p[train]'")

import lightning
from hydra import compose, initialize_config_dir

from eval import eval_config
from eval.result_tables import Table, fitted
from l2p.errors import InputError
from l2p.programs.launch import explained
from train import lightning_parts, train_config
from train.__main__ import left_in
from train.lightning_parts import FOLDER, LossLines, chosen_logger
from train.training import train_all

ROOT = Path(__file__).parents[2]


def composed(module: Any, name: str, *overrides: str) -> Any:
    """Settings by the real config of a program."""
    with initialize_config_dir(str(module.CONFIGS), version_base="1.3"):
        return module.settings_of(compose(name, list(overrides)))


@pytest.mark.parametrize("program", ["train", "eval"])
def test_a_program_without_its_extra_says_what_to_install(program: str) -> None:
    code = f"import runpy, sys; sys.modules['hydra'] = None; runpy.run_module('{program}', run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"{program}: hydra is not installed;")
    assert "pip install -c constraints.txt -e '.[train]'" in done.stderr


def test_lightning_that_is_missing_is_said_too_but_no_other_module(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop, explained("train"):
        raise ModuleNotFoundError("No module named 'lightning'", name="lightning.pytorch")
    assert stop.value.code == 2 and "lightning is not installed" in capsys.readouterr().err
    with pytest.raises(ModuleNotFoundError), explained("train"):
        raise ModuleNotFoundError("No module named 'mine'", name="mine")


@pytest.mark.parametrize(
    ("module", "name", "override", "key"),
    [
        (train_config, "train", "+unknown=1", "unknown"),
        (train_config, "train", "+network.unknown=1", "network.unknown"),
        (train_config, "train", "+learned.peak.unknown=1", "learned.peak.unknown"),
        (eval_config, "eval", "+unknown=1", "unknown"),
        (eval_config, "eval", "+pictures.unknown=1", "pictures.unknown"),
    ],
)
def test_an_added_key_that_nothing_reads_is_an_error(module: Any, name: str, override: str, key: str) -> None:
    with pytest.raises(Exception, match=f"{key}|{key.rpartition('.')[2]}") as refused:
        composed(module, name, override)
    if isinstance(refused.value, InputError):
        assert f"got {key}, which is no key of this program" in str(refused.value)


def test_free_mappings_take_any_key() -> None:
    assert composed(eval_config, "eval", "+kinds={all: indoor}").kinds == {"all": "indoor"}
    assert composed(train_config, "train", "+logger.comment=mine").resolved["logger"]["comment"] == "mine"


def test_a_logger_is_chosen_by_its_group(tmp_path: Path) -> None:
    assert composed(train_config, "train").resolved["logger"]["_target_"].endswith("TensorBoardLogger")
    assert chosen_logger(composed(train_config, "train", "logger=none").resolved["logger"], tmp_path) == []
    (made,) = chosen_logger({"_target_": "lightning.pytorch.loggers.CSVLogger", "save_dir": FOLDER}, tmp_path)
    assert made.save_dir == str(tmp_path)
    with pytest.raises(InputError, match=r"got logger nowhere.Logger, which says: .*or give logger=none"):
        chosen_logger({"_target_": "nowhere.Logger"}, tmp_path)
    assert composed(train_config, "train", "logger=wandb").resolved["logger"]["name"] == "default"


def test_lines_with_the_loss_come_soon_and_then_seldom(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(lightning_parts.time, "monotonic", lambda: clock.now)
    trainer: Any = SimpleNamespace(is_global_zero=True, global_step=0, max_steps=7)
    lines = LossLines(every=60)
    module: Any = None
    logger = logging.getLogger("train")
    monkeypatch.setattr(logger, "propagate", True)
    with caplog.at_level(logging.INFO, logger="train"):
        lines.on_train_start(trainer, module)
        for step in range(600):
            clock.now, trainer.global_step = clock.now + 0.5, step + 1
            lines.on_train_batch_end(trainer, module, {"loss": 0.25}, None, step)
    said = [record.getMessage() for record in caplog.records]
    assert said[0] == "step 1 of at most 7: loss 0.2500"
    assert 8 <= len(said) <= 12, "300 seconds"


class Interrupt(lightning.Callback):
    """Ctrl-C after a step."""

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: object) -> None:
        if trainer.global_step == 4:
            raise KeyboardInterrupt


def test_ctrl_c_leaves_a_state_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "begins the run again" in left_in(tmp_path)
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as stop, explained("train", lambda: left_in(tmp_path)):
            train_all(composed(train_config, "train", "experiment=debug"), tmp_path, "python -m train", [Interrupt()])
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert stop.value.code == 130
    assert f"train: interrupted; the same command goes on from {tmp_path / 'last.ckpt'}" in capsys.readouterr().err


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_a_wide_table_is_divided_by_columns_that_all_come_once(width: int) -> None:
    head = ["method", "points", *(f"figure number {i}" for i in range(12))]
    body = [[f"a method {row}", "100 %", *(f"{row}.{i:03}" for i in range(12))] for row in range(3)]
    parts = fitted(Table("wide", "a title", head, body), width)
    assert [name for part in parts for name in part.head[2:]] == head[2:]
    assert all(
        part.head[:2] == head[:2] and [row[:2] for row in part.body] == [row[:2] for row in body] for part in parts
    )
    assert (len(parts) == 1) == (width == 200)
    assert [cell for part in parts for cell in part.body[1][2:]] == body[1][2:]
    for part in parts:
        words = [
            max(map(len, [*heading.split(), *cells])) for heading, *cells in zip(part.head, *part.body, strict=True)
        ]
        assert sum(words) + 3 * len(words) + 1 <= width
