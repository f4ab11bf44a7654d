"""The state of a run after its last finished round: a file beside the output, removed once that is written."""

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

#: Version of the format; a state lives as long as its run, so no other version is read.
STATE_VERSION = 1
_PART = "part_"


def state_path(output: str | PathLike[str]) -> Path:
    """Path of the state of the run that writes ``output``."""
    return Path(f"{os.fspath(output).rstrip(os.sep)}.state")


class StateFile(Journal):
    """A journal in a file, replaced as a whole after each round.

    Parameters
    ----------
    output : path
        Output of the run; the state is beside it.
    resume : bool
        Continue from the state, if there is one.
    overwrite : bool
        Replace a state that exists.

    Raises
    ------
    InputError
        If there is a state, and neither ``resume`` nor ``overwrite``.
    """

    def __init__(self, output: str | PathLike[str], *, resume: bool, overwrite: bool) -> None:
        self.path = state_path(output)
        self._about: dict[str, Any] = {}
        self._last: Saved | None = None
        self._resume = resume
        if self.path.exists() and not (resume or overwrite):
            raise InputError(
                f"{self.path} has the finished rounds of an interrupted run; add --resume to go on from them, or "
                "--force to begin again"
            )

    def begin(self, about: dict[str, Any]) -> None:
        """Begin a run, or load the state of the last one.

        Raises
        ------
        InputError
            If the state is damaged, or that of other lines, methods, settings, checkpoints or versions of l2p.
        """
        self._about = json.loads(json.dumps(about))  # as JSON returns it
        if not (self._resume and self.path.exists()):
            return
        fields = Fields(self.path, ("about", "rounds", "version"))
        other = _differences(_about(self.path, fields), self._about)
        if other:
            raise InputError(
                f"{self.path} is of a run with other {', '.join(other)}; give those of that run, or --force without "
                "--resume to begin again"
            )
        self._last = _read_state(self.path, fields)

    def last(self) -> Saved | None:
        """The state that the run continues from; None for a new run."""
        return self._last

    def save(self, saved: Saved) -> None:
        """Replace the saved state by this one."""
        arrays = {_PART + name: array for name, array in saved.state.items()}
        about = np.array(json.dumps(self._about, sort_keys=True))
        with atomic_file(self.path, overwrite=True) as file:
            file.write(
                npz_bytes(
                    {**arrays, "rounds": np.array(saved.rounds), "about": about, "version": np.array(STATE_VERSION)}
                )
            )

    def remove(self) -> None:
        """Delete the file, once the output is written."""
        self.path.unlink(missing_ok=True)


def _about(path: Path, fields: Fields) -> dict[str, Any]:
    fields.take_version(STATE_VERSION)
    try:
        about = json.loads(fields.take_text("about"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged; remove it to begin the run again") from error
    return about if isinstance(about, dict) else {}


def _differences(saved: dict[str, Any], about: dict[str, Any]) -> list[str]:
    """Names of the entries in which two runs differ; if only settings differ, names of these."""
    other = [name for name in {**saved, **about} if name != "settings" and saved.get(name) != about.get(name)]
    if other:
        return other
    one, two = ({} if not isinstance(run.get("settings"), dict) else run["settings"] for run in (saved, about))
    return [name for name in {**one, **two} if one.get(name) != two.get(name)]


def _read_state(path: Path, fields: Fields) -> Saved:
    rounds = int(fields.take("rounds", "iu", ()))
    arrays = read_npz(path, [name for name in npz_keys(path) if name.startswith(_PART)])
    if rounds < 1 or not all(array.dtype.kind == "f" and np.isfinite(array).all() for array in arrays.values()):
        raise InputError(f"{path} is damaged; remove it to begin the run again")
    return Saved(rounds, {name.removeprefix(_PART): array for name, array in arrays.items()})
