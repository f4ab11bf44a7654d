"""The checkpoint: one safetensors file with the network, the settings of its rounds, and the record of its training.

Its tensors are the network's weights, by name; everything else is JSON in its metadata. Nothing in it is executed.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import partial
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar, get_origin, get_type_hints

import torch
from torch import Tensor

from l2p.attacks.learned.inputs import inputs_of
from l2p.attacks.learned.inputs.family import Inputs
from l2p.attacks.learned.knowledge import Calibrations, knowledges
from l2p.attacks.learned.learned import Learned, rounds_with
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import LineTransformer, NetworkConfig
from l2p.attacks.settings import LearnedSettings
from l2p.checks import check_fraction
from l2p.errors import InputError
from l2p.maps.short_repr import short_repr
from l2p.schemes.recognition import UNIFORM

#: Version of the file format; a reader refuses versions that it does not know.
FORMAT = 5
_FORMAT_KEY = "l2p_format"
#: Files of the weights that are installed with the package, by the scheme of the lines.
WEIGHTS = {UNIFORM: "learned.safetensors", "ppl": "ppl.safetensors", "rays": "rays.safetensors"}
#: Hexadecimal digits of a digest: enough to distinguish checkpoints.
_DIGITS = 12

Config = TypeVar("Config")


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Contents of a checkpoint file.

    Attributes
    ----------
    network : LineTransformer
        Its configuration names the families of inputs.
    config : LearnedConfig
        Rounds, tomography, local scales and surfaces.
    calibration : mapping
        (a, b) for each knowledge, round and radius: sigmoid(a found + b) is the probability of lying within the radius.
    facts : dict
        Record of the training: plain values.
    inputs : sequence of Inputs
        Families of inputs with their constants; default: present constants.
    """

    network: LineTransformer
    config: LearnedConfig
    calibration: Calibrations
    facts: dict[str, Any] = field(default_factory=dict)
    inputs: Sequence[Inputs] = ()

    __repr__ = short_repr

    @property
    def scheme(self) -> str:
        """Scheme of the lines that the network was trained on."""
        return self.facts.get("config", {}).get("scheme", UNIFORM)

    def __post_init__(self) -> None:
        if not self.inputs:
            object.__setattr__(self, "inputs", inputs_of(self.network.config.inputs))


def shipped(scheme: str = UNIFORM) -> Path:
    """Path of the checkpoint that is installed with the package for lines of a scheme.

    Raises
    ------
    FileNotFoundError
        If it is missing from the installation.
    """
    path = Path(str(files("l2p") / "weights" / WEIGHTS[scheme]))
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is missing from this installation; install l2p again, give a checkpoint of your own "
            "(--checkpoint FILE), or choose another method"
        )
    return path


def digest(path: str | PathLike[str]) -> str:
    """First 12 hexadecimal digits of the file's SHA-256."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:_DIGITS]


def save(path: str | PathLike[str], checkpoint: Checkpoint, *, overwrite: bool = False) -> None:
    """Write a checkpoint atomically."""
    from safetensors.torch import save as encoded

    from l2p.io.atomic import atomic_file

    tensors = {name: value.detach().cpu().contiguous() for name, value in checkpoint.network.state_dict().items()}
    metadata = {
        _FORMAT_KEY: str(FORMAT),
        "network": json.dumps(asdict(checkpoint.network.config)),
        "learned": json.dumps(asdict(checkpoint.config)),
        "inputs": json.dumps(
            {
                name: asdict(family)  # type: ignore[call-overload]
                for name, family in zip(checkpoint.network.config.inputs, checkpoint.inputs, strict=True)
            }
        ),
        "calibration": json.dumps(
            {
                known: [[list(pair) for pair in part] for part in parts]
                for known, parts in checkpoint.calibration.items()
            }
        ),
        "facts": json.dumps(checkpoint.facts, ensure_ascii=False),
    }
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(encoded(tensors, metadata))


def load(path: str | PathLike[str], *, rounds: int | None = None, fraction: float = 1.0) -> Learned:
    """Build the attack of a checkpoint file.

    Parameters
    ----------
    path : path
    rounds : int, optional
        Number of rounds, at most those of the training; default: all.
    fraction : float
        Fraction of the map's points in the line cloud, in (0, 1] (:class:`l2p.attacks.learned.learned.Learned`).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is no checkpoint of l2p, is damaged, was written by a newer version or trained for fewer rounds, or if
        the fraction is out of range.
    """
    check_fraction(fraction)
    checkpoint = read(path)
    config = checkpoint.config
    if rounds is not None:
        most = max(rounds_with(config, known) for known in knowledges(checkpoint.network.config))
        if not 0 <= rounds <= most:
            raise InputError(f"got {rounds} rounds; expected 0 to {most}, those that {path} was trained for")
        config = replace(config, rounds=min(rounds, config.rounds), alike_rounds=min(rounds, config.alike_rounds))
    source = {"checkpoint": Path(path).name, "digest": digest(path)}
    return Learned(
        checkpoint.network, config, checkpoint.calibration, fraction, checkpoint.inputs, source, checkpoint.scheme
    )


def build(settings: LearnedSettings) -> Learned:
    """Build the attack with these settings."""
    if settings.checkpoint is not None:
        return load(settings.checkpoint, rounds=settings.rounds, fraction=settings.fraction)
    attack = _shipped_attack(settings, UNIFORM)
    attack.siblings = partial(_shipped_attack, settings)
    return attack


def _shipped_attack(settings: LearnedSettings, scheme: str) -> Learned:
    return load(shipped(scheme), rounds=settings.rounds, fraction=settings.fraction)


def read(path: str | PathLike[str]) -> Checkpoint:
    """Read a checkpoint file; raises as :func:`load` does."""
    path = Path(path)
    metadata, tensors = opened(path)
    _check_format(path, metadata)
    try:
        size = configured(NetworkConfig, json.loads(metadata["network"]))
        config = configured(LearnedConfig, json.loads(metadata["learned"]))
        calibration = {
            known: [[(float(a), float(b)) for a, b in part] for part in parts]
            for known, parts in json.loads(metadata["calibration"]).items()
        }
        constants = dict(json.loads(metadata["inputs"]))
        facts = dict(json.loads(metadata["facts"]))
        inputs = inputs_of(size.inputs, constants)
    except (KeyError, AttributeError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise InputError(f"{path} has a damaged header ({error}); download or train the checkpoint again") from error
    _check_calibration(path, calibration, size, config)
    numbers = [number for parts in calibration.values() for part in parts for pair in part for number in pair]
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{path} has calibrations that are NaN or infinite; it is damaged")
    return Checkpoint(network_of(path, size, tensors), config, calibration, facts, inputs)


def _check_calibration(path: Path, calibration: Calibrations, size: NetworkConfig, config: LearnedConfig) -> None:
    expected = knowledges(size)
    if set(calibration) != set(expected):
        raise InputError(f"{path} has calibrations of {', '.join(calibration)}; expected {', '.join(expected)}")
    for known, parts in calibration.items():
        rounds = rounds_with(config, known)
        if len(parts) != rounds or any(len(part) != len(size.radii) for part in parts):
            raise InputError(
                f"{path} has {len(parts)} calibrations of {known} for {rounds} rounds; expected one a round and radius"
            )


def configured(kind: type[Config], values: dict[str, Any]) -> Config:
    """Build a configuration dataclass from plain values; exactly its keys must be given."""
    hints = get_type_hints(kind)
    names = [entry.name for entry in fields(kind)]  # type: ignore[arg-type]
    if not isinstance(values, dict) or set(values) != set(names):
        raise ValueError(f"got {sorted(values)} for {kind.__name__}, expected {sorted(names)}")
    return kind(**{name: _value(hints[name], values[name]) for name in names})


def _value(kind: Any, value: Any) -> Any:
    if is_dataclass(kind):
        return configured(kind, value)  # type: ignore[arg-type]
    if isinstance(value, list):
        value = tuple(value)  # JSON and YAML have no tuples
    taken = (int, float) if kind is float else get_origin(kind) or kind
    if not isinstance(value, taken) or isinstance(value, bool):
        raise ValueError(f"got {value!r}, expected {kind}")
    return value


def opened(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    from safetensors import SafetensorError, safe_open

    if os.path.isdir(path):
        raise InputError(f"{path} is a folder; expected a checkpoint file, *.safetensors")
    if not os.path.exists(path):
        raise FileNotFoundError(f"{path} does not exist; expected a checkpoint file, *.safetensors")
    try:
        with safe_open(str(path), framework="pt") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is no safetensors file or is cut short ({error}); expected a checkpoint") from error


def _check_format(path: Path, metadata: dict[str, str]) -> None:
    written = metadata.get(_FORMAT_KEY, "")
    if not written.isdecimal():
        raise InputError(f"{path} is a safetensors file of another program; expected a checkpoint of l2p")
    if int(written) != FORMAT:
        mend = "update l2p" if int(written) > FORMAT else "train or download it again"
        if int(written) == 4:
            mend = "convert it: python -m train.convert OLD NEW"
        raise InputError(f"{path} has format {written}, this version of l2p reads format {FORMAT}; {mend}")


def network_of(path: Path, size: NetworkConfig, tensors: dict[str, Tensor]) -> LineTransformer:
    if size.layers > len(tensors) or size.width > sum(value.numel() for value in tensors.values()):
        raise InputError(f"{path} has too few tensors for {size.layers} layers of width {size.width}; it is damaged")
    try:
        # Shapes only: memory is allocated by the tensors of the file.
        with torch.device("meta"):
            expected = {name: tuple(value.shape) for name, value in LineTransformer(size).state_dict().items()}
    except (TypeError, ValueError, RuntimeError, ArithmeticError) as error:
        raise InputError(f"{path} has sizes that no network has ({error}); it is damaged") from error
    if set(expected) != set(tensors):
        name = min(set(expected) ^ set(tensors))
        raise InputError(f"{path} {'lacks' if name in expected else 'has an unknown'} tensor {name}; it is damaged")
    for name, value in tensors.items():
        if tuple(value.shape) != expected[name] or value.dtype != torch.float32:
            raise InputError(
                f"{path} has tensor {name} of {value.dtype} {tuple(value.shape)}; expected float32 {expected[name]}"
            )
        if not bool(value.isfinite().all()):
            raise InputError(f"{path} has weights that are NaN or infinite in {name}; it is damaged")
    network = LineTransformer(size)
    network.load_state_dict(tensors, strict=True)
    return network.eval()
