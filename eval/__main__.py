"""Entry point of ``python -m eval``: hydra composes the config, its types are checked, the cells are run."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from l2p.programs.needed import end_without

try:
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import DictConfig

    from eval.eval_config import CONFIGS, settings_of
    from eval.evaluation import evaluate_all
    from l2p.programs.launch import explained, launch
except ModuleNotFoundError as error:
    end_without("eval", error)


@hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="eval")
def main(config: DictConfig) -> None:
    """Run the steps of the config; exit code 2 for a user's error, 1 if cells failed, 130 after Ctrl-C."""
    command = shlex.join(["python", "-m", "eval", *HydraConfig.get().overrides.task])
    with explained("eval"):
        failed = evaluate_all(settings_of(config), Path(HydraConfig.get().runtime.output_dir), command)
    if failed:
        print(f"eval: {failed} cell(s) failed, see the log; the same command tries them again", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    launch("eval", main)
