"""Compare speed and error with Line2Point, the authors' program, on the same points in the same run.

    python benchmarks/line2point.py --reference path/to/Line2Point --lines 10000

docs/experiments.md has the table. Seconds count from the loaded points to the last estimate; CPU seconds are those of
whole programs, imports included. Line2Point has one free vote for the truth per line: each line counts as its own
neighbour, and the origin of each line is the true point. l2p has no such vote, and no option for it.

Line2Point (https://github.com/kunalchelani/Line2Point) has no licence, so no part of it is here: clone it and pass the
folder. Its program runs unchanged, in its folder, with the interpreter that runs this file. It needs open3d, scipy and
tqdm, which the virtual environment of this project has.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from harness import print_table

import l2p
from l2p.judging.accuracy import spacing

PROGRAM = "Recover.py"
#: Line that the program prints when its points are loaded and its attack begins.
BEGIN = "Finding Coarse Estimates"
ROUNDS = 3
HEADS = ("program", "seconds", "times faster", "CPU seconds", "times less CPU", "median error", "in spacings")
#: Rows of this package: a name, and arguments of ``l2p recover``.
RUNS: tuple[tuple[str, list[object]], ...] = (
    ("heuristic, `--threads 1`", ["--method", "heuristic", "--rounds", ROUNDS, "--threads", 1]),
    ("heuristic, as it comes", ["--method", "heuristic", "--rounds", ROUNDS]),
    ("learned, `--rounds 1`", ["--method", "learned", "--rounds", 1]),
    ("learned, `--rounds 2`", ["--method", "learned", "--rounds", 2]),
    ("learned", ["--method", "learned"]),
)


@dataclass(frozen=True)
class Row:
    """Result of a run: seconds of the attack alone, CPU seconds of the whole program, median error in scene units."""

    name: str
    seconds: float
    cpu: float
    median: float


def cells(row: Row, first: Row, unit: float) -> list[str]:
    """Cells of a row of the table, with ratios to the first row."""
    faster, less = first.seconds / row.seconds, first.cpu / row.cpu
    seconds = [f"{row.seconds:.1f}", f"{faster:.0f}", f"{row.cpu:.1f}", f"{less:.0f}"]
    return [row.name, *seconds, f"{row.median:.4f}", f"{row.median / unit:.3f}"]


def load(name: str, count: int) -> l2p.Scene:
    """Load ``count`` points of a simulated scene (sim:KIND) or of a file."""
    if name.startswith("sim:"):
        return l2p.simulate(name.removeprefix("sim:"), points=count, seed=0)
    scene = l2p.load(name, l2p.Scene)
    if len(scene) < count:
        raise l2p.InputError(f"got {len(scene)} points in {name}; expected at least --lines {count}")
    return l2p.Scene(scene.xyz[np.random.default_rng(0).choice(len(scene), count, replace=False)])


def run_reference(folder: Path, cloud: Path) -> Row:
    """Run the authors' program and read its last median error; its output goes to stderr with the time."""
    command = [
        sys.executable, "-u", PROGRAM, "--input_type", "ply", "--input_ply_fname", str(cloud),
        "--use_fraction_pts", "1.0", "--num_refine_iterations", str(ROUNDS),
    ]  # fmt: skip
    median, cpu_began = None, _children_cpu()
    began = started = time.perf_counter()
    # stderr goes to a file: its progress bars would fill a pipe and block it.
    with tempfile.TemporaryFile("w+") as noise:
        process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=noise, text=True)
        for line in process.stdout or ():
            print(f"{time.perf_counter() - started:8.1f} s  {line.rstrip()}", file=sys.stderr, flush=True)
            if line.startswith(BEGIN):
                began = time.perf_counter()
            if found := re.match(r"Median error : (\S+)", line):
                median = float(found[1])
        process.wait()
        seconds = time.perf_counter() - began
        noise.seek(0)
        if process.returncode != 0 or median is None:
            raise SystemExit(f"{folder / PROGRAM} failed:\n{noise.read()[-2000:]}")
    return Row("Line2Point, as published", seconds, _children_cpu() - cpu_began, median)


def _children_cpu() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def run_l2p(cloud: Path, name: str, words: list[object]) -> Row:
    """Run an attack of this package from its command line."""
    names = ("lines.npz", "truth.npz", "out.npz", "stats.json")
    lines, truth, out, stats = (cloud.with_name(name) for name in names)
    _command("lift", cloud, "-o", lines, "--truth", truth, "--seed", 0, "--force")
    cpu_began = _children_cpu()
    _command("recover", lines, "-o", out, *words, "--json", stats, "--force")
    cpu = _children_cpu() - cpu_began
    scores = l2p.evaluate(l2p.load(out, l2p.Recovery), l2p.load(truth, l2p.Truth).xyz)
    return Row(f"l2p {name}", json.loads(stats.read_text())["seconds"], cpu, scores.median)


def _command(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "l2p", *map(str, words)], check=True, stdout=subprocess.DEVNULL)


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", type=Path, metavar="PATH", help="folder of a clone of Line2Point")
    parser.add_argument("--lines", type=int, default=5000, help="number of lines (default: %(default)s)")
    parser.add_argument("--scene", default="sim:room", help="sim:KIND or a file that l2p reads (default: %(default)s)")
    return parser.parse_args()


def main() -> None:
    """Run both programs on one cloud, and print the table."""
    given = arguments()
    if given.reference is None:
        print("skipped: Line2Point has no licence and is not part of l2p; name a clone of it with --reference PATH")
        return
    if not (given.reference / PROGRAM).is_file():
        raise SystemExit(f"{given.reference} has no {PROGRAM}; expected the folder of a clone of Line2Point")
    scene = load(given.scene, given.lines)
    with tempfile.TemporaryDirectory() as place:
        cloud = Path(place) / "cloud.ply"
        l2p.save(l2p.Scene(scene.xyz), cloud)
        rows = [run_reference(given.reference, cloud)]
        rows += [run_l2p(cloud, *run) for run in RUNS]
    title = f"{given.lines} lines of {given.scene}, {ROUNDS} refinements of the heuristics, {os.cpu_count()} cores"
    print_table(title, HEADS, [cells(row, rows[0], spacing(scene.xyz)) for row in rows])


if __name__ == "__main__":
    main()
