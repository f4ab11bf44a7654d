"""The picture of docs/experiments.md: a density from back projection to convergence, beside the true cloud.

    python benchmarks/tomography_picture.py -o docs/images/tomography.png

Each panel is the greatest density along the line of sight, from above and from the side, of a simulated scene.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

import l2p
from l2p.frame import Frame
from l2p.geometry import Lines
from l2p.tomography import Density, TomographyConfig, tomogram

#: Levels that are shown after the back projection.
LEVELS = (1, 2, 3, 4, 6)
#: Panel sides and samples along the line of sight.
PIXELS, DEPTH = 220, 160
#: Decades of density between black and white.
DECADES = 2.5


def stages(lines: Lines) -> list[tuple[str, Density]]:
    """Back projection (one update of an even density, no prior), then the levels."""
    simple = TomographyConfig(start=64, levels=1, iterations=1, smoothing=0.0, shrinkage=0.0)
    found = [("back projection", tomogram(lines, simple)[1])]
    for levels in LEVELS:
        density = tomogram(lines, TomographyConfig(levels=levels, crowd=0.0))[1]
        found.append((f"EM, cells of 1/{density.cells[-1].side}", density))
    return found


def view(density: Density, low: Tensor, high: Tensor, axis: int) -> np.ndarray:
    """The greatest logarithm of the density along an axis of the scene."""
    counts = [PIXELS, PIXELS, PIXELS]
    counts[axis] = DEPTH
    places = [torch.linspace(float(low[i]), float(high[i]), counts[i]) for i in range(3)]
    grid = torch.stack(torch.meshgrid(*places, indexing="ij"), dim=-1)
    parts = [density.log_at(part) for part in grid.view(-1, 3).split(1 << 20)]
    return torch.cat(parts).view(*counts).amax(dim=axis).numpy()


def draw(lines: Lines, truth: np.ndarray, path: Path) -> None:
    """One column a stage, the true points last."""
    low, high = (torch.tensor(np.quantile(truth, q, axis=0)).float() for q in (0.03, 0.97))
    shown = stages(lines)
    size = (high - low).tolist()
    ratios = [size[1] / size[0], size[2] / size[0]]
    columns = len(shown) + 1
    figure, panels = plt.subplots(
        2, columns, figsize=(2.3 * columns, 2.3 * sum(ratios) + 0.4), height_ratios=ratios, facecolor="white"
    )
    for row, (axis, across, up) in enumerate(((2, 0, 1), (1, 0, 2))):
        extent = (float(low[across]), float(high[across]), float(low[up]), float(high[up]))
        for panel, (title, density) in zip(panels[row], shown, strict=False):
            image = view(density, low, high, axis).T
            top = np.quantile(image, 0.999)
            panel.imshow(image, origin="lower", extent=extent, cmap="magma", vmin=top - DECADES * np.log(10), vmax=top)
            panel.set_title(title if row == 0 else "", fontsize=9)
        last = panels[row, -1]
        last.scatter(truth[:, across], truth[:, up], s=0.15, c="black", linewidths=0)
        last.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
        last.set_title("true points" if row == 0 else "", fontsize=9)
        panels[row, 0].set_ylabel(("one side", "another side")[row], fontsize=9)
    for panel in panels.flat:
        panel.set(xticks=[], yticks=[])
    figure.tight_layout(pad=0.4)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Simulate, lift, reconstruct, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images/tomography.png"))
    parser.add_argument("--kind", default="object", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--lines", type=int, default=20_000, help="simulated lines (default: %(default)s)")
    given = parser.parse_args()
    xyz = l2p.simulate(given.kind, points=given.lines, seed=0).xyz
    cloud = l2p.lift(xyz, seed=0)
    frame = Frame.of(cloud)
    with torch.inference_mode():
        draw(frame.enter(cloud), frame.enter_points(xyz).numpy(), given.output)


if __name__ == "__main__":
    main()
