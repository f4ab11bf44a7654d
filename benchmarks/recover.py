"""Measure seconds, memory and errors of an attack by the number of lines; or compare them with another checkout.

    python benchmarks/recover.py --lines 5000 20000 --again 3
    python benchmarks/recover.py --lines 20000 200000 --memory least --threads 1
    python benchmarks/recover.py --lines 5000 200000 --methods learned --parts
    python benchmarks/recover.py --lines 20000 --repeat 5 --again 4 --against ../before
    python benchmarks/recover.py --lines 20000 --methods learned learned+rgb+descriptor --threads 1 --again 3

The first prints, for each method, seconds, growth with the lines, the ratio to the first method and the errors:
docs/performance.md has learned against tomography. The second limits the memory (GiB, ``least``: the least that the
method accepts, ``fast``: no limit); ``held`` is bytes per line beyond the constant part of that least, and the exit
code is 1 if a peak is above the limit. The third splits the seconds from the start of the process to the written file;
``surroundings`` is the part without a progress bar: local scales and planes of the estimates, the frame. In the last,
a method followed by attributes also sees these.

The fourth alternates the l2p of another folder with this one and prints ratios, this / other: below 1, this one is
faster or smaller. In brackets is an interval for the median of the pairs' ratios. On a busy machine, the ratios of CPU
seconds and of the fastest runs are more reliable. Changes that should cost nothing are compared with the commit before
in this way, to 3 %. Memory is that of the first attack of a process; seconds are those of the ``--again`` later ones.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from harness import Cloud, Run, Setting, Taken, from_file, measured, print_table, ratio, simulated

import l2p
from l2p.attacks.named import named_attack
from l2p.attacks.run import line_bytes_of
from l2p.attacks.settings import METHODS
from l2p.maps import ATTRIBUTES
from l2p.work.memory import BASE, GIB, SMALLEST

#: Memory limit in GiB that no attack here reaches: blocks have their fastest size.
UNBOUNDED = 1e3
#: Methods, also with what they see beside the lines.
SEEING = (*METHODS, *(f"learned{seen}" for seen in ("+rgb", "+descriptor", "+rgb+descriptor")))
#: Attacks per process after its first one, when checkouts are compared.
AGAIN = 4
HEADS = (
    *("method", "lines", "threads", "seconds", "ms/line", "CPU s", "over the first size", "over the first method"),
    *("allowed, GiB", "peak, GiB", "least, GiB", "held, B/line", "median (scene)", "spacings", "within 1"),
)
HEADS_AGAINST = (
    *("method", "lines", "seconds", "there", "ratio", "of the fastest", "of CPU seconds"),
    *("peak, GiB", "there", "ratio", "points moved"),
)


def promised(method: str, rounds: int | None, lines: l2p.LineCloud) -> float:
    """Least GiB that a method needs by its own estimate for the lines and what it sees; NaN if it has none."""
    name, *sees = method.split("+")
    seen = lines.without([each for each in ATTRIBUTES if each not in sees])
    line_bytes = line_bytes_of(named_attack(name, rounds=rounds), seen.appearance.width) or float("nan")
    return (BASE + SMALLEST + len(lines) * line_bytes) / GIB


def clouds(given: argparse.Namespace, folder: Path) -> Iterator[Cloud]:
    """Yield the given clouds, one after the other."""
    if given.file:
        yield from_file(given.file, folder)
        return
    for count in given.lines:
        yield simulated(given.kind, count, folder)


def setting(method: str, memory: str | None, lines: l2p.LineCloud, given: argparse.Namespace) -> Setting:
    """Setting of a method with a memory limit."""
    known = {None: None, "fast": UNBOUNDED, "least": promised(method, given.rounds, lines) * (1 + 1e-9)}
    allowed = known[memory] if memory in known else float(memory or 0)
    return Setting(method, given.rounds, allowed, given.threads, given.parts)


def errors(cloud: Cloud, run: Run) -> list[str]:
    """Cells of the median error in scene units and in spacings, and of the share within 1 spacing."""
    if cloud.truth is None:
        return ["", "", ""]
    scores = l2p.evaluate(run.recovery, cloud.truth)
    return [f"{scores.median:.4f}", f"{scores.median_spacings:.3f}", f"{scores.within_spacings['1']:.1%}"]


def rows(given: argparse.Namespace, folder: Path, above: list[str]) -> Iterator[list[str]]:
    """Yield a row for each cloud, limit and method; append runs above their memory limit to ``above``."""
    first = dict[tuple[str, str | None], float]()
    for cloud, memory in ((cloud, memory) for cloud in clouds(given, folder) for memory in given.memory):
        settings = [setting(method, memory, cloud.lines, given) for method in given.methods]
        found = measured(cloud, settings, given.repeat, given.again)
        for way, taken in zip(settings, found, strict=True):
            seconds = float(np.median(taken.seconds))
            over = [f"{seconds / first.setdefault((way.method, memory), seconds):.1f}"]
            over.append(ratio(taken.seconds, found[0].seconds))
            if way.memory is not None and max(taken.gib) > way.memory:
                above.append(f"{way.method}, {len(cloud.lines):,} lines")
            yield [
                *seconds_cells(cloud, taken, way),
                *over,
                *memory_cells(cloud, taken, way),
                *errors(cloud, taken.run),
            ]


def seconds_cells(cloud: Cloud, taken: Taken, way: Setting) -> list[str]:
    """Cells of method, size, threads and seconds."""
    lines, seconds = len(cloud.lines), float(np.median(taken.seconds))
    cells = [way.method, f"{lines:,}", str(taken.run.threads), f"{seconds:.2f}"]
    return [*cells, f"{1e3 * seconds / lines:.3f}", f"{np.median(taken.cpu):.2f}"]


def memory_cells(cloud: Cloud, taken: Taken, way: Setting) -> list[str]:
    """Cells of the memory limit, the peak, the least estimate, and the bytes held per line."""
    gib, least = float(np.median(taken.gib)), promised(way.method, way.rounds, cloud.lines)
    held = max(0.0, (gib * GIB - BASE - SMALLEST) / len(cloud.lines))
    allowed = "" if way.memory in (None, UNBOUNDED) else f"{way.memory:.2f}"
    return [allowed, f"{gib:.2f}", f"{least:.2f}", f"{held:,.0f}"]


def show_parts(given: argparse.Namespace, folder: Path) -> None:
    """Print a table of seconds by part for each method, with one column per size."""
    found: dict[str, dict[int, Run]] = {method: {} for method in given.methods}
    for cloud in clouds(given, folder):
        size = len(cloud.lines)
        for method in given.methods:
            found[method][size] = measured(cloud, [setting(method, given.memory[0], cloud.lines, given)], 1)[0].run
    for method, runs in found.items():
        parts = dict.fromkeys(part for run in runs.values() for part in run.parts)
        rows = [[part, *(f"{run.parts.get(part, 0):.1f}" for run in runs.values())] for part in parts]
        totals = {size: sum(run.parts.values()) for size, run in runs.items()}
        rows.append(["all", *(f"{total:.1f}" for total in totals.values())])
        rows.append(["ms/line", *(f"{1e3 * total / size:.2f}" for size, total in totals.items())])
        rows.append(["peak, GiB", *(f"{run.gib:.2f}" for run in runs.values())])
        print_table(f"{method}, {titled(given)}", ["seconds", *(f"{size:,} lines" for size in runs)], rows)


def rows_against(given: argparse.Namespace, folder: Path) -> Iterator[list[str]]:
    """Yield a row for each cloud and method: this checkout / another, alternating."""
    for cloud, method in ((cloud, method) for cloud in clouds(given, folder) for method in given.methods):
        own = setting(method, given.memory[0], cloud.lines, given)
        other = replace(own, checkout=given.against.resolve())
        yield [method, f"{len(cloud.lines):,}", *compared(*measured(cloud, [own, other], given.repeat, given.again))]


def compared(own: Taken, other: Taken) -> list[str]:
    """Cells of a comparison."""
    cells = [f"{np.median(own.seconds):.2f}", f"{np.median(other.seconds):.2f}", str(ratio(own.seconds, other.seconds))]
    cells += [f"{min(own.seconds) / min(other.seconds):.3f}", str(ratio(own.cpu, other.cpu))]
    cells += [f"{np.median(own.gib):.3f}", f"{np.median(other.gib):.3f}", str(ratio(own.gib, other.gib))]
    moved = int(np.any(own.run.recovery.xyz != other.run.recovery.xyz, axis=1).sum())
    return [*cells, f"{moved:,}" if moved else "none"]


def titled(given: argparse.Namespace) -> str:
    """Title: scene, processes per setting, and timed attacks after the first one of each process."""
    return f"{Path(given.file).name if given.file else given.kind}, --repeat {given.repeat} --again {given.again}"


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, nargs="+", default=[5_000, 20_000], help="(default: %(default)s)")
    parser.add_argument("--kind", default="room", help="kind of simulated scene (default: %(default)s)")
    parser.add_argument("--file", metavar="PATH", help="a line cloud, or a scene, in place of simulated ones")
    parser.add_argument("--methods", nargs="+", choices=SEEING, default=["tomography", "learned"], metavar="METHOD")
    parser.add_argument("--rounds", type=int, help="rounds of refinement (default: the method's own)")
    parser.add_argument(
        "--memory", nargs="+", default=[None], metavar="GIB", help="GiB, least, fast (default: l2p's own)"
    )
    parser.add_argument("--threads", type=int, default=0, help="CPU threads (default: torch chooses)")
    parser.add_argument("--repeat", type=int, default=1, help="processes; medians count (default: %(default)s)")
    parser.add_argument("--again", type=int, help=f"attacks more in each, timed (default: 0; against: {AGAIN})")
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--parts", action="store_true", help="seconds by part of the attack")
    shown.add_argument("--against", type=Path, metavar="FOLDER", help="root of another checkout to compare with")
    given = parser.parse_args()
    if given.again is None:
        given.again = AGAIN if given.against else 0
    return given


def main() -> int:
    """Run the given measurement; return 1 if an attack exceeded its memory limit."""
    given, above = arguments(), list[str]()
    with tempfile.TemporaryDirectory() as place:
        if given.against:
            print_table(f"{titled(given)}, this over {given.against}", HEADS_AGAINST, rows_against(given, Path(place)))
        elif given.parts:
            show_parts(given, Path(place))
        else:
            print_table(titled(given), HEADS, rows(given, Path(place), above))
    print(*(f"more memory than allowed: {each}" for each in above), sep="\n", end="")
    return int(bool(above))


if __name__ == "__main__":
    sys.exit(main())
