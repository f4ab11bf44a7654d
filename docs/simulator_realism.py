"""Write docs/simulator.md: compare geometry and attack errors of simulated scenes with those of real SfM models.

    python docs/simulator_realism.py --scenes ../shared/scenes --out docs/simulator.md

Real scenes are read from the folders ``val`` and ``train`` of ``--scenes`` (npz with ``xyz``). The simulator was tuned
on ``train`` only. Some points of every scene are written to the folder of the run, where ``python -m eval`` attacks
them; a stopped run is continued. Figures of every scene are written to ``<out>.csv`` beside the table.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

import l2p
from l2p.simulator import KINDS

ROOT = Path(__file__).resolve().parents[1]

TEXT = """# The simulator, and how real it is

`l2p.simulate(kind, points, seed)` makes the sparse points of an SfM model without data: a room, objects on a table, a
facade, a street, or terrain seen by a drone.

![One simulated scene of each kind](images/simulator.png)

## How it works

1. A *layout* builds textured rectangles, boxes, ellipsoids, cylinders and balls of leaves, and a camera path.
2. *Texture* is some ten thousand small structures on the surfaces, in clusters.
3. A *keypoint* is drawn by the area of its structure in the image, so what the cameras look at gets most points. It is
   matched in images from a similar direction and distance, unless a body hides it. At least two images must agree.
4. Observations get pixel noise; the point is their *least-squares* point, filtered as in COLMAP (4 pixels, 1.5
   degrees). So errors are long along the viewing rays. A few matches are wrong along the epipolar line: floaters.

Points get the colour of their structure, and no descriptor: colours lack the texture that real neighbours share.
`python -m train` therefore learns geometry alone from simulated scenes.

## Comparison with real models

Written by `{{COMMAND}}`; every scene is in
[simulator.csv](simulator.csv). Real maps are in `../shared/scenes`, each in the row of the nearest kind; the simulator
was tuned on `train` only. Each scene is thinned to at most {{POINTS}} random points; one seed of lines.

- *nearest*: median distance to the nearest neighbour over the diagonal of the 1 to 99 % box;
- *spread of density*: 90 % over 10 % quantile of the distance to the 10th neighbour; *log density, std*: standard
  deviation of its logarithm; *isolated*: share of points where it is over 5 times the median;
- *planarity*: median of (l2 - l3) / l1, l1 >= l2 >= l3 the standard deviations of a point and its 16 neighbours;
- *errors* in spacings (median distance to the 50th neighbour); *share < 1*: points within one spacing.

{{RANGES}}

{{OUTSIDE}}

Simulated scenes of one kind are more alike than real ones; failed poses, drift and rolling shutter are not simulated.
"""

#: Real scenes of the table, by the simulated kind with which they are compared.
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
    """Measure: key, heading and printing function."""

    key: str
    heading: str
    form: str


#: Methods of the evaluation, by the first word of their columns.
METHODS = {"heuristic": "name: heuristic", "oracle": "name: oracle, k: 50", "loo": "name: loo"}
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
    """Measure the cloud alone; the diagonal is that of the box from the 1 % to the 99 % percentiles."""
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


def simulated_rows(points: int, seeds: int, folder: Path) -> Iterator[dict]:
    """Yield one row of geometry for each simulated scene."""
    for kind in KINDS:
        for seed in range(seeds):
            xyz = l2p.simulate(kind, points=points, seed=seed).xyz
            yield row(kind, "simulated", f"seed {seed}", xyz, points, folder / f"{kind}-{seed}.npz")


def real_rows(scenes: Path, points: int, folder: Path) -> Iterator[dict]:
    """Yield one row of geometry for each real scene that exists."""
    for kind, names in REAL.items():
        for name in names:
            path = scenes / f"{name}.npz"
            if path.exists():
                yield row(kind, path.parent.name, path.stem, l2p.load(path, l2p.Scene).xyz, points, folder / path.name)
            else:
                print(f"{path} is absent: left out", file=sys.stderr)


def row(kind: str, source: str, name: str, xyz: Float[np.ndarray, "points 3"], points: int, file: Path) -> dict:
    """Save a random subset of at most ``points`` points of a scene; return a row of its geometry."""
    chosen = xyz[np.random.default_rng(0).permutation(len(xyz))[:points]]
    np.savez(file, xyz=chosen)
    return {"kind": kind, "source": source, "name": name, "N": len(xyz), **geometry(chosen), "file": file.stem}


def with_attacks(rows: list[dict], folder: Path) -> list[dict]:
    """Add to the rows the errors of the heuristic, oracle(50) and the LOO bound, from one run of the evaluation."""
    run = folder.parent / "eval"
    methods = ",".join(f"{{{words}, label: {name}}}" for name, words in METHODS.items())
    keys = [f"scenes=[{folder}]", f"methods=[{methods}]", "fractions=[1.0]", "seeds=[0]", "threads=1", f"run={run}"]
    subprocess.run([sys.executable, "-m", "eval", *keys], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    for found in json.loads((run / "results.json").read_text())["rows"]:
        for each in rows:
            if each["file"] == found["scene"]:
                each[f"{found['method']}_median"] = found["median_spacings"]
                each[f"{found['method']}_share"] = found["within_1"]
    return [{name: value for name, value in each.items() if name != "file"} for each in rows]


def kept_rows(path: Path) -> list[dict]:
    """Read the rows of real scenes that an earlier run wrote to ``path``."""
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
    """Format a Markdown table."""
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def range_tables(rows: list[dict]) -> str:
    """Format ranges by kind, real above simulated, for geometry and attack."""
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
    """List the figures outside the range of the real scenes of their kind."""
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


def document(rows: list[dict], command: str, points: int) -> str:
    """Render docs/simulator.md."""
    text = TEXT
    fill = {
        "COMMAND": command, "POINTS": f"{points:,}".replace(",", " "), "RANGES": range_tables(rows),
        "OUTSIDE": outside(rows),
    }  # fmt: skip
    for key, value in fill.items():
        text = text.replace("{{" + key + "}}", value)
    return text


def picture(path: Path, points: int) -> None:
    """Draw one simulated scene of each kind: from above, from the side, and its dense middle."""
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
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenes", type=Path, default=Path("../shared/scenes"), help="real scenes (default: %(default)s)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("docs/simulator.md"), help="Markdown to write (default: %(default)s)"
    )
    parser.add_argument("--run", type=Path, default=Path("runs/simulator"), help="folder (default: %(default)s)")
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
    folder = given.run.resolve() / "scenes"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    kept = kept_rows(figures) if given.keep_real else []
    real = [] if given.keep_real else list(real_rows(given.scenes, given.points, folder))
    simulated = list(simulated_rows(given.points, given.seeds, folder))
    rows = [*kept, *with_attacks([*real, *simulated], folder)]
    write_rows(figures, rows)
    command = f"python docs/simulator_realism.py --scenes {given.scenes} --out {given.out}"
    given.out.write_text(document(rows, command, given.points))
    picture(given.out.parent / "images" / "simulator.png", 20_000)


if __name__ == "__main__":
    main()
