"""Kill programs at random moments, look at what is left, and run them again to their end.

    nice -n 19 python tests/stress/kill_runs.py --kills 60

`l2p recover`, `l2p audit`, `python -m train` and `python -m eval` work on tiny simulated scenes. Each is run to its
end once, which gives its result and its time. Then, folder after folder, the same command is killed a few times at
moments drawn from that time, until it is done before the moment comes, and at last run to its end. After each kill
every output must be whole or absent; in the end all of them must be those of the run that nobody killed, to the last
bit but for times and dates. The moments and the scenes follow from the seed; what a process was at by then, from the
machine. The exit code is 1 if anything was wrong.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import l2p
from l2p.attacks.learned import checkpoint
from l2p.io.atomic import atomic_file
from l2p.io.recovery_files import load_recovery

ROOT = Path(__file__).resolve().parents[2]
#: Outputs of one kill or run, by name: a digest of what they say.
Found = dict[str, str]
#: Keys of JSON outputs that say when and where, not what.
_VARYING = {
    *("seconds", "minutes", "made", "command", "commit", "machine", "peak_gib", "stamp"),
    *("code", "versions", "config"),
}


@dataclass(frozen=True)
class Program:
    """A command and what it writes.

    ``whole`` gives the outputs that are there, and raises where one of them is damaged. ``resumed``: a run goes on
    where the one before was killed.
    """

    name: str
    command: Callable[[Path, bool], list[str]]
    whole: Callable[[Path], Found]
    resumed: bool


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"\0".join(parts)).hexdigest()


def _json_digest(file: Path) -> str:
    return _digest(json.dumps(_lasting(json.loads(file.read_bytes())), sort_keys=True).encode())


def _lasting(value: Any) -> Any:
    """A JSON value without the keys that vary from run to run."""
    if isinstance(value, dict):
        return {key: _lasting(part) for key, part in value.items() if key not in _VARYING}
    return [_lasting(part) for part in value] if isinstance(value, list) else value


def _recovery_digest(file: Path) -> str:
    found = load_recovery(file)
    return _digest(found.xyz.tobytes(), found.beta.tobytes(), found.confidence.tobytes())


def recovered(folder: Path) -> Found:
    """Outputs of ``l2p recover``."""
    files = {"out.npz": _recovery_digest, "stats.json": _json_digest}
    return {name: digest(folder / name) for name, digest in files.items() if (folder / name).exists()}


def audited(folder: Path) -> Found:
    """Outputs of ``l2p audit``: the folder with both of its files, or none."""
    report = folder / "report"
    if not report.exists():
        return {}
    names = sorted(file.name for file in report.iterdir())
    if names != ["audit.json", "index.html"]:
        raise ValueError(f"the report holds {names}")
    page = (report / "index.html").read_text()
    if not page.rstrip().endswith("</html>"):
        raise ValueError("the page is cut")
    return {"report": _json_digest(report / "audit.json")}


def trained(folder: Path) -> Found:
    """Outputs of a training run. A state to go on from is read, too; it has no counterpart to be compared with."""
    run, found = folder / "run", {}
    if (run / "last.ckpt").exists():
        torch.load(run / "last.ckpt", weights_only=True)
    if (run / "model.safetensors").exists():
        network = checkpoint.read(run / "model.safetensors").network
        found["model"] = _digest(*(value.numpy().tobytes() for value in network.state_dict().values()))
    if (run / "results.json").exists():
        found["results"] = _json_digest(run / "results.json")
    if (run / "figures.csv").exists():
        with (run / "figures.csv").open(newline="") as file:
            rows = {(row["step"], row["figure"]): float(row["value"]) for row in csv.DictReader(file)}
        if "model" in found:  # before the end, more and more steps are in it
            found["figures"] = _digest(repr(sorted(rows.items())).encode())
    return found


def evaluated(folder: Path) -> Found:
    """Outputs of an evaluation run, of which tables grow cell by cell."""
    run, found = folder / "run", {}
    for file in sorted(run.glob("predictions/*.npz")):
        found[file.name] = _recovery_digest(file)
    for file in [*sorted(run.glob("predictions/*.json")), *sorted(run.glob("scores/*.json"))]:
        found[f"{file.parent.name}/{file.name}"] = _json_digest(file)
    if (run / "results.json").exists():
        rows = json.loads((run / "results.json").read_bytes())["rows"]
        with (run / "results.csv").open(newline="") as file:
            lines = list(csv.DictReader(file))
        if len(lines) < len(rows):
            raise ValueError(f"results.csv has {len(lines)} rows, results.json {len(rows)}")
    if (run / "results.md").exists() and not (run / "results.md").read_text().endswith("\n"):
        raise ValueError("results.md is cut")
    for image in run.glob("figures/*.png"):
        if not image.read_bytes().endswith(b"IEND\xaeB`\x82"):
            raise ValueError(f"{image.name} is cut")
    return found


def programs(inputs: Path) -> list[Program]:
    """The four, each at its smallest."""
    python = [sys.executable, "-m"]

    def recover(folder: Path, again: bool) -> list[str]:
        words = ["recover", str(inputs / "lines.npz"), "-o", str(folder / "out.npz"), "--rounds", "1"]
        return [*python, "l2p", *words, "--json", str(folder / "stats.json"), *(["--force"] if again else [])]

    def audit(folder: Path, again: bool) -> list[str]:
        words = ["audit", str(inputs / "scene.npz"), "-o", str(folder / "report"), "--fractions", "1", "0.5"]
        return [*python, "l2p", *words, "--method", "tomography", *(["--force"] if again else [])]

    def train(folder: Path, again: bool) -> list[str]:
        return [*python, "train", "experiment=debug", "steps=48", f"run={folder / 'run'}"]

    def evaluate(folder: Path, again: bool) -> list[str]:
        keys = ["scenes=[sim:room:400:0]", "fractions=[1.0,0.5,0.2]", "seeds=[0,1,2]", f"run={folder / 'run'}"]
        return [*python, "eval", "methods=[{name: tomography}, {name: learned}]", "threads=1", *keys]

    return [
        Program("l2p recover", recover, recovered, resumed=False),
        Program("l2p audit", audit, audited, resumed=False),
        Program("python -m train", train, trained, resumed=True),
        Program("python -m eval", evaluate, evaluated, resumed=True),
    ]


def finish(program: Program, folder: Path, again: bool) -> tuple[str, float]:
    """Run to the end; returns its complaint if it failed, and seconds."""
    began = time.monotonic()
    done = subprocess.run(program.command(folder, again), cwd=ROOT, capture_output=True, text=True, check=False)
    said = f"exit code {done.returncode}: {done.stderr.strip()[-300:]}" if done.returncode else ""
    return said, time.monotonic() - began


def kill_after(program: Program, folder: Path, again: bool, delay: float) -> bool:
    """Start it and kill it, with all that it started; whether it was still alive then."""
    process = subprocess.Popen(
        program.command(folder, again),
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        process.wait(delay)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return True
    return False


def examine(program: Program, folder: Path, wanted: Found, count: Counter[str], last: bool) -> str:
    """Look at what there is, count it, and say what is wrong."""
    try:
        found = program.whole(folder)
    except Exception as error:  # a damaged file can make a reader raise anything
        return f"damaged: {error}"
    other = sorted(name for name, digest in found.items() if wanted.get(name) != digest)
    if other:
        return f"{', '.join(other)} are not those of the run that nobody killed"
    missing = sorted(wanted.keys() - found.keys())
    if last:
        return f"{', '.join(missing)} are missing" if missing else ""
    count["whole" if not missing else "absent" if not found else "some"] += 1
    return ""


def try_program(program: Program, kills: int, chain: int, chance: random.Random, root: Path) -> tuple[Counter, list]:
    """Kill it so many times; returns the counts and the complaints."""
    count, wrong = Counter[str](), list[str]()
    (root / "reference").mkdir(parents=True)
    said, seconds = finish(program, root / "reference", again=False)
    wanted = program.whole(root / "reference")
    print(f"{program.name}: {seconds:.1f} s alone {said}", flush=True)
    while count["kills"] < kills:
        folder = root / str(count["reruns"])
        folder.mkdir()
        for _ in range(min(chain, kills - count["kills"])):
            # Every other one near the end, when results are written.
            delay = seconds * (chance.uniform(0.1, 1.0) if chance.random() < 0.5 else chance.uniform(0.7, 1.0))
            killed = kill_after(program, folder, _begun(program, folder), delay)
            count["kills"] += killed
            count["late"] += not killed
            if not killed:
                break
            wrong.append(f"after {delay:.2f} s: {examine(program, folder, wanted, count, last=False)}")
            count["left"] += len(list(folder.rglob(".l2p-*.tmp")))
        said, _ = finish(program, folder, _begun(program, folder))
        said = said or examine(program, folder, wanted, count, last=True)
        wrong.append(f"run again in {folder.name}: {said}")
        count["reruns"] += 1
        count["equal"] += not said
        if program.resumed and list(folder.rglob(".l2p-*.tmp")):
            wrong.append(f"run again in {folder.name}: temporary files are still there")
    return count, [line for line in wrong if not line.endswith(": ")]


def _begun(program: Program, folder: Path) -> bool:
    """Whether something is there that a program without resumption would refuse to replace."""
    return not program.resumed and any(not path.name.startswith(".") for path in folder.iterdir())


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=60, help="of all programs together (default: %(default)s)")
    parser.add_argument("--chain", type=int, default=3, help="kills before a run to the end (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default: %(default)s)")
    parser.add_argument("--programs", nargs="+", metavar="NAME", help="part of a name each (default: all)")
    return parser.parse_args()


def main() -> int:
    """Kill one program after the other, then print the table."""
    given = arguments()
    print(f"seed {given.seed}, {given.kills} kills, {given.chain} before each run to the end", flush=True)
    rows, wrong = [], []
    with tempfile.TemporaryDirectory() as place:
        inputs = Path(place)
        xyz = l2p.simulate("room", points=400, seed=given.seed).xyz
        with atomic_file(inputs / "scene.npz") as file:
            np.savez(file, xyz=xyz)
        l2p.save(l2p.lift(xyz, seed=given.seed), inputs / "lines.npz")
        chosen = [
            program
            for program in programs(inputs)
            if given.programs is None or any(part in program.name for part in given.programs)
        ]
        for number, program in enumerate(chosen):
            kills = given.kills // len(chosen) + (number < given.kills % len(chosen))
            chance = random.Random(f"{given.seed} {program.name}")
            count, said = try_program(program, kills, given.chain, chance, inputs / str(number))
            names = ("kills", "late", "absent", "some", "whole", "left", "reruns", "equal")
            rows.append(f"| {program.name} | {' | '.join(str(count[name]) for name in names)} | {len(said)} |")
            wrong += [f"{program.name}, {line}" for line in said]
            print(rows[-1], *said, sep="\n", flush=True)
    heads = ["kills", "had ended", "absent", "some, whole", "all, whole", "temporary files", "reruns", "equal", "wrong"]
    print(f"\n| program | {' | '.join(heads)} |\n| --- |{' ---: |' * len(heads)}")
    print("\n".join(rows))
    print("\n".join(wrong) or "nothing wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
