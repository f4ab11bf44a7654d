"""The config of ``python -m train``: types of all keys, and the conversion to plain objects."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from l2p.attacks.learned.checkpoint import configured
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import NetworkConfig
from l2p.checks import check_fraction
from l2p.errors import InputError
from l2p.programs.keys import check_keys
from l2p.schemes.scheme import scheme_of
from l2p.simulator import MAX_POINTS, MIN_POINTS
from l2p.work.launched import MOST_THREADS
from train.infonce import EmbeddingSettings

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "train"


def keys_of(default: Any) -> Any:
    """Return the keys and values of a frozen dataclass of the package, as a node that hydra may write to."""
    hints = get_type_hints(type(default))
    keys = []
    for name, value in ((entry.name, getattr(default, entry.name)) for entry in fields(default)):
        if is_dataclass(value):
            keys.append((name, nested := keys_of(value), field(default_factory=nested)))
        elif isinstance(value, tuple):  # OmegaConf has no tuples
            kind = list[get_args(hints[name])[0]]
            keys.append((name, kind, field(default_factory=lambda value=value: list(value))))
        else:
            keys.append((name, hints[name], field(default=value)))
    return make_dataclass(f"{type(default).__name__}Keys", keys)


NetworkKeys, LearnedKeys, EmbeddingKeys = (
    keys_of(NetworkConfig()),
    keys_of(LearnedConfig()),
    keys_of(EmbeddingSettings()),
)


@dataclass
class TrainerKeys:
    """Keys passed to Lightning's trainer."""

    accelerator: str = MISSING
    devices: int = MISSING
    num_nodes: int = MISSING
    strategy: str = MISSING
    precision: str = MISSING


@dataclass
class DataSettings:
    """Line clouds for training and validation."""

    seed: int = MISSING
    scheme: str = MISSING
    scenes: list[str] = MISSING
    simulated: int = MISSING
    simulated_points: list[int] = MISSING
    maps: list[str] = MISSING
    map_turns: int = MISSING
    absent: float = MISSING
    val: list[str] = MISSING
    val_maps: list[str] = MISSING
    val_fractions: list[float] = MISSING
    min_lines: int = MISSING
    max_lines: int = MISSING


@dataclass
class ScheduleSettings:
    """Length and rate of a training."""

    seed: int = MISSING
    steps: int = MISSING
    minutes: float | None = None
    learning_rate: float = MISSING
    weight_decay: float = MISSING
    warmup: int = MISSING
    averaging: float = MISSING
    validate_every: int = MISSING
    patience: int | None = None
    save_every: int = MISSING


@dataclass
class FitSettings(ScheduleSettings):
    """Settings of the training of the learned attack."""

    clouds: int = MISSING
    lines_per_batch: int = MISSING


@dataclass
class TrainConfig(DataSettings, FitSettings):
    """Keys of ``configs/train/train.yaml``, which explains each."""

    name: str = MISSING
    start: str | None = None
    run: str = MISSING
    threads: int | None = None
    logger: dict[str, Any] = field(default_factory=dict)
    trainer: TrainerKeys = field(default_factory=TrainerKeys)
    network: NetworkKeys = field(default_factory=NetworkKeys)  # type: ignore[valid-type]
    learned: LearnedKeys = field(default_factory=LearnedKeys)  # type: ignore[valid-type]
    embedding: EmbeddingKeys = field(default_factory=EmbeddingKeys)  # type: ignore[valid-type]


ConfigStore.instance().store(name="train_schema", node=TrainConfig)


@dataclass(frozen=True)
class Settings:
    """A checked config."""

    threads: int | None
    data: DataSettings
    fit: FitSettings
    network: NetworkConfig
    learned: LearnedConfig
    embedding: EmbeddingSettings
    start: str | None
    resolved: dict[str, Any]


#: Keys that may change between two starts of one run; all others change the model.
CHANGEABLE = ("steps", "minutes", "patience", "save_every", "threads", "logger", "trainer")
#: Least values of whole numbers of all trainings.
SCHEDULE_LEAST = {
    **dict.fromkeys(("seed", "warmup"), 0),
    **dict.fromkeys(("steps", "validate_every", "patience", "save_every", "threads"), 1),
}
#: Least values of whole numbers; a single line has no neighbour. No steps: the weights of ``start`` get a new embedding
#: and calibration.
_LEAST = {
    **SCHEDULE_LEAST,
    "steps": 0,
    "min_lines": 2,
    "simulated": 0,
    "map_turns": 1,
    "clouds": 1,
    "lines_per_batch": 1,
}


def settings_of(config: DictConfig) -> Settings:
    """Check the composed config.

    Raises
    ------
    InputError
        If a value is out of range.
    """
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    check_keys(resolved, TrainConfig, "configs/train/train.yaml")
    _check(resolved)
    try:
        network, learned, embedding = (
            configured(NetworkConfig, resolved["network"]),
            configured(LearnedConfig, resolved["learned"]),
            configured(EmbeddingSettings, resolved["embedding"]),
        )
    except ValueError as error:
        raise InputError(str(error)) from error
    return Settings(
        threads=resolved["threads"],
        data=DataSettings(**some(DataSettings, resolved)),
        fit=FitSettings(**some(FitSettings, resolved)),
        network=network,
        learned=learned,
        embedding=embedding,
        start=resolved["start"],
        resolved=resolved,
    )


def some(kind: type, resolved: dict[str, Any]) -> dict[str, Any]:
    return {entry.name: resolved[entry.name] for entry in fields(kind)}


def check_schedule(resolved: dict[str, Any], least: dict[str, int]) -> None:
    """Check what all trainings have, and the least values of whole numbers; InputError if one is out of range."""
    for key, lowest in least.items():
        if resolved[key] is not None and resolved[key] < lowest:
            raise InputError(f"got {key} {resolved[key]}; expected at least {lowest}")
    for key, most in {"seed": 2**63 - 1, "threads": MOST_THREADS}.items():
        if resolved[key] is not None and resolved[key] > most:
            raise InputError(f"got {key} {resolved[key]}; expected at most {most}")
    for key in ("learning_rate", "weight_decay"):
        if not 0 <= resolved[key] < math.inf:
            raise InputError(f"got {key} {resolved[key]}; expected a number that is not negative")
    if resolved["minutes"] is not None and not resolved["minutes"] > 0:
        raise InputError(f"got minutes {resolved['minutes']}; expected more than 0, or null")
    if not 0 <= resolved["averaging"] < 1:
        raise InputError(f"got averaging {resolved['averaging']}; expected a number in [0, 1)")


def _check(resolved: dict[str, Any]) -> None:
    check_schedule(resolved, _LEAST)
    scheme_of(resolved["scheme"])
    if resolved["steps"] == 0 and resolved["start"] is None:
        raise InputError("got steps 0; expected at least 1, or start=FILE, whose weights get a new embedding")
    if not resolved["scenes"] and not resolved["maps"] and resolved["simulated"] < 1:
        raise InputError("got no scenes and no simulated ones; expected scenes=[FOLDER] or simulated=12")
    if not 0 <= resolved["absent"] <= 1:
        raise InputError(f"got absent {resolved['absent']}; expected a chance in [0, 1]")
    if not resolved["val"] and not resolved["val_maps"]:
        raise InputError("got no val scenes; expected at least one, to calibrate the confidence")
    if resolved["max_lines"] < resolved["min_lines"]:
        raise InputError(f"got max_lines {resolved['max_lines']}; expected at least min_lines, {resolved['min_lines']}")
    for name in ("rounds", "alike_rounds"):
        if resolved["learned"][name] < 1:
            raise InputError(f"got {resolved['learned'][name]} learned.{name}; expected at least 1")
    points = resolved["simulated_points"]
    if len(points) != 2 or not MIN_POINTS <= points[0] <= points[1] <= MAX_POINTS:
        raise InputError(
            f"got simulated_points {points}; expected [LEAST, MOST], at least {MIN_POINTS}, at most {MAX_POINTS}"
        )
    for fraction in resolved["val_fractions"] or [0.0]:
        check_fraction(fraction, "val fraction")
