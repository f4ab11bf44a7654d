"""What each part of the learned attack is worth: a short training without it, beside the same training with it.

    python benchmarks/ablations.py --processes 2 -o docs/ablations.md

Every variant is a run of ``python -m train experiment=ablation`` with some settings changed, on the real scenes of
``../shared/scenes/train``, in a process with one thread. All see the same line clouds in the same order, unless the
data are what is changed. A finished run is not made again, a stopped one goes on. The trainings are far too short for
the best network; what they give compares with each other only. Figures are means over the held-back scenes (geometric
for medians), which no variant has trained on.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from l2p.io.atomic import atomic_file


class Variant(NamedTuple):
    """A training with some settings changed."""

    name: str
    title: str
    settings: tuple[str, ...] = ()


_SURFACES, _CUTS = ("surface", "wide_surface"), ("cut_vote", "wide_cut_vote")


def without(*parts: str) -> tuple[str, ...]:
    """A network without some parts."""
    return (f"network.without=[{','.join(parts)}]",)


#: The trainings, by what they tell of; the first of all is what the others are compared with.
GROUPS: dict[str, tuple[Variant, ...]] = {
    "": (
        Variant("all", "as shipped, a short training"),
        Variant("again", "the same with another seed", ("seed=1",)),
    ),
    "features, each family left out": (
        Variant("position", "position along the line", without("position")),
        Variant("distance", "distances", without("distance")),
        Variant("angle", "angle", without("angle")),
        Variant("tomography", "tomographic posterior", without("tomography")),
        Variant("confidence", "confidence", without("confidence")),
        Variant("scale", "local scale", without("scale")),
        Variant("surfaces", "both surfaces and their votes", without(*_SURFACES, *_CUTS)),
        Variant("wide", "the wide surface and its vote", without("wide_surface", "wide_cut_vote")),
    ),
    "votes": (
        Variant("closest", "without the closest point of the lines", without("closest_vote")),
        Variant("cuts", "without the cuts of the surfaces", without(*_CUTS)),
        Variant("paper", "closest points only, weighted by affinity (the paper's votes)",
                (*without(*_CUTS), "learned.weight=affinity")),
    ),
    "attention": (
        Variant("layers0", "no layers", ("network.layers=0",)),
        Variant("layers2", "two layers", ("network.layers=2",)),
        Variant("layers3", "three layers", ("network.layers=3",)),
        Variant("density", "no densities around the feet", without("density")),
        Variant("alone", "neither layers nor densities: each candidate judged by itself",
                ("network.layers=0", *without("density"))),
        Variant("state", "no states between lines", without("state")),
    ),
    "size": (
        Variant("width32", "width 32", ("network.width=32",)),
        Variant("width96", "width 96", ("network.width=96",)),
        Variant("heads2", "two heads", ("network.heads=2",)),
        Variant("k24", "24 candidates", ("learned.candidates=24",)),
        Variant("k48", "48 candidates", ("learned.candidates=48",)),
        Variant("rounds2", "two rounds", ("learned.rounds=2",)),
        Variant("rounds5", "five rounds", ("learned.rounds=5",)),
    ),
    "data": (
        Variant("simulated", "simulated scenes only", ("scenes=[]", "simulated=93")),
        Variant("real", "real scenes only", ("simulated=0",)),
    ),
    "length": (
        Variant("half", "half as many steps", ("steps=350",)),
        Variant("double", "twice as many steps", ("steps=1400",)),
    ),
}  # fmt: skip
_HEAD = "| | median, full | within 1 | median, 10 % | within 1 | calibration error | minutes |"


def train(variant: Variant, folder: Path, common: list[str]) -> None:
    """Train one variant, unless it is there."""
    run = folder / variant.name
    if (run / "results.json").exists():
        return
    command = [sys.executable, "-m", "train", "experiment=ablation", f"run={run}", *common, *variant.settings]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with open(f"{run}.log", "w") as log:
        code = subprocess.run(command, stdout=log, stderr=log, env=environment, check=False).returncode
    if code:
        raise SystemExit(f"{variant.name} ended with {code}; {run}.log says why, and what is done stays done")
    print(f"{variant.name}: done", flush=True)


def figures(folder: Path, variant: Variant) -> dict[str, Any] | None:
    """What a finished run is worth on the held-back scenes; None for another."""
    try:
        facts = json.loads((folder / variant.name / "results.json").read_text())
    except FileNotFoundError:
        return None
    full, thin = ([row for row in facts["results"] if (row["fraction"] == 0.1) == tenth] for tenth in (False, True))
    found = {"minutes": facts["minutes"], "commit": facts["commit"], "error": mean(full, "calibration_error")}
    for name, rows in (("full", full), ("thin", thin)):
        found[f"{name}_median"] = float(np.exp(np.mean([np.log(row["median"][-1]) for row in rows])))
        found[f"{name}_within"] = float(np.mean([row["within"][-1] for row in rows]))
    return found


def mean(rows: list[dict[str, Any]], name: str) -> float:
    """Of a figure of each scene."""
    return float(np.mean([row[name] for row in rows]))


def table(folder: Path) -> list[str]:
    """The rows of the finished variants; medians in spacings of the line cloud, and as ratios to the first."""
    first = figures(folder, GROUPS[""][0])
    rows = [_HEAD, "| --- |" + " ---: |" * (_HEAD.count("|") - 2)]
    for group, variants in GROUPS.items():
        found = [(variant, figures(folder, variant)) for variant in variants]
        if group and any(values for _, values in found):
            rows.append(f"| **{group}** |" + " |" * (_HEAD.count("|") - 2))
        for variant, values in found:
            if values is None or first is None:
                continue
            medians = [
                f"{values[name]:.3f} ({values[name] / first[name]:.2f})" for name in ("full_median", "thin_median")
            ]
            within = [f"{100 * values[name]:.1f} %" for name in ("full_within", "thin_within")]
            cells = [variant.title, medians[0], within[0], medians[1], within[1]]
            rows.append(f"| {' | '.join(cells)} | {values['error']:.3f} | {values['minutes']:.1f} |")
    return rows


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [variant.name for variants in GROUPS.values() for variant in variants]
    parser.add_argument("--variants", nargs="+", choices=names, default=names, help="(default: all)")
    parser.add_argument("--processes", type=int, default=1, help="trainings at a time (default: %(default)s)")
    parser.add_argument("--folder", type=Path, default=Path("runs/ablations"), help="(default: %(default)s)")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="settings of all trainings")
    parser.add_argument("-o", "--output", type=Path, help="Markdown page with the table (default: print it)")
    return parser.parse_args()


def main() -> None:
    """Train what is missing, then write the table."""
    given = arguments()
    given.folder.mkdir(parents=True, exist_ok=True)
    variants = [v for group in GROUPS.values() for v in group if v.name in given.variants]
    with ThreadPoolExecutor(given.processes) as pool:
        list(pool.map(lambda variant: train(variant, given.folder, given.set), variants))
    rows = table(given.folder)
    if given.output is None:
        print("\n".join(rows))
        return
    commits = sorted({values["commit"] for v in variants if (values := figures(given.folder, v)) is not None})
    page = [
        "# What each part is worth", "", *(__doc__ or "").strip().splitlines()[:5], "",
        "Medians are in spacings of the line cloud's own points (the clouds have at most 3,000 lines), in brackets as",
        "ratios to the first row. The second row shows how much of a difference is chance.", "",
        *rows, "", f"Trained at commit {', '.join(commits)}.", "",
    ]  # fmt: skip
    with atomic_file(given.output, overwrite=True) as file:
        file.write("\n".join(page).encode())


if __name__ == "__main__":
    main()
