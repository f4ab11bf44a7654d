"""Cells of a run: a line cloud and a method each. A prediction is written with a record of its provenance."""

from __future__ import annotations

import fcntl
import json
import logging
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eval.contenders import identity_of, source_of
from eval.contract import Contender, Trial
from eval.eval_config import Settings
from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.io.recovery_files import save_recovery
from l2p.maps.appearance import ATTRIBUTES
from l2p.maps.recovery import Recovery
from l2p.maps.truth import Hiding
from l2p.programs.commits import commit, source_digest
from l2p.programs.scenes import SceneSource, load
from l2p.schemes.hide import hide
from l2p.schemes.scheme import DEFAULT_SCHEME
from l2p.work.resident import measured_peak

log = logging.getLogger("eval")


@dataclass(frozen=True)
class Cell:
    """Cell of one scene, fraction, seed, scheme and method."""

    scene: SceneSource
    fraction: float
    seed: int
    contender: Contender
    device: str
    scheme: str = DEFAULT_SCHEME

    @property
    def cloud_key(self) -> str:
        """Name of the hidden map in files: scene, percent, seed, and the scheme if it is not uniform lines."""
        scheme = "" if self.scheme == DEFAULT_SCHEME else f"_{self.scheme}"
        return f"{self.scene.name}_{100 * self.fraction:g}_{self.seed}{scheme}"

    @property
    def method(self) -> str:
        """Name of the method in tables, with the scheme if it is not uniform lines."""
        return self.contender.label if self.scheme == DEFAULT_SCHEME else f"{self.scheme}: {self.contender.label}"

    @property
    def key(self) -> str:
        """Name of the cell in files."""
        return f"{self.cloud_key}_{re.sub('[^a-z0-9]+', '-', self.contender.label.lower()).strip('-')}"

    def trial(self) -> Trial:
        """Hidden map with the attributes that the method sees, and the truth for references."""
        hidden = self.hidden()
        lines = hidden.map.without([name for name in ATTRIBUTES if name not in self.contender.sees])
        # By elements, since references take them in this order: pairs have two each.
        points = hidden.truth.xyz[np.argsort(hidden.truth.element, kind="stable")]
        return Trial(self.cloud_key, lines, points, self.scene.kind, self.fraction, self.seed, self.device)

    def hidden(self) -> Hiding:
        """Hidden map with all attributes of the scene, and truth, with the spacing of the whole scene."""
        return self.hidden_scene(self.scene.source, self.fraction, self.seed, self.scheme)

    @staticmethod
    def hidden_scene(source: str, fraction: float, seed: int, scheme: str = DEFAULT_SCHEME) -> Hiding:
        """Hide a fraction of a scene by a scheme."""
        scene = load(source)
        seen = scene.appearance
        hidden = hide(
            scene.xyz,
            seed,
            fraction,
            scheme,
            rgb=seen.rgb,
            descriptor=seen.descriptor,
            descriptor_kind=seen.descriptor_kind,
        )
        return replace(hidden, truth=replace(hidden.truth, spacing=scene.spacing))

    def identity(self) -> dict[str, Any]:
        """Return all inputs of the prediction except the code."""
        scene = load(self.scene.source)
        attributes = {name: scene.attributes[name] for name in self.contender.sees}
        return {
            "scene": self.scene.name,
            "points": scene.digest,
            **({"attributes": attributes} if attributes else {}),
            "kind": self.scene.kind,
            "fraction": self.fraction,
            "seed": self.seed,
            **({} if self.scheme == DEFAULT_SCHEME else {"scheme": self.scheme}),
            "method": identity_of(self.contender, self.cloud_key),
            "device": self.device,
        }


@dataclass(frozen=True)
class Store:
    """Folder of a run: ``predictions/KEY.npz`` with ``KEY.json``, its record; ``scores/KEY.json``."""

    folder: Path

    @cached_property
    def predictions(self) -> Path:
        """Folder of predictions."""
        return _made(self.folder / "predictions")

    @cached_property
    def scores(self) -> Path:
        """Folder of scores."""
        return _made(self.folder / "scores")

    def prediction(self, cell: Cell) -> Path:
        """Path of the recovery; if it exists, the cell is predicted."""
        return self.predictions / f"{cell.key}.npz"

    def record(self, cell: Cell) -> Path:
        """Path of the record of the prediction."""
        return self.predictions / f"{cell.key}.json"

    def done(self, cell: Cell) -> bool:
        """Whether the cell is predicted, by the present source if the method is a user's own."""
        if not (self.prediction(cell).is_file() and self.record(cell).is_file()):
            return False
        source = source_of(cell.contender)
        # Records of earlier versions do not say it.
        return source is None or read_json(self.record(cell)).get("source", source) == source

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against other runs, and remove unfinished files of a killed run.

        Raises
        ------
        InputError
            If another run has locked it.
        """
        with open(self.folder / "lock", "w", encoding="ascii") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f"another run is at work in {self.folder}; wait for it, or choose another folder (name=...); "
                    "steps=[score] shows what it has so far"
                ) from None
            self._sweep()
            try:
                yield
            finally:
                self._sweep()

    def _sweep(self) -> None:
        for left in self.folder.rglob(".l2p-*.tmp"):
            left.unlink(missing_ok=True)

    def check(self, cells: Sequence[Cell]) -> None:
        """Refuse to mix runs: existing predictions must have been made with the settings of their cells."""
        for cell in cells:
            if not self.done(cell):
                continue
            made, wanted = read_json(self.record(cell))["identity"], _plain(cell.identity())
            for name in sorted({*made, *wanted}):
                if made.get(name) != wanted.get(name):
                    raise InputError(
                        f"{self.prediction(cell)} was made with {name} {made.get(name)}, not {wanted.get(name)}; "
                        "choose another run folder (name=...), another label, or delete the file"
                    )


def cells_of(settings: Settings, scenes: Sequence[SceneSource]) -> list[Cell]:
    """List all cells, beginning with the first fraction of every scene.

    Raises
    ------
    InputError
        If two cells would share a file.
    """
    cells = [
        Cell(scene, fraction, seed, contender, settings.device, scheme)
        for scheme in settings.schemes
        for fraction in settings.fractions
        for seed in settings.seeds
        for scene in scenes
        for contender in settings.methods
        if contender.serves(scheme)
    ]
    if not cells:
        raise InputError(f"got no method for the schemes {', '.join(settings.schemes)}; give others")
    owner: dict[str, str] = {}
    for cell in cells:
        label = cell.contender.label
        if owner.setdefault(cell.key, label) != label:
            raise InputError(
                f"got labels {owner[cell.key]!r} and {label!r}; expected them to differ in letters or digits"
            )
    return cells


def without_unseen(cells: Sequence[Cell]) -> list[Cell]:
    """Leave out, with a line in the log, scenes that lack an attribute that a method sees, or have one that it cannot
    use.

    Raises
    ------
    InputError
        If no cell is left.
    """
    why: dict[tuple[str, str], str] = {}
    for cell in cells:
        key = (cell.scene.source, cell.contender.label)
        if key not in why:
            why[key] = _unseen(cell.scene, cell.contender)
            if why[key]:
                log.warning("%s is left out on %s: %s", cell.contender.label, cell.scene.name, why[key])
    left = [cell for cell in cells if not why[cell.scene.source, cell.contender.label]]
    if not left:
        raise InputError(f"got no scene that has what its methods see ({next(iter(why.values()))}); give others")
    return left


def _unseen(scene: SceneSource, contender: Contender) -> str:
    """Why the method cannot see in this scene what it should; empty if it can."""
    if not contender.sees:
        return ""
    appearance = load(scene.source).appearance
    missing = [name for name in contender.sees if name not in appearance.names]
    if missing:
        return f"the scene has no {' and no '.join(missing)}"
    unused = [name for name in contender.sees if name not in contender.uses(appearance)]
    kind = f" of kind {appearance.descriptor_kind}" if "descriptor" in unused else ""
    return f"the method cannot use {' and '.join(unused)}{kind}" if unused else ""


def predict(cell: Cell, store: Store) -> None:
    """Run the method and write the prediction whole or not at all, after its record."""
    trial, identity = cell.trial(), cell.identity()
    with measured_peak() as peak:
        began = time.perf_counter()
        recovery = cell.contender.recover(trial)
        seconds = time.perf_counter() - began
        peak_gib = peak()
    record = {
        "identity": identity,
        "seconds": seconds if cell.contender.timed else None,
        "peak_gib": peak_gib,
        "threads": torch.get_num_threads(),
        "info": recovery.info,
        "commit": commit(),
        "code": source_digest(),
        "source": source_of(cell.contender),
        "made": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
    write_json(store.record(cell), record)
    save_recovery(_compact(recovery), store.prediction(cell), overwrite=True)


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file whole or not at all."""
    with atomic_file(path, overwrite=True) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode("utf-8"))


def read_json(path: Path) -> Any:
    """Read a JSON file of this program."""
    try:
        return json.loads(path.read_bytes())
    except ValueError as error:
        raise InputError(f"{path} is damaged; delete it, and the same command makes it anew") from error


def _compact(recovery: Recovery) -> Recovery:
    """Store neighbours in 32 bits: they fill most of a prediction."""
    if recovery.neighbors is None:
        return recovery
    return replace(recovery, neighbors=recovery.neighbors.astype(np.int32))


def _plain(content: Any) -> Any:
    """Convert content to the form that JSON returns."""
    return json.loads(json.dumps(content))


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
