"""Measure the error after each round of the learned attack, by relaxation and by number of settling steps.

    python benchmarks/rounds.py ../shared/scenes/train/bust_bronze.npz

The relaxation of 1.4 and the 6 settling steps were chosen by it: docs/experiments.md has the table.

Attacks line clouds of all points, up to a number of lines, and of a tenth of these, with one checkpoint. Prints for
each relaxation and number of settling steps (:class:`l2p.attacks.learned.learned.LearnedConfig`) the geometric mean of
the median errors after each round, in spacings of the clouds' own points, and the mean share within 1 spacing.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import replace

import numpy as np
import torch
from harness import print_table

from l2p.attacks.learned.checkpoint import load, shipped
from l2p.attacks.learned.learned import Learned
from train.clouds import Cloud, CloudSource, lifted, read
from train.judging import rounds_of

#: Scenes that are in no training set.
SIMULATED = ("sim:room:8000:901", "sim:facade:8000:901", "sim:object:8000:901", "sim:terrain:8000:901")


def clouds(scenes: list[str], lines: int, attack: Learned) -> list[Cloud]:
    """Lift each scene twice: with all points up to ``lines``, and with a tenth of these."""
    most = {scene: min(1.0, lines / len(read(scene).xyz)) for scene in scenes}
    return [lifted(CloudSource(scene, share * part, 0), attack) for scene, part in most.items() for share in (1.0, 0.1)]


def main() -> None:
    """Print one row per choice."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=list(SIMULATED), help="scenes, or sim:KIND:POINTS:SEED (default)")
    parser.add_argument("--relaxation", type=float, nargs="+", default=[1.0, 1.4], help="(default: %(default)s)")
    parser.add_argument("--settling", type=int, nargs="+", default=[0, 6], help="(default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=4, help="(default: %(default)s)")
    parser.add_argument("--lines", type=int, default=8000, help="of a cloud at most (default: %(default)s)")
    parser.add_argument("--checkpoint", default=shipped(), help="(default: the shipped one)")
    given = parser.parse_args()
    torch.set_num_threads(1)
    attack = load(given.checkpoint)
    known = clouds(given.scenes, given.lines, attack)
    rows = []
    for relaxation, settling in itertools.product(given.relaxation, given.settling):
        config = replace(attack.config, rounds=given.rounds, relaxation=relaxation, settling=settling)
        varied = Learned(attack.network, config, [[(1.0, 0.0)]] * given.rounds, inputs=attack.inputs)
        errors = [[judged.error for judged in rounds_of(cloud, varied)] for cloud in known]
        median = np.exp(np.mean([[float(part.median().log()) for part in cloud] for cloud in errors], axis=0))
        within = np.mean([[float((part <= 1).float().mean()) for part in cloud] for cloud in errors], axis=0)
        figures = ", ".join(f"{number:.4f}" for number in median), ", ".join(f"{number:.1%}" for number in within)
        rows.append([f"{relaxation:g}", str(settling), *figures])
    heads = ["relaxation", "settling", "median error after each round", "within 1"]
    print_table(f"{len(known)} clouds", heads, rows)


if __name__ == "__main__":
    main()
