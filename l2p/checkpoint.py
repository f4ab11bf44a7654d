"""The checkpoint: one safetensors file with the networks of all rounds, how they are run, and how they came about.

Tensors are named ``round0.NAME``; everything else is JSON in the file's metadata. Nothing in it is ever executed.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import torch
from torch import Tensor

from l2p.errors import InputError
from l2p.learned import Learned, RoundConfig
from l2p.network import LineTransformer, NetworkConfig

#: Number of the file's layout; a reader refuses those that it does not know.
FORMAT = 1
_FORMAT_KEY = "l2p_format"

Config = TypeVar("Config")


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What a checkpoint file holds.

    Attributes
    ----------
    networks : sequence of LineTransformer
        One a round.
    config : RoundConfig
    calibration : sequence of (float, float)
        For each round a and b of the probability sigmoid(a sure + b) of lying within 1 spacing.
    facts : dict
        How it was trained: plain values.
    """

    networks: Sequence[LineTransformer]
    config: RoundConfig
    calibration: Sequence[tuple[float, float]]
    facts: dict[str, Any] = field(default_factory=dict)


def save(path: str | PathLike[str], checkpoint: Checkpoint, *, overwrite: bool = False) -> None:
    """Write a checkpoint, whole or not at all."""
    from safetensors.torch import save as encoded

    from l2p.io.atomic import atomic_file

    tensors = {
        f"round{number}.{name}": value.detach().cpu().contiguous()
        for number, network in enumerate(checkpoint.networks)
        for name, value in network.state_dict().items()
    }
    metadata = {
        _FORMAT_KEY: str(FORMAT),
        "networks": json.dumps([asdict(network.config) for network in checkpoint.networks]),
        "rounds": json.dumps(asdict(checkpoint.config)),
        "calibration": json.dumps([list(pair) for pair in checkpoint.calibration]),
        "facts": json.dumps(checkpoint.facts, ensure_ascii=False),
    }
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(encoded(tensors, metadata))


def load(path: str | PathLike[str]) -> Learned:
    """The attack of a checkpoint file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is no checkpoint of l2p, is damaged, or was written by a newer version.
    """
    checkpoint = read(path)
    return Learned(checkpoint.networks, checkpoint.config, checkpoint.calibration)


def read(path: str | PathLike[str]) -> Checkpoint:
    """All that a checkpoint file holds; raises as :func:`load` does."""
    path = Path(path)
    metadata, tensors = _opened(path)
    _check_format(path, metadata)
    try:
        sizes = [configured(NetworkConfig, values) for values in json.loads(metadata["networks"])]
        config = configured(RoundConfig, json.loads(metadata["rounds"]))
        calibration = [(float(a), float(b)) for a, b in json.loads(metadata["calibration"])]
        facts = json.loads(metadata["facts"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} has a damaged header ({error}); download or train the checkpoint again") from error
    if not sizes or len(calibration) != len(sizes):
        raise InputError(f"{path} has {len(sizes)} networks and {len(calibration)} calibrations; expected one a round")
    return Checkpoint(_networks(path, sizes, tensors), config, calibration, facts)


def configured(kind: type[Config], values: dict[str, Any]) -> Config:
    """A configuration dataclass from plain values; every key has to be there, and no other."""
    hints = get_type_hints(kind)
    names = [entry.name for entry in fields(kind)]  # type: ignore[arg-type]
    if not isinstance(values, dict) or set(values) != set(names):
        raise ValueError(f"got {sorted(values)} for {kind.__name__}, expected {sorted(names)}")
    return kind(
        **{name: configured(hints[name], values[name]) if is_dataclass(hints[name]) else values[name] for name in names}
    )


def _opened(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    from safetensors import SafetensorError, safe_open

    if path.is_dir():
        raise InputError(f"{path} is a folder; expected a checkpoint file, *.safetensors")
    if not path.exists():
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
        raise InputError(f"{path} has format {written}, this version of l2p reads format {FORMAT}; {mend}")


def _networks(path: Path, sizes: Sequence[NetworkConfig], tensors: dict[str, Tensor]) -> list[LineTransformer]:
    networks = [LineTransformer(size) for size in sizes]
    expected = {
        f"round{number}.{name}": tuple(value.shape)
        for number, network in enumerate(networks)
        for name, value in network.state_dict().items()
    }
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
    for number, network in enumerate(networks):
        prefix = f"round{number}."
        own = {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}
        network.load_state_dict(own, strict=True)
    return networks
