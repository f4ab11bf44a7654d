"""Audit one map step by step: how much is recovered from its lines? python examples/audit_a_map.py -o report

Without a map, a room is simulated. `l2p audit` writes a full report; this example shows the steps to build on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float

import l2p
from l2p.judging.accuracy import errors, spacing
from l2p.show.colors import ERROR_LIMIT

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def main() -> None:
    """Lift, recover, evaluate, and write a picture and the recovered points."""
    arguments = _arguments()
    folder = Path(arguments.output)
    folder.mkdir(parents=True, exist_ok=True)

    # The map, which its owner has: points (points, 3), here in metres.
    if arguments.map is None:
        scene = l2p.simulate("room", points=arguments.points, seed=0)
    else:
        scene = l2p.load(arguments.map, l2p.Scene)
    unit = spacing(scene.xyz)

    # The line cloud would be published. The truth (the point behind each line) stays with the owner.
    hidden = l2p.hide(scene, fraction=arguments.fraction)
    l2p.save(hidden.map, folder / "lines.npz", overwrite=True)

    # The attack: anybody can compute this from the lines.
    recovery = l2p.recover(hidden.map, method=arguments.method)
    l2p.save(recovery, folder / "recovered.ply", overwrite=True)

    # The scores: only the owner, who has the truth, can compute them.
    scores = l2p.evaluate(recovery, hidden.truth, unit)
    print(f"{scores.lines} lines, spacing {unit:.3g}")
    print(f"median error: {scores.median:.3g}, which is {scores.median_spacings:.2f} spacings")
    print(f"within 1 spacing: {scores.within_spacings['1']:.0%} of all points,", end=" ")
    print(f"{scores.confident_half:.0%} of the most confident half")

    draw(folder / "audit.png", hidden.truth.xyz, recovery.xyz, errors(recovery, hidden.truth) / unit)
    print(f"Look at {folder / 'audit.png'}, and at {folder / 'recovered.ply'} in any viewer.")


def draw(
    file: Path,
    truth: Float[np.ndarray, "lines 3"],
    recovered: Float[np.ndarray, "lines 3"],
    error: Float[np.ndarray, " lines"],
) -> None:
    """Draw the true points beside the recovered ones, along the two longest axes of the map; ``error`` in spacings."""
    # Inner points only: a few far ones would turn and shrink the picture.
    centre = np.median(truth, axis=0)
    distance = np.linalg.norm(truth - centre, axis=1)
    inner = truth[distance <= 2 * np.median(distance)] - centre
    axes = np.linalg.svd(inner, full_matrices=False)[2][:2]
    true_place, place = (truth - centre) @ axes.T, (recovered - centre) @ axes.T
    low, high = (inner @ axes.T).min(axis=0), (inner @ axes.T).max(axis=0)
    margin = 0.1 * (high - low)
    figure, panels = plt.subplots(1, 2, figsize=(12, 5.5), layout="constrained", sharex=True, sharey=True)
    panels[0].scatter(*true_place.T, s=3, color="0.35", linewidths=0)
    panels[0].set_title("the map")
    # Small errors on top.
    order = np.argsort(-error)
    shown = panels[1].scatter(
        *place[order].T, s=3, c=error[order], cmap="viridis_r", vmin=0, vmax=ERROR_LIMIT, linewidths=0
    )
    panels[1].set_title("recovered from its line cloud")
    for panel in panels:
        panel.set(xlim=(low[0] - margin[0], high[0] + margin[0]), ylim=(low[1] - margin[1], high[1] + margin[1]))
        panel.set_aspect("equal")
        panel.set_axis_off()
    figure.colorbar(shown, ax=panels, label="error (spacings)", extend="max")
    figure.savefig(file, dpi=120)
    plt.close(figure)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("map", nargs="?", metavar="MAP", help="COLMAP model folder, PLY or npz (default: a room)")
    parser.add_argument("-o", dest="output", default="audit-output", metavar="DIR", help="default: %(default)s")
    parser.add_argument("--method", default="learned", help="learned, tomography or heuristic (default: %(default)s)")
    parser.add_argument("--fraction", type=float, default=1.0, help="fraction of the points (default: %(default)s)")
    parser.add_argument("--points", type=int, default=3000, help="of the simulated room (default: %(default)s)")
    return parser.parse_args()


if __name__ == "__main__":
    main()
