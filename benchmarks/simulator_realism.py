"""Do simulated scenes behave like real SfM models? Geometry and attack errors of both, side by side.

    python benchmarks/simulator_realism.py --scenes ../shared/scenes --out docs/simulator.md

Real scenes are read from the folders ``val`` and ``train`` of ``--scenes`` (npz with ``xyz``). The simulator was tuned
on ``train`` only. Figures of every scene are written to ``<out>.csv`` beside the table.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

import l2p
from l2p.judging.accuracy import spacing
from l2p.judging.scores import evaluate
from l2p.simulator import KINDS

TEXT = """# The simulator, and how real it is

`l2p.simulate(kind, points, seed)` makes the sparse points of an SfM model without any data: a room, objects on a
table, a facade, a street, or terrain seen by a drone. It is the data of everything that must run without downloads.

![One simulated scene of each kind](images/simulator.png)

## How it works

1. A *layout* builds textured rectangles, boxes, ellipsoids, cylinders and balls of leaves, and a camera path: a walk,
   orbits, an arc on foot, a drive, a drone's grid.
2. *Texture* is some ten thousand small structures on the surfaces: blobs, strokes, outlines, corners, in clusters whose
   sizes and weights are log-normal. Paint has almost none, print has many.
3. A *keypoint* is drawn by the image area that its structure covers (not by its area in the world), so what the
   cameras look at gets most points and the far background few. It gets a reference image and is matched in images that
   see it from a similar direction and distance, unless a body hides it there. At least two images must agree.
4. Each observation gets pixel noise; the point is the *least-squares* point of its observations, and COLMAP's filters
   apply (4 pixels, 1.5 degrees). So the noise is not a model: it is long along the viewing rays, grows with depth over
   baseline and falls with the length of the track. A few matches are wrong along the epipolar line and become floaters.

`l2p.simulator.simulate_model` returns the observations, too, and writes a COLMAP model that pycolmap reads back.

## Comparison with real models

Written by `{{COMMAND}}`, which also writes the figures of every scene to `simulator.csv`. Real
clouds have the arrays of `../shared/scenes`; the simulator was tuned on `train` only. Of every scene at most
{{POINTS}} random points are taken, and these are then the whole scene. A real scene stands in the row of the kind
that is nearest to it. A single seed of lines is used.

- *nearest*: median distance to the nearest neighbour over the diagonal of the 1 to 99 % box;
- *spread of density*: 90 % over 10 % quantile of the distance to the 10th neighbour; *log density, std*: standard
  deviation of its logarithm; *isolated*: share of points where it is over 5 times the median;
- *planarity*: median of (l2 - l3) / l1, l1 >= l2 >= l3 the standard deviations of a point and its 16 neighbours;
- *errors* in spacings (median distance to the 50th neighbour); *share < 1*: share of points within one spacing.

{{RANGES}}

{{OUTSIDE}}

Simulated scenes of one kind are more alike than real ones: three seeds do not span the range of real captures, and
failed poses, drift and rolling shutter are not simulated.

### Every scene

{{SCENES}}
"""

#: Real scenes of the table and the simulated kind that each is compared with.
REAL = {
    "room": (
        "val/office_lounge", "val/livingroom_statue", "val/room_chair", "val/lockers_room", "val/church_interior",
        "val/bulletin_wall", "train/room_ultraman", "train/furnished_room_pyramidify", "train/corridor_plants",
        "train/desk_dorm",
    ),
    "object": (
        "val/tabletop_posters", "val/mip360_bicycle", "train/helmet_desk", "train/cup_desk", "train/coffee_cup",
        "train/stitch_toy_table",
    ),
    "facade": (
        "val/strecha_fountain_p11", "val/strecha_castle_p30", "val/statue_of_liberty", "train/strecha_herzjesus_p25",
        "train/south_building", "train/campus_planes",
    ),
    "street": ("train/street_dashcam_1", "train/street_dashcam_2", "train/street_dashcam_3", "train/garden_bed"),
    "terrain": ("val/aerial_city", "train/aerial_mapfree", "train/aerial_sports", "train/aerial_crop"),
}  # fmt: skip


@dataclass(frozen=True)
class Column:
    """A measure: its key, its heading and how it is printed."""

    key: str
    heading: str
    form: str


GEOMETRY = (
    Column("nearest", "nearest / diagonal, 1e-3", ".2f"),
    Column("spread", "spread of density", ".1f"),
    Column("deviation", "log density, std", ".2f"),
    Column("planarity", "planarity", ".2f"),
    Column("isolated", "isolated, %", ".1f"),
)
ATTACK = (
    Column("heuristic_median", "heuristic, median", ".2f"),
    Column("heuristic_share", "share < 1", ".2f"),
    Column("oracle_median", "oracle(50), median", ".2f"),
    Column("oracle_share", "share < 1", ".2f"),
    Column("loo_median", "LOO, median", ".2f"),
    Column("loo_share", "share < 1", ".2f"),
)


def geometry(points: Float[np.ndarray, "points 3"]) -> dict[str, float]:
    """Measures of the cloud alone; the diagonal is that of the 1 to 99 % percentiles."""
    from scipy.spatial import KDTree

    diagonal = float(np.linalg.norm(np.subtract(*np.percentile(points, [99, 1], axis=0))))
    distance, index = KDTree(points).query(points, 17)
    tenth = np.maximum(distance[:, 10], 1e-12)
    near = points[index] - points[index].mean(axis=1, keepdims=True)
    variance = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", near, near))
    axis = np.sqrt(np.maximum(variance, 0))  # (points, 3), ascending
    return {
        "nearest": 1e3 * float(np.median(distance[:, 1])) / diagonal,
        "spread": float(np.percentile(tenth, 90) / np.percentile(tenth, 10)),
        "deviation": float(np.std(np.log(tenth))),
        "planarity": float(np.median((axis[:, 1] - axis[:, 0]) / np.maximum(axis[:, 2], 1e-12))),
        "isolated": 100 * float(np.mean(tenth > 5 * np.median(tenth))),
    }


def attack(points: Float[np.ndarray, "points 3"]) -> dict[str, float]:
    """Median error in spacings and share within one spacing of the heuristic, oracle(50) and the LOO bound."""
    from l2p.attacks.heuristic import Heuristic
    from l2p.attacks.run import run
    from l2p.judging.references import LeaveOneOut, Oracle

    hidden = l2p.hide(points, seed=0)
    lines, index = hidden.map, hidden.truth.index
    truth = points[index]
    methods: dict[str, Callable] = {
        "heuristic": Heuristic, "oracle": lambda: Oracle(truth, k=50), "loo": lambda: LeaveOneOut(truth),
    }  # fmt: skip
    figures = {}
    for name, method in methods.items():
        scores = evaluate(run(lines, method()), truth, spacing(points))
        figures[f"{name}_median"] = scores.median_spacings
        figures[f"{name}_share"] = scores.within_spacings["1"]
    return figures


def simulated_rows(points: int, seeds: int) -> Iterator[dict]:
    """One row of figures for each simulated scene."""
    for kind in KINDS:
        for seed in range(seeds):
            yield row(kind, "simulated", f"seed {seed}", l2p.simulate(kind, points=points, seed=seed).xyz, points)


def real_rows(scenes: Path, points: int) -> Iterator[dict]:
    """One row of figures for each real scene that is there."""
    for kind, names in REAL.items():
        for name in names:
            path = scenes / f"{name}.npz"
            if path.exists():
                xyz = np.load(path)["xyz"].astype(np.float64)
                yield row(kind, path.parent.name, path.stem, xyz, points)
            else:
                print(f"{path} is absent: left out", file=sys.stderr)


def row(kind: str, source: str, name: str, xyz: Float[np.ndarray, "points 3"], points: int) -> dict:
    """The figures of a random subset of at most ``points`` points of a scene."""
    began = time.perf_counter()
    chosen = xyz[np.random.default_rng(0).permutation(len(xyz))[:points]]
    figures = {"kind": kind, "source": source, "name": name, "N": len(xyz)} | geometry(chosen) | attack(chosen)
    print(f"{kind:8} {source:9} {name:26} {time.perf_counter() - began:5.1f} s", file=sys.stderr)
    return figures


def kept_rows(path: Path) -> list[dict]:
    """The rows of real scenes that an earlier run wrote to ``path``."""
    with path.open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["source"] != "simulated"]
    text = ("kind", "source", "name")
    return [{k: v if k in text else float(v) for k, v in r.items()} | {"N": int(r["N"])} for r in rows]


def write_rows(path: Path, rows: list[dict]) -> None:
    """Write all figures as CSV."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in r.items()} for r in rows)


def spans(rows: list[dict], columns: tuple[Column, ...]) -> list[str]:
    """Minimum to maximum of each column."""
    return [f"{min(r[c.key] for r in rows):{c.form}} .. {max(r[c.key] for r in rows):{c.form}}" for c in columns]


def table(head: list[str], body: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def range_tables(rows: list[dict]) -> str:
    """Ranges by kind, real above simulated, for geometry and attack."""
    parts = []
    for title, columns in (("Geometry", GEOMETRY), ("Attack, errors in spacings", ATTACK)):
        body = []
        for kind in (*KINDS, "all"):
            for source in ("real", "simulated"):
                chosen = [
                    r for r in rows if kind in (r["kind"], "all") and (r["source"] == "simulated") == (source != "real")
                ]
                if chosen:
                    body.append([kind, source, str(len(chosen)), *spans(chosen, columns)])
        parts.append(f"### {title}\n\n" + table(["kind", "", "scenes", *(c.heading for c in columns)], body))
    return "\n\n".join(parts)


def outside(rows: list[dict]) -> str:
    """What is not within the range of the real scenes of its kind, in a list."""
    real, simulated = ([r for r in rows if (r["source"] == "simulated") == own] for own in (False, True))
    lines, count = [], 0
    for kind in KINDS:
        for column in (*GEOMETRY, *ATTACK):
            peers = [r[column.key] for r in real if r["kind"] == kind]
            values = [r[column.key] for r in simulated if r["kind"] == kind]
            out = [v for v in values if peers and not min(peers) <= v <= max(peers)]
            count += len(out)
            if out:
                everything = [r[column.key] for r in real]
                far = sum(not min(everything) <= v <= max(everything) for v in out)
                lines.append(
                    f"- {kind}, {column.key.replace('_', ' ')}: {', '.join(f'{v:{column.form}}' for v in out)}; real "
                    f"{min(peers):{column.form}} .. {max(peers):{column.form}}; "
                    + (f"{far} outside the range of all real scenes, too" if far else "within that of all real scenes")
                )
    total = len(simulated) * len((*GEOMETRY, *ATTACK))
    return (
        f"{count} of {total} simulated figures lie outside the range of the real scenes of their kind:\n\n"
        + "\n".join(lines)
    )


def scene_table(rows: list[dict]) -> str:
    """Every scene on its own line."""
    columns = (*GEOMETRY, *ATTACK)
    body = [[r["kind"], r["source"], r["name"], str(r["N"]), *(f"{r[c.key]:{c.form}}" for c in columns)] for r in rows]
    return table(["kind", "from", "scene", "N", *(c.heading for c in columns)], body)


def document(rows: list[dict], command: str, points: int) -> str:
    """The whole of docs/simulator.md."""
    text = TEXT
    fill = {
        "COMMAND": command, "POINTS": f"{points:,}".replace(",", " "), "RANGES": range_tables(rows),
        "OUTSIDE": outside(rows), "SCENES": scene_table(rows),
    }  # fmt: skip
    for key, value in fill.items():
        text = text.replace("{{" + key + "}}", value)
    return text


def picture(path: Path, points: int) -> None:
    """One simulated scene of each kind: from above, from the side and the dense middle."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(KINDS), figsize=(4 * len(KINDS), 6), constrained_layout=True)
    for column, kind in enumerate(KINDS):
        scene = l2p.simulate(kind, points=points, seed=1)
        assert scene.rgb is not None and scene.camera_centers is not None
        low, high = np.percentile(scene.xyz, [1.5, 98.5], axis=0)
        seen = ((scene.xyz >= low) & (scene.xyz <= high)).all(axis=1)
        for row, (a, b) in enumerate(((0, 1), (0, 2))):
            axis = axes[row, column]
            axis.scatter(scene.xyz[seen, a], scene.xyz[seen, b], s=0.5, c=scene.rgb[seen] / 255, linewidths=0)
            axis.scatter(*scene.camera_centers[:, [a, b]].T, s=3, c="tab:red", marker="^", linewidths=0)
            axis.set(aspect="equal", xticks=[], yticks=[], title=f"{kind}, {('from above', 'from the side')[row]}")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenes", type=Path, default=Path("../shared/scenes"), help="real scenes (default: %(default)s)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("docs/simulator.md"), help="Markdown to write (default: %(default)s)"
    )
    parser.add_argument("--points", type=int, default=12_000, help="points of a scene at most (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=3, help="simulated scenes of a kind (default: %(default)s)")
    parser.add_argument(
        "--keep-real", action="store_true", help="take the real scenes' figures from the CSV of an earlier run"
    )
    return parser.parse_args()


def main() -> None:
    """Measure, then write the document, the figures and the picture."""
    given = arguments()
    figures = given.out.with_suffix(".csv")
    given.out.parent.mkdir(parents=True, exist_ok=True)
    rows = kept_rows(figures) if given.keep_real else list(real_rows(given.scenes, given.points))
    write_rows(figures, rows)
    rows += simulated_rows(given.points, given.seeds)
    write_rows(figures, rows)
    command = f"python benchmarks/simulator_realism.py --scenes {given.scenes} --out {given.out}"
    given.out.write_text(document(rows, command, given.points))
    picture(given.out.parent / "images" / "simulator.png", 20_000)


if __name__ == "__main__":
    main()
