"""Convert a checkpoint of format 4, for lines alone, to format 5: no weight changes.

    python -m train.convert OLD.safetensors NEW.safetensors

Format 4 had one calibration, that of lines alone, and no sizes of an embedding.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from l2p.attacks.learned import checkpoint
from l2p.attacks.learned.checkpoint import Checkpoint, configured, network_of, opened
from l2p.attacks.learned.inputs import inputs_of
from l2p.attacks.learned.knowledge import LINES_ALONE
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import NetworkConfig
from l2p.errors import InputError, sentence


def converted(path: Path) -> Checkpoint:
    """Read a checkpoint of format 4.

    Raises
    ------
    FileNotFoundError, InputError
        If it is missing, of another format, or damaged.
    """
    metadata, tensors = opened(path)
    if metadata.get("l2p_format") != "4":
        raise InputError(f"{path} has format {metadata.get('l2p_format', 'unknown')}; expected 4")
    try:
        size = configured(NetworkConfig, {**asdict(NetworkConfig()), **json.loads(metadata["network"])})
        config = configured(LearnedConfig, {**asdict(LearnedConfig()), **json.loads(metadata["learned"])})
        calibration = [[(float(a), float(b)) for a, b in part] for part in json.loads(metadata["calibration"])]
        inputs = inputs_of(size.inputs, dict(json.loads(metadata["inputs"])))
        facts = dict(json.loads(metadata["facts"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} has a damaged header ({error})") from error
    return Checkpoint(network_of(path, size, tensors), config, {LINES_ALONE: calibration}, facts, inputs)


def main(words: list[str]) -> int:
    """Convert one file; exit code 2 is a user's error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, metavar="OLD", help="checkpoint of format 4")
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
