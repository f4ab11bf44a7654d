"""How close an EM update comes to what the machine can do: voxel visits a second against a bare gather + scatter.

    python benchmarks/voxel_visits.py --lines 50000 --threads 1

A visit is one sample of a line in one cell, read once (forward projection) and added to once (back projection). The
bare kernel reads and adds the same samples in the same cells, in one block and without normalising, so that it is
what memory allows in plain torch. Then the same update with what was tried to speed it up.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch
from torch import Tensor

import l2p
from l2p.attacks.tomography import reconstruct as tomography
from l2p.attacks.tomography.reconstruct import TomographyConfig
from l2p.geometry.frame import Frame
from l2p.work.shards import Shards


def level_of(lines: int, kind: str, levels: int) -> tuple[tomography._Level, Tensor]:
    """A level of the reconstruction of simulated lines and its density."""
    cloud = l2p.lift(l2p.simulate(kind, points=lines, seed=0).xyz, seed=0)
    found: list[tuple[tomography._Level, Tensor]] = []
    update = tomography._update

    def watched(level: tomography._Level, density: Tensor, config: TomographyConfig, _: Shards) -> Tensor:
        found[:] = [(level, update(level, density, config))]
        return found[0][1]

    tomography._update = watched
    tomography.reconstruct(Frame.of(cloud).enter(cloud), TomographyConfig(levels=levels))
    tomography._update = update
    return found[0]


def bare(cell: Tensor, density: Tensor) -> Tensor:
    """One gather and one scatter of all samples."""
    return torch.zeros_like(density).index_add_(0, cell, density.index_select(0, cell))


def rate(work: Callable[[], Tensor], visits: int, repeats: int) -> float:
    """Million visits a second, the best of some runs."""
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return visits / min(seconds[1:]) / 1e6


def variants(level: tomography._Level, density: Tensor) -> dict[str, Callable[[], Tensor]]:
    """The update and its parts, and what was tried."""
    cell, padded = level.cell, tomography._padded(density)
    flat, wide = cell.flatten(), cell.flatten().long()
    first = cell[
        torch.argsort(cell.gather(1, tomography._along(level, density, slice(None)).argmax(1, keepdim=True))[:, 0])
    ]
    ordered = level._replace(cell=first)
    config = TomographyConfig()

    def unblocked() -> Tensor:
        along = padded.index_select(0, flat).view(cell.shape)
        share = along / along.sum(dim=1, keepdim=True).clamp_min(1e-30)
        return torch.zeros_like(padded).index_add_(0, flat, share.flatten())

    compiled = torch.compile(unblocked)
    return {
        "bare gather + scatter, int32 cells": lambda: bare(flat, padded),
        "bare, int64 cells": lambda: bare(wide, padded),
        "bare, lines sorted by the cell of their mode": lambda: bare(first.flatten(), padded),
        "bare, float64 mass": lambda: bare(flat, padded.double()),
        "bare, scatter by bincount": lambda: torch.bincount(wide, padded[wide], len(padded)),
        "bare, scatter_add_": lambda: torch.zeros_like(padded).scatter_add_(0, wide, padded[wide]),
        "projection and back projection": lambda: tomography._back_projection(level, density),
        "the same, lines sorted by the cell of their mode": lambda: tomography._back_projection(ordered, density),
        "the same, not in blocks": unblocked,
        "the same, torch.compile": compiled,
        "whole update with the prior": lambda: tomography._update(level, density, config),
    }


def main() -> None:
    """Print a table of rates and ratios to the bare kernel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, default=50_000, help="simulated lines (default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--levels", type=int, default=7, help="levels before the one timed (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=5, help="runs, the best counts (default: %(default)s)")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    with torch.inference_mode():
        level, density = level_of(given.lines, given.kind, given.levels)
        visits = level.cell.numel()
        print(f"{visits} samples in {len(density)} cells, {given.threads} thread(s)\n")
        print("| kernel | million visits / s | ratio to the bare kernel |\n|---|---:|---:|")
        reference = None
        for name, work in variants(level, density).items():
            try:
                found = rate(work, visits, given.repeats)
            except Exception as error:  # torch.compile needs a C++ compiler
                print(f"| {name} | failed: {type(error).__name__} | |")
                continue
            reference = reference or found
            print(f"| {name} | {found:.0f} | {found / reference:.2f} |", flush=True)


if __name__ == "__main__":
    main()
