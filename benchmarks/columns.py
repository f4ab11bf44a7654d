"""Measure the figures by which columns without names are told apart (l2p/io/column_values.py).

    python benchmarks/columns.py ../shared/scenes/train

Prints the range over the scenes of ``surface_fit``, for normals (Open3D, from 30 neighbours) and for the directions of
lines of every kind; and of the distance at which lines meet if their moments are taken for points, or their feet for
moments (which gives the same lines), over that of the right reading.
"""

from __future__ import annotations

import argparse

import numpy as np
from harness import print_table
from jaxtyping import Float

import l2p
from l2p.io.column_values import meeting_distance, surface_fit
from l2p.io.open3d import load_open3d
from l2p.programs.scenes import scene_at, scenes_of

#: Most points of a scene, to save time.
MOST = 20_000
#: Neighbours from which Open3D fits a normal.
NEIGHBORS = 30
FITS = ("vectors", "scenes", "to the offsets of near points", "to the vectors of near points")
RATIOS = ("scenes", "other reading / right reading")

Rows = Float[np.ndarray, "rows 3"]


def normals(points: Rows) -> Rows:
    """Normals of a point cloud as a user of Open3D has them."""
    open3d = load_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBORS))
    return np.asarray(cloud.normals)


def directions(points: Rows, rng: np.random.Generator) -> dict[str, Rows]:
    """Directions of lines through the points, by kind."""
    centers = points[rng.choice(len(points), 2)]
    kinds = {
        "uniform": rng.normal(size=points.shape),
        "rays": points - centers[rng.integers(0, 2, len(points))],
        "sphere": points - np.median(points, axis=0),
        "pairs": points[rng.permutation(len(points))] - points,
    }
    return {name: each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-12) for name, each in kinds.items()}


def span(values: list[float]) -> str:
    """Least and largest."""
    return f"{min(values):.2f} to {max(values):.2f}"


def main() -> None:
    """Measure every scene, and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", help="scenes, or folders of them")
    given = parser.parse_args()
    fits: dict[str, list[tuple[float, float]]] = {}
    ratios: list[float] = []
    for scene in scenes_of(tuple(given.scenes), {}):
        rng = np.random.default_rng(0)
        points = scene_at(scene.source).xyz
        points = points[rng.permutation(len(points))[:MOST]]
        for name, vector in {"normals": normals(points), **directions(points, rng)}.items():
            fit = surface_fit(points, vector)
            if fit is not None:
                fits.setdefault(name, []).append(fit)
        lines = l2p.lift(points, seed=0)
        muddle = l2p.LineCloud.through(lines.moment, lines.direction)
        ratios.append(meeting_distance(muddle) / meeting_distance(lines))
    rows = [[name, str(len(found)), *map(span, map(list, zip(*found, strict=True)))] for name, found in fits.items()]
    print_table("mean |cosine| of vectors, least and largest", FITS, rows)
    print_table("distances at which lines meet", RATIOS, [[str(len(ratios)), span(ratios)]])


if __name__ == "__main__":
    main()
