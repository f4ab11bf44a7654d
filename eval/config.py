"""The config of ``python -m eval``: types of every key, and the one place where it turns into plain objects."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from eval.methods import Contender, contenders_of
from l2p.errors import InputError

CONFIGS = Path(__file__).resolve().parents[1] / "configs"

#: What is done, in this order.
STEPS = ("predict", "score")


@dataclass
class EvalConfig:
    """The keys of ``configs/eval.yaml``, where each is explained."""

    name: str = MISSING
    run: str = MISSING
    scenes: list[str] = MISSING
    kinds: dict[str, str] = field(default_factory=dict)
    methods: list[dict[str, Any]] = MISSING
    fractions: list[float] = MISSING
    seeds: list[int] = MISSING
    steps: list[str] = MISSING
    workers: int = MISSING
    threads: int | None = None
    device: str = MISSING
    docs: str | None = None


ConfigStore.instance().store(name="eval_schema", node=EvalConfig)


@dataclass(frozen=True)
class Settings:
    """A checked config."""

    name: str
    scenes: tuple[str, ...]
    kinds: dict[str, str]
    methods: tuple[Contender, ...]
    fractions: tuple[float, ...]
    seeds: tuple[int, ...]
    steps: tuple[str, ...]
    workers: int
    threads: int
    device: str
    docs: Path | None
    resolved: dict[str, Any]


def settings_of(config: DictConfig) -> Settings:
    """Check the composed config.

    Raises
    ------
    InputError
        If a value is out of range, or a method or one of its parameters is unknown.
    """
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    for key in ("scenes", "methods", "fractions", "seeds", "steps"):
        _check_list(key, resolved[key])
    for fraction in resolved["fractions"]:
        if not 0 < fraction <= 1:
            raise InputError(f"got fraction {fraction}; expected a number in (0, 1], the share of the points to lift")
    for seed in resolved["seeds"]:
        _check_at_least("seed", seed, 0)
    if set(resolved["steps"]) - set(STEPS):
        raise InputError(f"got steps {resolved['steps']}; expected some of {', '.join(STEPS)}")
    _check_at_least("workers", resolved["workers"], 1)
    threads = resolved["threads"]
    if threads is None:
        threads = max(1, (os.cpu_count() or 1) // resolved["workers"])
    _check_at_least("threads", threads, 1)
    return Settings(
        name=resolved["name"],
        scenes=tuple(resolved["scenes"]),
        kinds=resolved["kinds"],
        methods=contenders_of(resolved["methods"]),
        fractions=tuple(resolved["fractions"]),
        seeds=tuple(resolved["seeds"]),
        steps=tuple(resolved["steps"]),
        workers=resolved["workers"],
        threads=threads,
        device=resolved["device"],
        docs=None if resolved["docs"] is None else Path(resolved["docs"]),
        resolved=resolved,
    )


def _check_list(key: str, values: list[Any]) -> None:
    if not values:
        raise InputError(f"got no {key}; expected at least one")
    if any(value in values[:i] for i, value in enumerate(values)):
        raise InputError(f"got {key} {values}; expected each of them once")


def _check_at_least(key: str, value: int, least: int) -> None:
    if value < least:
        raise InputError(f"got {key} {value}; expected at least {least}")
