"""Measure what two releases of a map give away, nobody knowing which lines belong together.

    python benchmarks/releases.py ../shared/maps/val/* ../shared/scenes/val/room_chair.npz

Lifts each map twice, with other directions and other points, at pairs of fractions, with coordinates as they are,
rounded to single precision and to 3 decimals, and attacks both releases together by their lines alone
(:func:`l2p.recover_releases`). Prints the median error of the points of the first release in spacings of the map, of
all and of those whose point the second release has too, the shares within 0.02 and 1 spacing, the mean confidence, the
share of lines that meet, the share that has a partner, and seconds on one thread. ``--descriptors`` also publishes the
descriptors beside the model.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from harness import print_table

import l2p
from l2p.io.descriptors import load_described
from l2p.io.kinds import Kind, kind_of
from l2p.judging.accuracy import errors, spacing

PAIRS = ("1/1", "0.5/0.5", "0.5/0.3")
HEADS = ["map", "points", "fractions", "rounded", "median", "of partners", "in .02", "in 1", "confidence", "met"]
HEADS += ["partners", "seconds"]


def rounded(points: np.ndarray, lattice: str) -> np.ndarray:
    """Round points to ``single`` precision or to a number of decimals; leave them for ``none``."""
    if lattice == "single":
        return points.astype(np.float32).astype(np.float64)
    return points if lattice == "none" else np.round(points, int(lattice))


def measured(scene: l2p.Scene, fractions: tuple[float, ...], descriptors: bool) -> list[str]:
    """Attack releases of these fractions together; return the figures of the first."""
    hidden = [
        l2p.hide(scene, seed=seed, fraction=share, descriptor=descriptors) for seed, share in enumerate(fractions)
    ]
    truth = hidden[0].truth
    found = l2p.recover_releases([each.map for each in hidden], fraction=fractions[0])
    error = errors(found, truth) / spacing(scene.xyz)
    partner = np.isin(truth.index, np.concatenate([each.truth.index for each in hidden[1:]]))
    medians = [f"{np.median(each):.2g}" if len(each) else "-" for each in (error, error[partner])]
    shares = [np.mean(error <= 0.02), np.mean(error <= 1), found.confidence.mean(), found.info["met"] / len(truth)]
    return [*medians, *(f"{share:.3f}" for share in (*shares, partner.mean())), f"{found.info['seconds']:.1f}"]


def main() -> None:
    """Print one row per map, pair of fractions and rounding."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", help="COLMAP models, PLY or npz")
    parser.add_argument("--fractions", nargs="+", default=PAIRS, metavar="F/F", help="(default: %(default)s)")
    parser.add_argument(
        "--rounded", nargs="+", default=["none", "single", "3"], help="none, single or decimals (default: %(default)s)"
    )
    parser.add_argument("--descriptors", action="store_true", help="publish the descriptors, too")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for path in given.maps:
        described = given.descriptors and kind_of(path) is Kind.SCENE_MODEL
        scene = load_described(path, None)[0] if described else l2p.load(path)
        assert isinstance(scene, l2p.Scene)
        for lattice in given.rounded:
            moved = l2p.Scene(
                rounded(scene.xyz, lattice), descriptor=scene.descriptor, descriptor_kind=scene.descriptor_kind
            )
            for pair in given.fractions:
                shares = tuple(float(share) for share in pair.split("/"))
                name, figures = Path(path).stem, measured(moved, shares, given.descriptors)
                rows.append([name, f"{len(scene):,}", pair, lattice, *figures])
                print(*rows[-1], flush=True)
    print_table(f"{len(given.maps)} maps", HEADS, rows)


if __name__ == "__main__":
    main()
