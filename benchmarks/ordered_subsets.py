"""Do ordered subsets (OSEM) pay? Accuracy and time of the tomographic modes for passes x subsets at each level.

    python benchmarks/ordered_subsets.py

The lines of a lifted cloud are in random order, so that a run of rows is a random subset.
"""

from __future__ import annotations

import argparse
import time
from functools import partial

import numpy as np
import torch
from torch import Tensor

import l2p
from l2p import tomography
from l2p.frame import Frame
from l2p.lifting import lift_indexed
from l2p.metrics import spacing
from l2p.octree import smooth
from l2p.sharding import Shards
from l2p.tomography import TomographyConfig

#: Passes over the lines at each level, and subsets in each pass.
PLANS = ((4, 1), (2, 1), (2, 2), (1, 4), (2, 4), (1, 8))


def subset_update(
    subsets: int, level: tomography._Level, density: Tensor, config: TomographyConfig, _: Shards
) -> Tensor:
    """An update from each subset in turn, its mass scaled up to that of all lines."""
    for rows in torch.arange(len(level.cell)).tensor_split(subsets):
        part = level._replace(cell=level.cell[rows[0] : rows[-1] + 1])
        mass = tomography._back_projection(part, density) * (len(level.cell) / len(part.cell))
        mass = smooth(mass, level.cells[-1], config.smoothing)
        density = tomography._shrink(mass, level.cells, level.shape, config.shrinkage)
    return density


def main() -> None:
    """Print one row a plan: the geometric mean over simulated scenes of the modes' median error, and the time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=["room", "facade", "object"], help="(default: %(default)s)")
    parser.add_argument("--lines", type=int, default=10_000, help="lines of each scene (default: %(default)s)")
    given = parser.parse_args()
    torch.set_num_threads(1)
    print("| passes | subsets | median (spacings) | within 1 | seconds |\n|---:|---:|---:|---:|---:|")
    for passes, subsets in PLANS:
        tomography._update = partial(subset_update, subsets)
        medians, shares, seconds = [], [], 0.0
        for kind in given.kinds:
            xyz = l2p.simulate(kind, points=given.lines, seed=0).xyz
            cloud, index = lift_indexed(xyz, 0, 1.0)
            frame = Frame.of(cloud)
            began = time.perf_counter()
            with torch.inference_mode():
                beta = tomography.modes(
                    tomography.reconstruct(frame.enter(cloud), TomographyConfig(iterations=passes))
                )[0]
            seconds += time.perf_counter() - began
            error = np.linalg.norm(cloud.at(frame.leave(cloud, beta)) - xyz[index], axis=1) / spacing(xyz)
            medians.append(np.median(error))
            shares.append((error < 1).mean())
        median = np.exp(np.mean(np.log(medians)))
        print(f"| {passes} | {subsets} | {median:.3f} | {100 * np.mean(shares):.1f} % | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
