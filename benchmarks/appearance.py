"""What each part of the attack by appearance is worth: the shipped network, with parts of its use left out.

    python benchmarks/appearance.py ../shared/maps/val/* --fractions 1 0.1

A row is a change; its figures are the wrong points (more than 1 spacing off) and the median error, relative to the same
attack on the lines alone, as geometric means over the maps.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from harness import print_table

import l2p
from l2p.attacks.learned.learned import Learned
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.teaching import TeachingConfig
from l2p.attacks.named import named_attack
from l2p.attacks.run import run
from l2p.io.descriptors import load_described
from l2p.judging.accuracy import errors, spacing
from l2p.judging.measure import geometric_mean
from l2p.maps import ATTRIBUTES
from l2p.work.progress import terminal_progress

BOTH = ATTRIBUTES
#: Changes by name: attributes that are seen, and settings of the attack.
CHANGES: dict[str, tuple[tuple[str, ...], dict[str, object]]] = {
    "lines alone": ((), {}),
    "colours": (("rgb",), {}),
    "descriptors": (("descriptor",), {}),
    "both": (BOTH, {}),
    "both, without lessons": (BOTH, {"teaching": TeachingConfig(steps=0, fresh_steps=0)}),
    "both, lessons on half of the lines": (BOTH, {"teaching": TeachingConfig(share=0.5)}),
    "both, lessons on 90 %": (BOTH, {"teaching": TeachingConfig(share=0.9)}),
    "both, lessons of 300 steps": (BOTH, {"teaching": TeachingConfig(steps=300)}),
    "both, the 32 nearest candidates": (BOTH, {"alike": 32}),
    "both, 48 candidates": (BOTH, {"candidates": 48}),
    "both, kind unknown": (BOTH, {"kind": "unknown"}),
}


def trial(hidden: l2p.Hiding, unit: float, seen: tuple[str, ...], change: dict[str, object]) -> tuple[float, float]:
    """Share of wrong points and median error in spacings."""
    attack = named_attack("learned")
    assert isinstance(attack, Learned)
    lines = hidden.map.without(set(BOTH) - set(seen))
    settings = dict(change)
    if settings.pop("kind", None):
        lines = replace(lines, descriptor_kind="unknown")
    attack.config = replace(attack.config, **settings)  # type: ignore[arg-type]
    error = errors(run(lines, attack), hidden.truth) / unit
    return float(np.mean(error > 1)), float(np.median(error))


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL", help="COLMAP models with descriptors")
    parser.add_argument("--fractions", type=float, nargs="+", default=[1.0])
    parser.add_argument("--changes", nargs="+", choices=CHANGES, default=list(CHANGES), metavar="CHANGE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    assert LearnedConfig().candidates == 32
    torch.set_num_threads(given.threads)
    changes = list(dict.fromkeys(["lines alone", *given.changes]))
    found = {(change, fraction): [] for change in changes for fraction in given.fractions}
    with terminal_progress().task("attacks", total=len(found) * len(given.models)) as advance:
        for model in given.models:
            scene = load_described(model)[0]
            unit = spacing(scene.xyz)
            for fraction in given.fractions:
                hidden = l2p.hide(scene, given.seed, fraction, rgb=True, descriptor=True)
                for change in changes:
                    result = trial(hidden, unit, *CHANGES[change])
                    found[change, fraction].append(result)
                    print(model.name, fraction, change, *np.round(result, 4), sep="\t", file=sys.stderr, flush=True)
                    advance(1)
    heads, rows = ["attack"], [[change] for change in changes]
    for fraction in given.fractions:
        heads += [f"{100 * fraction:g} %: wrong", "median"]
        base = np.array(found["lines alone", fraction])
        for row, change in zip(rows, changes, strict=True):
            row += [f"{geometric_mean(column):.3f}" for column in (np.array(found[change, fraction]) / base).T]
    print_table(f"{len(given.models)} maps, relative to lines alone", heads, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
