"""The checkpoint file: what is written is read, and everything else is refused with a sentence."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import l2p
from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.checkpoint import Checkpoint
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import LineTransformer, NetworkConfig
from l2p.attacks.run import run
from l2p.errors import InputError
from train import convert

SIZE = NetworkConfig(width=8, layers=1, heads=2, finest=0.5)
CONFIG = LearnedConfig(rounds=2, alike_rounds=2, candidates=16)
RADII = SIZE.radii
ROUNDS = [[(1.0 + radius, -0.1 * number) for radius in RADII] for number in range(2)]
CALIBRATION = {"lines": ROUNDS}
#: Outputs of the network per candidate: an affinity and three votes.
JUDGED = 1 + 3


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A checkpoint of two rounds."""
    path = tmp_path / "model.safetensors"
    checkpoint.save(path, Checkpoint(LineTransformer(SIZE), CONFIG, CALIBRATION, {"seed": 3, "note": "Grüße"}))
    return path


def header(path: Path) -> dict[str, str]:
    raw = path.read_bytes()
    return json.loads(raw[8 : 8 + int.from_bytes(raw[:8], "little")])["__metadata__"]


def test_what_is_saved_is_loaded(file: Path) -> None:
    learned, whole = checkpoint.load(file), checkpoint.read(file)
    assert learned.config == whole.config == CONFIG
    assert learned.calibration == whole.calibration == CALIBRATION
    assert learned.network.config == SIZE and not learned.network.training
    assert whole.facts == {"seed": 3, "note": "Grüße"}
    tensors, state = load_file(file), learned.network.state_dict()
    assert tensors.keys() == state.keys() and all(torch.equal(tensors[name], state[name]) for name in state)
    assert all(isinstance(value, str) for value in header(file).values())


def test_what_is_read_may_be_written_again(file: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.safetensors"
    checkpoint.save(again, checkpoint.read(file))
    assert header(again) == header(file)
    left, right = load_file(file), load_file(again)
    assert left.keys() == right.keys() and all(torch.equal(left[name], right[name]) for name in left)


@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_fewer_rounds_may_be_run(file: Path, rounds: int) -> None:
    learned = checkpoint.load(file, rounds=rounds, fraction=0.5)
    assert learned.config == replace(CONFIG, rounds=rounds, alike_rounds=rounds) and learned.fraction == 0.5
    assert learned.settings()["rounds"] == rounds


@pytest.mark.parametrize("rounds", [-1, 3])
def test_more_rounds_than_it_was_trained_for_are_refused(file: Path, rounds: int) -> None:
    with pytest.raises(InputError, match=f"got {rounds} rounds; expected 0 to 2, those that .* was trained for"):
        checkpoint.load(file, rounds=rounds)


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


@pytest.mark.parametrize(
    ("format", "mend"),
    [
        (1, "train or download it again"),
        (2, "train or download it again"),
        (3, "train or download it again"),
        (4, "convert it: python -m train.convert"),
        (6, "update l2p"),
    ],
)
def test_another_format_is_refused(file: Path, format: int, mend: str) -> None:
    save_file(load_file(file), file, {**header(file), "l2p_format": str(format)})
    with pytest.raises(InputError, match=f"has format {format}, this version of l2p reads format 5; {mend}"):
        checkpoint.load(file)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("network", None),
        ("network", "{"),
        ("network", "7"),
        ("network", '{"width": 8}'),
        ("network", '{"width": 8, "layers": 1, "heads": 3, "finest": 0.5, "widest": 2.0}'),
        ("network", '{"width": "8", "layers": 1, "heads": 2, "finest": 0.5, "widest": 2.0}'),
        ("learned", None),
        ("learned", '{"rounds": 2, "candidates": 16, "peak": {"threshold": 0.5}}'),
        ("learned", '{"rounds": 2, "candidates": 16}'),
        ("calibration", None),
        ("calibration", "[[1.0]]"),
        ("calibration", '{"lines": [[1.0]]}'),
        ("inputs", None),
        ("inputs", "{}"),
        ("inputs", "[]"),
        ("facts", None),
    ],
)
def test_a_damaged_header_is_refused(file: Path, key: str, value: str | None) -> None:
    metadata = {name: old for name, old in header(file).items() if name != key}
    save_file(load_file(file), file, metadata if value is None else {**metadata, key: value})
    with pytest.raises(InputError, match="has a damaged header"):
        checkpoint.load(file)


@pytest.mark.parametrize("rounds", [[], ROUNDS[:1], [ROUNDS[0], ROUNDS[1][:-1]]])
def test_each_round_and_radius_has_a_calibration(file: Path, rounds: list) -> None:
    save_file(load_file(file), file, {**header(file), "calibration": json.dumps({"lines": rounds})})
    with pytest.raises(InputError, match="calibrations of lines for 2 rounds; expected one a round and radius"):
        checkpoint.load(file)


@pytest.mark.parametrize("names", [[], ["rgb"], ["lines", "rgb"]])
def test_each_knowledge_has_a_calibration(file: Path, names: list[str]) -> None:
    calibration = json.dumps(dict.fromkeys(names, ROUNDS))
    save_file(load_file(file), file, {**header(file), "calibration": calibration})
    with pytest.raises(InputError, match=f"has calibrations of {', '.join(names)}; expected lines"):
        checkpoint.load(file)


def test_a_checkpoint_of_format_4_is_converted(file: Path, tmp_path: Path, scene_points: np.ndarray) -> None:
    old, new, metadata = tmp_path / "old.safetensors", tmp_path / "new.safetensors", header(file)
    for part, names in {
        "network": ("kind", "length", "hidden", "embedding"),
        "learned": ("alike_rounds", "alike", "liking", "teaching"),
    }.items():
        metadata[part] = json.dumps({k: v for k, v in json.loads(metadata[part]).items() if k not in names})
    save_file(load_file(file), old, {**metadata, "l2p_format": "4", "calibration": json.dumps(ROUNDS)})
    assert convert.main([str(old), str(new)]) == 0
    written, wanted = header(new), header(file)
    # Rounds with likeness are the default: the network has no input for it.
    wanted["learned"] = json.dumps({**json.loads(wanted["learned"]), "alike_rounds": LearnedConfig.alike_rounds})
    assert written == wanted
    lines = l2p.lift(scene_points[::10], seed=0)
    one, other = (run(lines, checkpoint.load(path)) for path in (file, new))
    np.testing.assert_array_equal(one.xyz, other.xyz)
    np.testing.assert_array_equal(one.confidence, other.confidence)


def test_what_cannot_be_converted_is_left_alone(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = file.read_bytes()
    assert convert.main([str(file), str(file), "--force"]) == 2
    assert "has format 5; expected 4" in capsys.readouterr().err
    assert file.read_bytes() == before


@pytest.mark.parametrize("constants", [{"least": "x"}, {"least": 1e-3, "other": 1}, {}])
def test_constants_that_an_input_does_not_have_are_refused(file: Path, constants: dict) -> None:
    inputs = {**json.loads(header(file)["inputs"]), "distance": constants}
    save_file(load_file(file), file, {**header(file), "inputs": json.dumps(inputs)})
    with pytest.raises(InputError, match="of input distance; expected numbers for"):
        checkpoint.load(file)


def test_the_file_names_every_constant_that_made_its_inputs(file: Path) -> None:
    inputs, learned = (json.loads(header(file)[name]) for name in ("inputs", "learned"))
    assert set(inputs) == set(SIZE.inputs)
    assert inputs["wide_surface"] == {"grazing": 0.05, "farthest": 3.0} and inputs["distance"] == {"least": 1e-3}
    assert learned["nodes"]["wide"] == 96 and learned["nodes"]["surface"]["roughness"] == 0.03
    assert learned["tomography"]["iterations"] == 4 and learned["widening"] == 4.0


def test_other_constants_change_the_points(file: Path, scene_points: np.ndarray) -> None:
    """What the file says is used, not what the code has as its default."""
    lines, before = l2p.lift(scene_points, seed=0), checkpoint.load(file)
    learned = json.loads(header(file)["learned"])
    learned["tomography"]["smoothing"] = 0.05
    other = file.with_name("other.safetensors")
    save_file(load_file(file), other, {**header(file), "learned": json.dumps(learned)})
    inputs = json.loads(header(file)["inputs"])
    inputs["surface"]["farthest"] = 0.5
    third = file.with_name("third.safetensors")
    save_file(load_file(file), third, {**header(file), "inputs": json.dumps(inputs)})
    points = [run(lines, attack).xyz for attack in (before, checkpoint.load(other), checkpoint.load(third))]
    assert not np.array_equal(points[0], points[1]) and not np.array_equal(points[0], points[2])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("judge.bias", None, "lacks tensor judge.bias"),
        ("other.bias", torch.zeros(3), "has an unknown tensor other.bias"),
        ("judge.bias", torch.zeros(JUDGED + 1), rf"expected float32 \({JUDGED},\)"),
        ("judge.bias", torch.zeros(JUDGED, dtype=torch.float64), "expected float32"),
        ("judge.bias", torch.tensor([0.0, torch.nan] + [0.0] * (JUDGED - 2)), "NaN or infinite in judge.bias"),
    ],
)
def test_wrong_tensors_are_refused(file: Path, name: str, value: torch.Tensor | None, message: str) -> None:
    tensors, metadata = load_file(file), header(file)
    tensors.pop(name, None)
    save_file(tensors if value is None else {**tensors, name: value}, file, metadata)
    with pytest.raises(InputError, match=message):
        checkpoint.load(file)
