"""Convert a checkpoint of format 3 to format 4, which names its inputs and all constants: no weight changes.

    python -m train.convert OLD.safetensors NEW.safetensors

Format 3 had one fixed list of inputs, and constants that stood in the code of l2p at 70b056c; they are today's
defaults.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.checkpoint import Checkpoint, network_of, opened
from l2p.attacks.learned.learned import LearnedConfig
from l2p.attacks.learned.network import NetworkConfig
from l2p.attacks.peak import PeakConfig
from l2p.errors import InputError, sentence

#: Experimental options of format 3, with the only value that format 4 supports.
_EXPERIMENTS = {"without": [], "weight": "vote", "rule": "several", "batch": 256}


def converted(path: Path) -> Checkpoint:
    """Read a checkpoint of format 3.

    Raises
    ------
    FileNotFoundError, InputError
        If it is missing, of another format, or uses an experimental option that format 4 does not support.
    """
    metadata, tensors = opened(path)
    if metadata.get("l2p_format") != "3":
        raise InputError(f"{path} has format {metadata.get('l2p_format', 'unknown')}; expected 3")
    try:
        network, learned = _plain(path, metadata["network"]), _plain(path, metadata["learned"])
        learned["peak"] = PeakConfig(**_without_experiments(path, learned["peak"]))
        calibration = [[(float(a), float(b)) for a, b in part] for part in json.loads(metadata["calibration"])]
        radii = tuple(json.loads(metadata["radii"]))
        size, config = NetworkConfig(**network, radii=radii), LearnedConfig(**learned)
        facts = dict(json.loads(metadata["facts"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} has a damaged header ({error})") from error
    return Checkpoint(network_of(path, size, tensors), config, calibration, facts)


def _plain(path: Path, text: str) -> dict[str, Any]:
    return _without_experiments(path, json.loads(text))


def _without_experiments(path: Path, values: dict[str, Any]) -> dict[str, Any]:
    for name, meant in _EXPERIMENTS.items():
        if values.pop(name, meant) != meant:
            raise InputError(f"{path} is of an experiment with another {name}; expected {meant}, so train it again")
    return values


def main(words: list[str]) -> int:
    """Convert one file; exit code 2 is a user's error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, metavar="OLD", help="checkpoint of format 3")
    parser.add_argument("new", type=Path, metavar="NEW", help="file to write")
    parser.add_argument("--force", action="store_true", help="replace NEW")
    given = parser.parse_args(words)
    try:
        checkpoint.save(given.new, converted(given.old), overwrite=given.force)
    except (InputError, OSError) as error:
        print("train.convert:", sentence(error), file=sys.stderr)
        return 2
    print(given.new)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
