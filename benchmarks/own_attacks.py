"""Attacks on planes, permuted points and sphere clouds: what each recovers of maps, by what it sees.

    python benchmarks/own_attacks.py ../shared/maps/val/*

Columns: the share of the points within 1 spacing, the median error in spacings, the area under the curve of real rays
against fakes, and seconds; means over the maps (geometric means of the medians). ``--each`` prints every map.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from harness import print_table

import l2p
from l2p.attacks.from_permuted import PermutedConfig, recover_permuted
from l2p.attacks.from_planes import PlanesConfig, recover_planes
from l2p.attacks.from_spheres import SpheresConfig, recover_spheres
from l2p.io.descriptors import load_described
from l2p.judging.accuracy import spacing
from l2p.judging.measure import geometric_mean
from l2p.maps.truth import Hiding
from l2p.work.progress import terminal_progress

#: Attributes to leave out, by what the attacker sees.
HIDDEN = {"geometry": {"rgb", "descriptor"}, "+ colours": {"descriptor"}, "+ descriptors": {"rgb"}, "+ both": set()}
#: What is worth seeing of schemes whose attack is decided by one thing.
ONLY = {"planes-pooled": ["+ descriptors"], "planes": ["+ both"]}
#: Attack of each scheme, and that of its baseline, if it has one.
Attack = Callable[..., l2p.Recovery]
SCHEMES: dict[str, tuple[Attack, Attack | None]] = {
    "planes-random": (recover_planes, lambda cloud: recover_planes(cloud, PlanesConfig(nearest=25))),
    "planes-pooled": (recover_planes, None),
    "planes": (recover_planes, None),
    "permuted": (recover_permuted, lambda cloud: recover_permuted(cloud, PermutedConfig(nearest=25))),
    **dict.fromkeys(
        ("sphere-50", "sphere-33", "sphere-25"),
        (recover_spheres, lambda cloud: recover_spheres(cloud, SpheresConfig(cosine=True))),
    ),
}


def oracle_planes(hidden: Hiding, count: int = 25) -> l2p.Recovery:
    """The bound of planes: the point of each plane nearest to the planes of its true neighbours."""
    from l2p.attacks.from_planes import least_squares
    from l2p.geometry.points import nearest_neighbors

    middle, cloud = hidden.truth.xyz.mean(axis=0), hidden.map
    near = torch.as_tensor(nearest_neighbors(hidden.truth.xyz, count, workers=1).index)
    unit = float(np.median(np.linalg.norm(hidden.truth.xyz - middle, axis=1)))
    offset = torch.as_tensor((cloud.offset - cloud.normal @ middle) / unit)
    found = least_squares(torch.as_tensor(cloud.normal.copy()), offset, near).numpy() * unit + middle
    return l2p.Recovery(found, np.zeros(len(cloud), dtype=np.float32), np.zeros(len(cloud)), info={"seconds": 0.0})


def trials(scene: l2p.Scene, name: str, seed: int) -> dict[str, tuple[l2p.Recovery, Hiding]]:
    """Recoveries by what the attacker sees."""
    hidden = l2p.hide(scene, seed, scheme=name, rgb=True, descriptor=True)
    own, baseline = SCHEMES[name]
    found = {
        seen: (own(hidden.map.without(without)), hidden)
        for seen, without in HIDDEN.items()
        if seen in ONLY.get(name, HIDDEN)
    }
    if baseline is not None:
        found["baseline"] = baseline(hidden.map), hidden
    if name == "planes-random":
        found["true neighbours"] = oracle_planes(hidden), hidden
    return found


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", metavar="MODEL", help="COLMAP models with descriptors")
    parser.add_argument("--schemes", nargs="+", choices=SCHEMES, default=list(SCHEMES), metavar="SCHEME")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--each", action="store_true", help="print every map on stderr")
    given = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[tuple[str, str], list[tuple[float, float, float, float]]] = {}
    with terminal_progress().task("attacks", total=len(given.models) * len(given.schemes)) as advance:
        for model in given.models:
            scene = load_described(model)[0]
            unit = spacing(scene.xyz)
            for name in given.schemes:
                for seen, (recovery, hidden) in trials(scene, name, given.seed).items():
                    scores = l2p.evaluate(recovery, hidden.truth, spacing=unit)
                    auc = float("nan") if scores.fakes_auc is None else scores.fakes_auc
                    row = (scores.within_1, scores.median_spacings, auc, recovery.info["seconds"])
                    found.setdefault((name, seen), []).append(row)
                    if given.each:
                        print(model.name, name, seen, *np.round(row, 3), sep="\t", file=sys.stderr, flush=True)
                advance(1)
    rows = []
    for (name, seen), values in found.items():
        within, middle, auc, seconds = np.array(values).T
        real = ("-", "-") if np.isnan(auc).any() else (f"{auc.mean():.3f}", f"{auc.min():.3f}")
        rows.append(
            [
                name,
                seen,
                f"{100 * within.mean():.1f} %",
                f"{geometric_mean(middle):.2f}",
                *real,
                f"{seconds.mean():.1f}",
            ]
        )
    heads = ["scheme", "attacker sees", "within 1 spacing", "median", "real over fake", "worst map", "seconds"]
    print_table(f"{len(given.models)} maps", heads, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
