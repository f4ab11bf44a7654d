"""Directions that resist: what attacks recover of them, and how well cameras are localized in them.

    python benchmarks/resisting.py ../shared/maps/val/{office_lounge,plant_livingroom}
    python benchmarks/resisting.py ../shared/maps/val/{office_lounge,plant_livingroom,strecha_entry_p10} --fraction 0.1

Each map is hidden by uniform lines and by the schemes that choose directions (docs/schemes.md). Shares of points
within 1 spacing: of the learned attack as if lines were uniform, by lines alone and with colours and descriptors; of
the same, told the scheme, where it has an attack for it (lines with a false place); of the heuristic by lines alone.
Bounds: the point of least squared distance to the lines of the 25 true nearest points ("neighbours"), and
leave-one-out. Confidence: its mean by lines alone. Stated: whether it is called a probability where the file names the
scheme / names uniform. Localized: images by p6L with 30 % wrong matches, median position in percent of the cameras'
extent, and the share within 0.5 %. Last rows: means over the maps, of positions the geometric one.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from harness import print_table

import l2p
from l2p.attacks.run import run
from l2p.io.descriptors import load_described
from l2p.judging.accuracy import errors, spacing
from l2p.judging.measure import geometric_mean
from l2p.judging.references import LeaveOneOut, Oracle
from l2p.schemes.recognition import FALSE_PLACES, recognise
from l2p.schemes.scheme import DEFAULT_SCHEME
from l2p.utility.localization import Localized
from l2p.utility.queries import Queries
from l2p.utility.releases import LocalizeConfig, Release, localized, read_queries

SCHEMES = (DEFAULT_SCHEME, "spread-votes", "decoys", "through-dense")
#: Largest error of a localized image, as a share of the cameras' extent.
CLOSE = 0.005
HEADS = ["map", "lines", "scheme", "alone", "+ both", "told, alone", "told, + both", "heuristic", "neighbours"]
HEADS += ["left out", "confidence", "stated", "position, %", "localized"]


class Row(NamedTuple):
    """Figures of one map and scheme; NaN where there is none."""

    alone: float
    both: float
    told_alone: float
    told_both: float
    heuristic: float
    neighbours: float
    left_out: float
    confidence: float
    stated_told: bool
    stated: bool
    position: float
    localized: float

    def cells(self) -> list[str]:
        """The figures as text."""
        shares = [f"{value:.3f}" if value == value else "-" for value in self[:7]]
        stated = " / ".join("yes" if each else "no" for each in (self.stated_told, self.stated))
        return [*shares, f"{self.confidence:.2f}", stated, f"{100 * self.position:.3f}", f"{self.localized:.2f}"]


def measured(
    scene: l2p.Scene, queries: Queries, unit: float, scheme: str, fraction: float, seed: int, images: int
) -> Row:
    """Hide a map by a scheme, attack it, and localize in it."""
    hidden = l2p.hide(scene, seed, fraction, scheme, rgb=True, descriptor=True)
    lines, truth = hidden.map, hidden.truth

    def within(recovery: l2p.Recovery) -> float:
        return float((errors(recovery, truth) <= unit).mean())

    untold, seen = replace(lines, scheme=DEFAULT_SCHEME), {"rgb", "descriptor"}
    bare, named = untold.without(seen), recognise(lines)
    alone, told = l2p.recover(bare, fraction=fraction), [float("nan")] * 2
    if named.scheme == FALSE_PLACES:
        told = [within(l2p.recover(each, fraction=fraction)) for each in (lines.without(seen), lines)]
    trial = _localized(queries, Release.of_lines(hidden, fraction, len(scene)), seed, images)
    position = np.array([each.position for each in trial.attempts]) / queries.extent
    return Row(
        within(alone),
        within(l2p.recover(untold, fraction=fraction)),
        told[0],
        told[1],
        within(l2p.recover(bare, "heuristic", fraction=fraction)),
        within(run(bare, Oracle(truth.xyz, 25, rule="least_squares"))),
        within(run(bare, LeaveOneOut(truth.xyz))),
        float(alone.confidence.mean(dtype=np.float64)),
        named.expected,
        alone.calibrated,
        float(np.median(position)),
        float((position <= CLOSE).mean()),
    )


def _localized(queries: Queries, release: Release, seed: int, images: int) -> Localized:
    (trial,) = localized(queries, [release], LocalizeConfig(wrong=(0.3,), most_queries=images, seed=seed))
    return trial


def mean_of(rows: list[Row]) -> Row:
    """Means over maps; a probability is stated if it is for any map."""
    columns = dict(zip(Row._fields, zip(*rows, strict=True), strict=True))
    means = {name: float(np.mean(values)) for name, values in columns.items()}
    stated = {name: any(columns[name]) for name in ("stated_told", "stated")}
    return Row(**{**means, **stated, "position": geometric_mean(columns["position"])})


def main() -> None:
    """Print a row for each map and scheme, and the means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", type=Path, help="COLMAP models with descriptors")
    parser.add_argument("--schemes", nargs="+", default=SCHEMES, metavar="SCHEME", help="default: %(default)s")
    parser.add_argument("--fraction", type=float, default=1.0, help="share of the points (default: 1)")
    parser.add_argument("--images", type=int, default=6, help="images localized in each map (default: 6)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[str, list[Row]] = {scheme: [] for scheme in given.schemes}
    lines = []
    for path in given.maps:
        scene = load_described(path)[0]
        queries, unit = read_queries(path)[1], spacing(scene.xyz)
        for scheme in given.schemes:
            row = measured(scene, queries, unit, scheme, given.fraction, given.seed, given.images)
            found[scheme].append(row)
            lines.append([path.name, f"{round(given.fraction * len(scene)):,}", scheme, *row.cells()])
            print(*lines[-1], sep="\t", flush=True)
    lines += [["mean", "", scheme, *mean_of(rows).cells()] for scheme, rows in found.items()]
    print_table(f"{len(given.maps)} maps, {given.fraction:.0%} of the points", HEADS, lines)


if __name__ == "__main__":
    main()
