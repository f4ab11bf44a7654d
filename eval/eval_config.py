"""Config of ``python -m eval``: the type of every key, and the only conversion to plain objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from eval.contenders import contenders_of
from eval.contract import Contender
from l2p.attacks.run import usable_device
from l2p.checks import check_fraction
from l2p.errors import InputError
from l2p.programs.keys import check_keys
from l2p.schemes.scheme import scheme_of
from l2p.work.launched import MOST_THREADS

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "eval"

#: Steps of a run, in order.
STEPS = ("predict", "score")
#: Quantities that colour the points of a picture.
COLORS = ("error", "rgb")


@dataclass
class PictureKeys:
    """Keys of ``pictures`` in ``configs/eval/eval.yaml``."""

    scenes: list[str] = MISSING
    fractions: list[float] | None = None
    color: str = MISSING


@dataclass
class EvalConfig:
    """Keys of ``configs/eval/eval.yaml``, which explains each."""

    name: str = MISSING
    run: str = MISSING
    scenes: list[str] = MISSING
    kinds: dict[str, str] = field(default_factory=dict)
    methods: list[dict[str, Any]] = MISSING
    fractions: list[float] = MISSING
    schemes: list[str] = MISSING
    seeds: list[int] = MISSING
    steps: list[str] = MISSING
    processes: int | None = None
    threads: int | None = None
    device: str = MISSING
    queries: int = MISSING
    pictures: PictureKeys = field(default_factory=PictureKeys)
    docs: str | None = None
    update: list[str] = MISSING


ConfigStore.instance().store(name="eval_schema", node=EvalConfig)


@dataclass(frozen=True)
class Pictures:
    """Scenes and fractions to draw, and the quantity that colours the points: ``error`` or ``rgb``."""

    scenes: tuple[str, ...]
    fractions: tuple[float, ...]
    color: str


@dataclass(frozen=True)
class Settings:
    """Checked config; if ``processes`` or ``threads`` is None, it is chosen for the machine."""

    name: str
    scenes: tuple[str, ...]
    kinds: dict[str, str]
    methods: tuple[Contender, ...]
    fractions: tuple[float, ...]
    schemes: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: tuple[str, ...]
    processes: int | None
    threads: int | None
    device: str
    queries: int
    pictures: Pictures
    docs: Path | None
    update: tuple[Path, ...]
    resolved: dict[str, Any]


def settings_of(config: DictConfig) -> Settings:
    """Check the composed config.

    Raises
    ------
    InputError
        If a value is out of range, or a method or one of its parameters is unknown.
    """
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    check_keys(resolved, EvalConfig, "configs/eval/eval.yaml")
    for key in ("scenes", "methods", "fractions", "schemes", "seeds", "steps"):
        _check_list(key, resolved[key])
    for fraction in resolved["fractions"]:
        check_fraction(fraction)
    for scheme in resolved["schemes"]:
        scheme_of(scheme)
    for seed in resolved["seeds"]:
        _check_range("seed", seed, 0, 2**63 - 1)
    if set(resolved["steps"]) - set(STEPS):
        raise InputError(f"got steps {resolved['steps']}; expected some of {', '.join(STEPS)}")
    for key in ("processes", "threads"):
        if resolved[key] is not None:
            _check_range(key, resolved[key], 1, MOST_THREADS)
    _check_range("queries", resolved["queries"], 0, 10**9)
    usable_device(resolved["device"])
    return Settings(
        name=resolved["name"],
        scenes=tuple(resolved["scenes"]),
        kinds=resolved["kinds"],
        methods=contenders_of(resolved["methods"]),
        fractions=tuple(resolved["fractions"]),
        schemes=tuple(resolved["schemes"]),
        seeds=tuple(resolved["seeds"]),
        steps=tuple(resolved["steps"]),
        processes=resolved["processes"],
        threads=resolved["threads"],
        device=resolved["device"],
        queries=resolved["queries"],
        pictures=_pictures(resolved["pictures"], resolved["fractions"]),
        docs=None if resolved["docs"] is None else _page(Path(resolved["docs"])),
        update=tuple(_there(Path(file)) for file in resolved["update"]),
        resolved=resolved,
    )


def _pictures(given: dict[str, Any], fractions: list[float]) -> Pictures:
    """Check the pictures of the config; default: at the largest fraction."""
    if given["color"] not in COLORS:
        raise InputError(f"got color {given['color']!r} of the pictures; expected {' or '.join(COLORS)}")
    chosen = [max(fractions)] if given["fractions"] is None else given["fractions"]
    for fraction in chosen:
        if fraction not in fractions:
            raise InputError(f"got fraction {fraction} of the pictures; expected some of the run's {fractions}")
    return Pictures(tuple(given["scenes"]), tuple(chosen), given["color"])


def _there(file: Path) -> Path:
    if not file.is_file():
        raise FileNotFoundError(f"{file} does not exist; expected a Markdown file to update")
    try:
        file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is no text in UTF-8; expected a Markdown file to update") from error
    return file


def _page(file: Path) -> Path:
    """Check that a page and images beside it can be written; create the folder if needed."""
    if file.is_dir():
        raise InputError(f"got docs {file}, which is a folder; expected the name of a Markdown file")
    there = next(place for place in file.absolute().parents if place.exists())
    if not there.is_dir():
        raise InputError(f"got docs {file}, but {there} is no folder; expected the name of a Markdown file in one")
    return file


def _check_list(key: str, values: list[Any]) -> None:
    if not values:
        raise InputError(f"got no {key}; expected at least one")
    if any(value in values[:i] for i, value in enumerate(values)):
        raise InputError(f"got {key} {values}; expected each of them once")


def _check_range(key: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise InputError(f"got {key} {value}; expected at least {least}, at most {most}")
