"""``python -m train``: hydra composes the config, its types are checked, then the network is trained.

``--config-name pictures`` trains the inversion network in place of that of the learned attack.
"""

from __future__ import annotations

import shlex
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from l2p.programs.launch import explained, launch
from train.picture_config import picture_run_of
from train.train_config import CONFIGS, settings_of

#: Name of the config of the inversion network.
PICTURES = "pictures"


@hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="train")
def main(config: DictConfig) -> None:
    """Train by the config; exit code 2 is a user's error."""
    named = [] if HydraConfig.get().job.config_name == "train" else ["--config-name", PICTURES]
    command = shlex.join(["python", "-m", "train", *named, *HydraConfig.get().overrides.task])
    with explained("train"):
        folder = Path(HydraConfig.get().runtime.output_dir)
        # Lightning takes seconds to load; a wrong config is reported before.
        if HydraConfig.get().job.config_name == PICTURES:
            pictures = picture_run_of(config)
            from train.picture_training import train_pictures

            model = train_pictures(pictures, folder, command)
        else:
            settings = settings_of(config)
            from train.training import train_all

            model = train_all(settings, folder, command)
        from lightning.pytorch.utilities import rank_zero_only
    if rank_zero_only.rank == 0:
        print(model)


if __name__ == "__main__":
    launch("train", main)
