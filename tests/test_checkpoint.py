"""The checkpoint file: what is written is read, and everything else is refused with a sentence."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from l2p import checkpoint
from l2p.checkpoint import Checkpoint
from l2p.errors import InputError
from l2p.learned import RoundConfig
from l2p.network import LineTransformer, NetworkConfig

SIZE = NetworkConfig(width=8, layers=1, heads=2)
CONFIG = RoundConfig(candidates=16)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A checkpoint of two rounds."""
    path = tmp_path / "model.safetensors"
    networks = [LineTransformer(SIZE), LineTransformer(SIZE)]
    checkpoint.save(path, Checkpoint(networks, CONFIG, [(1.0, 0.0), (0.8, -0.1)], {"seed": 3, "note": "Grüße"}))
    return path


def header(path: Path) -> dict[str, str]:
    raw = path.read_bytes()
    return json.loads(raw[8 : 8 + int.from_bytes(raw[:8], "little")])["__metadata__"]


def test_what_is_saved_is_loaded(file: Path) -> None:
    learned, whole = checkpoint.load(file), checkpoint.read(file)
    assert learned.config == CONFIG
    assert learned.calibration == [(1.0, 0.0), (0.8, -0.1)]
    assert [network.config for network in learned.networks] == [SIZE, SIZE]
    assert whole.facts == {"seed": 3, "note": "Grüße"}
    tensors = load_file(file)
    assert torch.equal(tensors["round1.judge.weight"], learned.networks[1].state_dict()["judge.weight"])
    assert all(isinstance(value, str) for value in header(file).values())


def test_an_existing_file_is_kept(file: Path) -> None:
    with pytest.raises(InputError, match="exists"):
        checkpoint.save(file, checkpoint.read(file))


def test_a_missing_file_is_not_found(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.safetensors does not exist; expected a checkpoint"):
        checkpoint.load(tmp_path / "none.safetensors")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder; expected a checkpoint file"):
        checkpoint.load(tmp_path)


@pytest.mark.parametrize("size", [0, 5, 100, -1])
def test_a_truncated_file_is_refused(file: Path, size: int) -> None:
    file.write_bytes(file.read_bytes()[:size])
    with pytest.raises(InputError, match="is no safetensors file or is cut short"):
        checkpoint.load(file)


def test_a_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple:
            return Path.touch, (tmp_path / "boom",)

    path = tmp_path / "model.ckpt"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(InputError, match="is no safetensors file"):
        checkpoint.load(path)
    assert not (tmp_path / "boom").exists()


@pytest.mark.parametrize("metadata", [None, {"format": "pt"}, {"l2p_format": "one"}])
def test_a_foreign_file_is_refused(file: Path, metadata: dict[str, str] | None) -> None:
    save_file(load_file(file), file, metadata)
    with pytest.raises(InputError, match="of another program"):
        checkpoint.load(file)


def test_a_newer_format_is_refused(file: Path) -> None:
    save_file(load_file(file), file, {**header(file), "l2p_format": "2"})
    with pytest.raises(InputError, match="has format 2, this version of l2p reads format 1; update l2p"):
        checkpoint.load(file)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("networks", None),
        ("networks", "[{"),
        ("networks", '[{"width": 8}]'),
        ("networks", "[7]"),
        ("rounds", '{"candidates": 16, "batch": 64, "peak": {"threshold": 0.5}}'),
        ("calibration", "[[1.0]]"),
        ("facts", None),
    ],
)
def test_a_damaged_header_is_refused(file: Path, key: str, value: str | None) -> None:
    metadata = {name: old for name, old in header(file).items() if name != key}
    save_file(load_file(file), file, metadata if value is None else {**metadata, key: value})
    with pytest.raises(InputError, match="has a damaged header"):
        checkpoint.load(file)


@pytest.mark.parametrize(("key", "value"), [("networks", "[]"), ("calibration", "[[1.0, 0.0]]")])
def test_rounds_and_calibrations_have_one_number(file: Path, key: str, value: str) -> None:
    save_file(load_file(file), file, {**header(file), key: value})
    with pytest.raises(InputError, match="expected one a round"):
        checkpoint.load(file)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("round0.judge.bias", None, "lacks tensor round0.judge.bias"),
        ("round7.judge.bias", torch.zeros(3), "has an unknown tensor round7.judge.bias"),
        ("round0.judge.bias", torch.zeros(4), "expected float32"),
        ("round0.judge.bias", torch.zeros(3, dtype=torch.float64), "expected float32"),
        ("round1.judge.bias", torch.tensor([0.0, torch.nan, 0.0]), "NaN or infinite in round1.judge.bias"),
    ],
)
def test_wrong_tensors_are_refused(file: Path, name: str, value: torch.Tensor | None, message: str) -> None:
    tensors, metadata = load_file(file), header(file)
    tensors.pop(name, None)
    save_file(tensors if value is None else {**tensors, name: value}, file, metadata)
    with pytest.raises(InputError, match=message):
        checkpoint.load(file)
