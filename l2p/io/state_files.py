"""The state of a run: what is known after its last finished round, in a file beside the output until that is there."""

from __future__ import annotations

import json
import os
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from l2p.errors import InputError
from l2p.io.atomic import atomic_file
from l2p.io.npz import Fields, npz_bytes, npz_keys, read_npz
from l2p.work.journal import Journal, Saved

#: Version of the file; it lives as long as a run, so no other is read.
STATE_VERSION = 1
_PART = "part_"


def state_path(output: str | PathLike[str]) -> Path:
    """Where the state of a run is that writes ``output``."""
    return Path(f"{os.fspath(output).rstrip(os.sep)}.state")


class StateFile(Journal):
    """A journal in a file, replaced as a whole after each round.

    Parameters
    ----------
    output : path
        What the run writes in the end.
    resume : bool
        Go on from the state if there is one; else there must be none, or ``overwrite``.

    Raises
    ------
    InputError
        If there is a state that must not be replaced.
    """

    def __init__(self, output: str | PathLike[str], *, resume: bool, overwrite: bool) -> None:
        self.path = state_path(output)
        self._about: dict[str, Any] = {}
        self._last: Saved | None = None
        self._resume = resume
        if self.path.exists() and not (resume or overwrite):
            raise InputError(
                f"{self.path} has the finished rounds of a run that was ended; add --resume to go on from them, or "
                "--force to begin again"
            )

    def begin(self, about: dict[str, Any]) -> None:
        """Begin a run, or go on with it if it is the same: lines, method, settings, checkpoint, version of l2p."""
        self._about = json.loads(json.dumps(about))  # as it comes back from the file
        if not (self._resume and self.path.exists()):
            return
        fields = Fields(self.path, ("about", "rounds", "version"))
        other = _differences(_about(self.path, fields), self._about)
        if other:
            raise InputError(
                f"{self.path} is of a run with other {', '.join(other)}; give those of that run, or --force without "
                "--resume to begin again"
            )
        self._last = _saved(self.path, fields)

    def last(self) -> Saved | None:
        """What the run goes on from."""
        return self._last

    def save(self, saved: Saved) -> None:
        """Replace the file."""
        parts = {_PART + name: part for name, part in saved.state.items()}
        about = np.array(json.dumps(self._about, sort_keys=True))
        with atomic_file(self.path, overwrite=True) as file:
            file.write(
                npz_bytes(
                    {**parts, "rounds": np.array(saved.rounds), "about": about, "version": np.array(STATE_VERSION)}
                )
            )

    def remove(self) -> None:
        """Once the output is written."""
        self.path.unlink(missing_ok=True)


def _about(path: Path, fields: Fields) -> dict[str, Any]:
    fields.take_version(STATE_VERSION)
    try:
        about = json.loads(fields.take_text("about"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged; remove it to begin the run again") from error
    return about if isinstance(about, dict) else {}


def _differences(saved: dict[str, Any], about: dict[str, Any]) -> list[str]:
    """What the runs differ in; of settings, which."""
    other = [name for name in {**saved, **about} if name != "settings" and saved.get(name) != about.get(name)]
    if other:
        return other
    one, two = ({} if not isinstance(run.get("settings"), dict) else run["settings"] for run in (saved, about))
    return [name for name in {**one, **two} if one.get(name) != two.get(name)]


def _saved(path: Path, fields: Fields) -> Saved:
    rounds = int(fields.take("rounds", "iu", ()))
    arrays = read_npz(path, [name for name in npz_keys(path) if name.startswith(_PART)])
    parts = {name.removeprefix(_PART): part for name, part in arrays.items()}
    if rounds < 1 or not all(part.dtype.kind == "f" and np.isfinite(part).all() for part in parts.values()):
        raise InputError(f"{path} is damaged; remove it to begin the run again")
    return Saved(rounds, parts)
