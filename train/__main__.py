"""``python -m train``: hydra composes the config, its types are checked, then the network is trained.

``--config-name pictures`` trains the inversion network in place of that of the learned attack.
"""

from __future__ import annotations

import logging
import os
import shlex
from pathlib import Path

from l2p.programs.needed import end_without

try:
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import DictConfig

    from l2p.programs.launch import explained, launch
    from train.picture_config import PictureRun, picture_run_of
    from train.train_config import CONFIGS, settings_of
except ModuleNotFoundError as error:
    end_without("train", error)


#: Name of the config of the inversion network.
PICTURES = "pictures"


@hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="train")
def main(config: DictConfig) -> None:
    """Train by the config; exit code 2 is a user's error, 130 Ctrl-C."""
    named = [] if HydraConfig.get().job.config_name == "train" else ["--config-name", PICTURES]
    command = shlex.join(["python", "-m", "train", *named, *HydraConfig.get().overrides.task])
    folder = Path(HydraConfig.get().runtime.output_dir)
    with explained("train", lambda: left_in(folder)):
        settings = picture_run_of(config) if named else settings_of(config)
        # Lightning takes seconds to load; a wrong config is reported before.
        if os.environ.get("LOCAL_RANK", "0") == "0":
            logging.getLogger("train").info("loading torch and Lightning, then training into %s", folder)
        if isinstance(settings, PictureRun):
            from train.picture_training import train_pictures

            model = train_pictures(settings, folder, command)
        else:
            from train.training import train_all

            model = train_all(settings, folder, command)
        from lightning.pytorch.utilities import rank_zero_only
    if rank_zero_only.rank == 0:
        print(model)


def left_in(folder: Path) -> str:
    """Say what an interrupted run has left."""
    last = folder / "last.ckpt"
    if last.exists():
        return f"the same command goes on from {last}"
    return "no state was saved yet, so the same command begins the run again"


if __name__ == "__main__":
    launch("train", main)
