"""``python -m train``: hydra composes the config, its types are checked, then the network is trained."""

from __future__ import annotations

import shlex
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from l2p.programs.launch import explained, launch
from train.train_config import CONFIGS, settings_of


@hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="train")
def main(config: DictConfig) -> None:
    """Train by the config; exit code 2 is a user's error."""
    command = shlex.join(["python", "-m", "train", *HydraConfig.get().overrides.task])
    with explained("train"):
        settings = settings_of(config)
        # Lightning takes seconds to load; a wrong config is reported before.
        from lightning.pytorch.utilities import rank_zero_only

        from train.training import train_all

        model = train_all(settings, Path(HydraConfig.get().runtime.output_dir), command)
    if rank_zero_only.rank == 0:
        print(model)


if __name__ == "__main__":
    launch("train", main)
