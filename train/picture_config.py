"""The config of ``python -m train --config-name pictures``: types of all keys, and their checks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from l2p.attacks.learned.checkpoint import configured
from l2p.checks import check_fraction
from l2p.errors import InputError
from l2p.images.inversion import InversionConfig
from l2p.programs.keys import check_keys
from train.train_config import SCHEDULE_LEAST, ScheduleSettings, TrainerKeys, check_schedule, keys_of, some

InversionKeys = keys_of(InversionConfig())


@dataclass
class PictureSettings(ScheduleSettings):
    """Data and settings of the training of the inversion network."""

    maps: list[str] = MISSING
    val_maps: list[str] = MISSING
    fractions: list[float] = MISSING
    recovered: float = MISSING
    absent: float = MISSING
    crops: int = MISSING
    crop: int = MISSING
    val_views: int = MISSING


@dataclass
class PictureConfig(PictureSettings):
    """Keys of ``configs/train/pictures.yaml``, which explains each."""

    name: str = MISSING
    run: str = MISSING
    threads: int | None = None
    logger: dict[str, Any] = field(default_factory=dict)
    trainer: TrainerKeys = field(default_factory=TrainerKeys)
    network: InversionKeys = field(default_factory=InversionKeys)  # type: ignore[valid-type]


ConfigStore.instance().store(name="pictures_schema", node=PictureConfig)


@dataclass(frozen=True)
class PictureRun:
    """A checked config."""

    threads: int | None
    fit: PictureSettings
    network: InversionConfig
    resolved: dict[str, Any]


def picture_run_of(config: DictConfig) -> PictureRun:
    """Check the composed config.

    Raises
    ------
    InputError
        If a value is out of range.
    """
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    check_keys(resolved, PictureConfig, "configs/train/pictures.yaml")
    check_schedule(resolved, {**SCHEDULE_LEAST, "crops": 1, "val_views": 1})
    for name in ("maps", "val_maps"):
        if not resolved[name]:
            raise InputError(f"got no {name}; expected at least one COLMAP model with descriptors and photographs")
    for name in ("recovered", "absent"):
        if not 0 <= resolved[name] <= 1:
            raise InputError(f"got {name} {resolved[name]}; expected a chance in [0, 1]")
    if not resolved["fractions"]:
        raise InputError("got no fractions; expected shares of the points, such as [1.0, 0.1]")
    for fraction in resolved["fractions"]:
        check_fraction(fraction, "fraction")
    try:
        network = configured(InversionConfig, resolved["network"])
    except ValueError as error:
        raise InputError(str(error)) from error
    if resolved["crop"] < network.multiple or resolved["crop"] % network.multiple:
        raise InputError(f"got crop {resolved['crop']}; expected a multiple of {network.multiple}")
    return PictureRun(
        threads=resolved["threads"],
        fit=PictureSettings(**some(PictureSettings, resolved)),
        network=network,
        resolved=resolved,
    )
