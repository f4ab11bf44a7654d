"""Damage valid files of every format, and read them, until the time is over: do the readers survive any bytes?

    python tests/stress/fuzz_readers.py --minutes 60

A reader gives an object or raises InputError; anything else is a finding, and so are warnings, a death of the process,
more than 20 seconds, or more memory than 100 MB and 20 times the file. Each kind of finding is saved once, to
``--findings/NAME/``, with the files that show it and ``error.txt``; the exit code is 1 if there are any. Time is spent
on all formats in turn, in a process of its own, which is replaced when it dies. Inputs that take the readers along
lines of code in an order not seen before are kept, and damaged further (``line_coverage.py``).

With ``--engine atheris`` the damage is guided by coverage instead (libFuzzer), for the binary formats of one file. It
needs the package atheris, which is no dependency of the project: make an environment for it and lend it the packages
of this one,

    python -m venv /tmp/atheris && /tmp/atheris/bin/pip install atheris
    export PYTHONPATH=.:.venv/lib/python3.11/site-packages
    /tmp/atheris/bin/python tests/stress/fuzz_readers.py --engine atheris
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib
import inspect
import io
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from accidents import damaged
from line_coverage import Steps

from l2p.attacks.learned import checkpoint
from l2p.errors import InputError, InputWarning
from l2p.io import (
    bundler,
    colmap,
    column_names,
    column_values,
    id_files,
    json_maps,
    kinds,
    line_files,
    npz,
    nvm,
    obj_points,
    other_lines,
    pcd,
    ply,
    ply_points,
    point_text,
    recovery_files,
    scene_files,
    table_files,
    text_lines,
    text_tables,
    xyz_files,
)
from l2p.maps.recovery import Recovery
from l2p.maps.scene import Scene
from l2p.maps.truth import Truth
from l2p.schemes.hide import lift
from l2p.show import exhibit, tables

#: Every way in; each is tried on every file.
READERS: tuple[Callable[[Path], Any], ...] = (
    line_files.load_lines,
    scene_files.load_scene,
    scene_files.load_truth,
    recovery_files.load_recovery,
    id_files.load_ids,
    checkpoint.read,
    exhibit.Exhibit.load,
    tables.print_info,
)
#: The code that a file leads through.
TRACED: tuple[ModuleType, ...] = (
    *(checkpoint, exhibit, tables, colmap, id_files, kinds, line_files, npz, ply),
    *(recovery_files, scene_files, text_lines, text_tables, table_files, column_names, column_values, other_lines),
    *(bundler, json_maps, nvm, obj_points, pcd, ply_points, point_text, xyz_files),
    *(zipfile, importlib.import_module("plyfile"), np.lib.format),
)
#: Limits for one file: processor seconds, and bytes beyond a multiple of its size.
SECONDS, BYTES, TIMES = 20, 100 << 20, 20
#: Bytes of address space beyond that of an idle process: a limit on allocations that tracemalloc does not see.
SPACE = 4 << 30
#: Rows of the valid files.
ROWS = 6
#: Inputs of a file that are kept to be damaged further, and the largest of them in bytes.
KEPT, LARGEST = 200, 1 << 16


@dataclass(frozen=True)
class Valid:
    """A valid file, or the files of a folder, by name."""

    name: str
    files: dict[str, bytes]

    def write(self, folder: Path, file: str, content: bytes) -> Path:
        """The file or folder to read, with other content in one of its files."""
        place = folder / self.name
        if len(self.files) == 1:
            place.write_bytes(content)
            return place
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        for name, own in self.files.items():
            (place / name).write_bytes(content if name == file else own)
        return place


def valid_files() -> list[Valid]:
    """One of every format, with everything in it that it can hold."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for write in (_write_lines, _write_points, _write_ids, _write_checkpoint, _write_models, _write_others):
            write(root)
        return [
            Valid(path.name, {file.name: file.read_bytes() for file in (sorted(path.iterdir()) or [])})
            if path.is_dir()
            else Valid(path.name, {path.name: path.read_bytes()})
            for path in sorted(root.iterdir())
        ]


def _points() -> tuple[np.random.Generator, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng, rng.normal(size=(ROWS, 3)), rng.integers(0, 256, (ROWS, 3), dtype=np.uint8)


def _write_ids(root: Path) -> None:
    (root / "ids.txt").write_text("# points\n17, 3 42\n")
    np.save(root / "ids.npy", np.arange(ROWS))
    np.savez(root / "ids.npz", point3D_id=np.arange(ROWS))


def _write_lines(root: Path) -> None:
    _, points, rgb = _points()
    lines = lift(points, seed=0, rgb=rgb)
    for ending in ("npz", "ply", "obj"):
        line_files.save_lines(lines, root / f"lines.{ending}")
    rows = "".join(" ".join(map(repr, row)) + "\n" for row in np.hstack([points, lines.direction]).tolist())
    (root / "lines.txt").write_text("# x y z dx dy dz\n" + rows)
    (root / "lines-ascii.ply").write_text(
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 2\nproperty float x\nproperty float y\n"
        "property float z\nelement edge 1\nproperty list uchar int other\nproperty int vertex1\nproperty int vertex2\n"
        "end_header\n0 0 0\n1 1 1\n1 7 0 1\n"
    )


def _write_points(root: Path) -> None:
    rng, points, rgb = _points()
    scene_files.save_scene(Scene(points, rgb), root / "scene.ply")
    np.savez_compressed(
        root / "scene.npz",
        xyz=points,
        rgb=rgb,
        error=rng.random(ROWS),
        track_length=np.arange(ROWS),
        ids=np.arange(ROWS),
        camera_centers=points[:2],
    )
    scene_files.save_truth(Truth(points, np.arange(ROWS), 1.0, np.arange(ROWS), 3), root / "truth.npz")
    recovery = Recovery(
        points,
        rng.random(ROWS).astype(np.float32),
        rng.normal(size=ROWS),
        rgb,
        neighbors=rng.integers(-1, ROWS, (ROWS, 2)),
        affinity=rng.random((ROWS, 2)).astype(np.float32),
        kept=rng.random(ROWS) < 0.5,
        info={"method": "learned", "settings": {"rounds": 2, "checkpoint": "a.safetensors"}},
    )
    recovery_files.save_recovery(recovery, root / "recovery.npz")


def _write_checkpoint(root: Path) -> None:
    from l2p.attacks.learned.learned_config import LearnedConfig
    from l2p.attacks.learned.network import LineTransformer, NetworkConfig

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = LineTransformer(NetworkConfig(width=2, layers=1, heads=1))
    result = {"scene": "room", "fraction": 0.5, "lines": 9, "median": [0.4], "within": [0.6]}
    facts = {"commit": "0123abcd", "seed": 1, "steps": 3, "minutes": 1.5, "scenes": ["room"], "results": [result]}
    calibration = {"lines": [[(1.0, 0.0)] * len(NetworkConfig.radii)]}
    whole = checkpoint.Checkpoint(network, LearnedConfig(rounds=1, candidates=4), calibration, facts)
    checkpoint.save(root / "model.safetensors", whole)


def _write_models(root: Path) -> None:
    import pycolmap

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D, options.num_frames_per_rig, options.track_length = ROWS, 2, 2
    model = pycolmap.synthesize_dataset(options)
    for name, write in (("model-bin", model.write_binary), ("model-txt", model.write_text)):
        (root / name).mkdir()
        write(str(root / name))


def _write_others(root: Path) -> None:
    """Maps and line clouds of other programs."""
    rng, points, rgb = _points()
    vectors = rng.normal(size=(ROWS, 3))
    six = [[*xyz, *color] for xyz, color in zip(points.tolist(), rgb.tolist(), strict=True)]
    rows = "".join(" ".join(map(str, row)) + "\n" for row in six)
    (root / "cloud.xyz").write_text(rows)
    (root / "cloud.pts").write_text(f"{ROWS}\n{rows}")
    (root / "cloud.csv").write_text("x;y;z;r;g;b\n" + rows.replace(" ", ";").replace(".", ","))
    (root / "points.obj").write_text("".join(f"v {row}\n" for row in rows.splitlines()))
    (root / "cloud.pcd").write_text(
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {ROWS}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {ROWS}\nDATA ascii\n"
        + "".join(" ".join(map(str, row[:3])) + "\n" for row in six)
    )
    np.save(root / "lines.npy", np.hstack([points, vectors]))
    np.savez(root / "rays.npz", origins=points, directions=vectors)
    np.savez(root / "ends.npz", start=points, end=points + vectors)
    pose = "500 0 0\n1 0 0\n0 1 0\n0 0 1\n1 2 3\n"
    seen = "".join(f"{row[0]} {row[1]} {row[2]}\n{row[3]} {row[4]} {row[5]}\n1 0 7 1.5 -2.5\n" for row in six)
    (root / "bundle.out").write_text(f"# Bundle file v0.3\n1 {ROWS}\n{pose}{seen}")
    seen = "".join(" ".join(map(str, row)) + " 1 0 7 1.5 -2.5\n" for row in six)
    (root / "map.nvm").write_text(f"NVM_V3\n\n1\na.jpg\t500 1 0 0 0 1 2 3 0.01 0\n\n{ROWS}\n{seen}\n0\n")
    shot = {"rotation": [0, 0, 0], "translation": [1, 2, 3], "camera": "c"}
    known = {str(number): {"coordinates": row[:3], "color": row[3:]} for number, row in enumerate(six)}
    content = [{"cameras": {"c": {}}, "shots": {"a": shot}, "points": known}]
    (root / "reconstruction.json").write_text(json.dumps(content))


def read_all(path: Path) -> None:
    """Try every reader; InputError is an answer, and printed text is dropped."""
    for reader in READERS:
        with contextlib.suppress(InputError), contextlib.redirect_stdout(io.StringIO()):
            reader(path)


def cases_of(
    files: list[Valid], chance: random.Random, kept: dict[tuple[str, str], list[bytes]]
) -> Iterator[tuple[Valid, str, bytes]]:
    """Endless cases, all formats in turn: the valid file, which of its files is damaged, and how that looks.

    Every other case starts from an input that was kept, where there is one.
    """
    while True:
        for valid in files:
            name = chance.choice(sorted(valid.files))
            before = kept.get((valid.name, name), []) if chance.random() < 0.5 else []
            content = damaged(chance.choice(before) if before else valid.files[name], chance)
            yield valid, name, content if chance.random() < 0.5 else repaired(valid.name, content)


def repaired(name: str, content: bytes) -> bytes:
    """An npz whose checksums are right, so that damage comes through to the arrays; anything else as it is."""
    if not name.endswith(".npz"):
        return content
    out = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(out, "w") as again:
            for info in archive.infolist():
                with archive.open(info) as member:
                    member._expected_crc = None  # type: ignore[attr-defined]
                    again.writestr(info.filename, member.read(1 << 20))
    except Exception:  # too much is damaged
        return content
    return out.getvalue()


def try_one(path: Path, size: int) -> str | None:
    """Read a damaged file; returns the finding, or None if the reader did well."""
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # ends the process, also on a machine that is busy otherwise
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            warnings.simplefilter("ignore", InputWarning)
            read_all(path)
    except Exception:
        return traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    if said:  # which the user of a command would see as lines of no use
        return f"File {said[0].filename}, line {said[0].lineno}\n{said[0].category.__name__}: {said[0].message}"
    taken = tracemalloc.get_traced_memory()[1] - before
    return f"{taken} bytes of memory for {size} bytes" if taken > BYTES + TIMES * size else None


def save_finding(findings: Path, case: Path, error: str) -> None:
    """Keep the files that show it; once for each place in the code, or sentence."""
    last = [line.strip() for line in error.splitlines() if line.strip().startswith("File ")][-1:]
    where = hashlib.sha256("".join([*last, error.splitlines()[-1][:30]]).encode()).hexdigest()[:12]
    place = findings / f"{case.name}-{where}"
    if place.exists():
        return
    place.mkdir(parents=True)
    shutil.copytree(case, place / case.name) if case.is_dir() else shutil.copy(case, place)
    (place / "error.txt").write_text(error)
    print(f"{place}: {error.splitlines()[-1]}", flush=True)


def work(files: list[Valid], findings: Path, desk: Path, number: int, until: float) -> None:
    """Read one case after the other until the time is over; each lies on the desk while it is read."""
    limit = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + SPACE
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    tracemalloc.start()
    cases, kept = 0, dict[tuple[str, str], list[bytes]]()
    steps = Steps(TRACED)
    for valid, name, content in cases_of(files, random.Random(number), kept):
        if time.monotonic() > until:
            break
        path = valid.write(desk, name, content)
        with steps:
            error = try_one(path, len(content))
        inputs = kept.setdefault((valid.name, name), [])
        if steps.fresh and len(inputs) < KEPT and len(content) <= LARGEST:
            inputs.append(content)
        if error is not None:
            save_finding(findings, path, error)
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        cases += 1
    new = sum(map(len, kept.values()))
    print(f"{cases} cases, {len(steps.known)} steps from line to line, {new} inputs kept", flush=True)


def fuzz(files: list[Valid], findings: Path, minutes: float, seed: int) -> None:
    """Let processes work until the time is over; the death of one is a finding."""
    until = time.monotonic() + 60 * minutes
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None) as folder:
        while time.monotonic() < until:
            sys.stdout.flush()
            process = os.fork()
            if process == 0:
                work(files, findings, Path(folder), seed, until)
                os._exit(0)
            code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
            for path in Path(folder).iterdir():  # the case that it died of
                save_finding(
                    findings, path, f"the process ended with {signal.Signals(-code).name if code < 0 else code}"
                )
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            seed += 1


def fuzz_guided(files: list[Valid], findings: Path, minutes: float, seed: int) -> None:
    """The same with atheris, one binary format after the other; libFuzzer saves the first finding of each."""
    binary = [valid for valid in files if len(valid.files) == 1 and b"\0" in valid.files[valid.name]]
    for valid in binary:
        sys.stdout.flush()
        process = os.fork()
        if process == 0:
            _guided(valid, findings, 60 * minutes / len(binary), seed)
        os.waitpid(process, 0)


def _guided(valid: Valid, findings: Path, seconds: float, seed: int) -> None:
    import atheris

    for module in TRACED:
        for function in _functions(module):
            atheris.instrument_func(function)  # type: ignore[attr-defined]
    corpus = Path(tempfile.mkdtemp())
    (corpus / "valid").write_bytes(valid.files[valid.name])
    desk = Path(tempfile.mkdtemp(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None))

    def one(content: bytes) -> None:
        (desk / valid.name).write_bytes(content)
        read_all(desk / valid.name)

    findings.mkdir(parents=True, exist_ok=True)
    flags = {
        "max_total_time": int(seconds),
        "timeout": SECONDS,
        "rss_limit_mb": 4096,
        "malloc_limit_mb": 1024,
        "max_len": 1 << 16,
        "seed": seed + 1,
        "print_final_stats": 1,
        "artifact_prefix": f"{findings}/{valid.name}-",
    }
    atheris.Setup([sys.argv[0], *(f"-{name}={value}" for name, value in flags.items()), str(corpus)], one)
    atheris.Fuzz()


def _functions(module: ModuleType) -> Iterator[Any]:
    """The functions and methods that a module defines."""
    for value in vars(module).values():
        if inspect.isfunction(value) and value.__module__ == module.__name__:
            yield value
        elif inspect.isclass(value) and value.__module__ == module.__name__:
            yield from (method for method in vars(value).values() if inspect.isfunction(method))


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60, help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the first process (default: %(default)s)")
    parser.add_argument("--engine", choices=("own", "atheris"), default="own", help="(default: %(default)s)")
    parser.add_argument(
        "--findings", type=Path, default=Path("build/fuzz"), help="folder to save them to (default: %(default)s)"
    )
    return parser.parse_args()


def main() -> int:
    """Fuzz; 1 if something was found."""
    given = arguments()
    torch.set_num_threads(1)
    {"own": fuzz, "atheris": fuzz_guided}[given.engine](valid_files(), given.findings, given.minutes, given.seed)
    found = sorted(given.findings.iterdir()) if given.findings.is_dir() else []
    print(f"{len(found)} findings in {given.findings}")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
