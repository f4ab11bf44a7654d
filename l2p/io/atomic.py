"""Atomic outputs: written under a temporary name beside the target, and renamed when complete."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

from l2p.errors import InputError


@contextmanager
def atomic_file(path: str | PathLike[str], *, overwrite: bool = False) -> Iterator[BinaryIO]:
    """Open a binary file that becomes ``path`` if the block succeeds; otherwise nothing is left behind.

    Raises
    ------
    InputError
        If ``path`` exists (without ``overwrite``), is a folder, has no parent folder, or cannot be written.
    """
    check_file(path, overwrite=overwrite)
    temporary = _sibling(path)
    with _explained(path):
        try:
            with open(temporary, "xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, _target(path))
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(
    path: str | PathLike[str], *, overwrite: bool = False, replaceable: frozenset[str] = frozenset()
) -> Iterator[Path]:
    """Make an empty folder that becomes ``path`` if the block succeeds; otherwise nothing is left behind.

    Parameters
    ----------
    replaceable : set of str
        Names of the files that ``overwrite`` may delete; a folder that holds anything else is never replaced.

    Raises
    ------
    InputError
        If ``path`` exists and may not be replaced, is a file, has no parent folder, or cannot be written.
    """
    check_folder(path, overwrite=overwrite, replaceable=replaceable)
    temporary = _sibling(path)
    with _explained(path):
        try:
            temporary.mkdir()
            yield temporary
            _put_folder(temporary, _target(path))
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def check_file(path: str | PathLike[str], *, overwrite: bool = False) -> None:
    """Raise InputError for an output file that cannot or must not be written, before the work for it starts."""
    if not os.path.basename(path):
        raise InputError(f"got {os.fspath(path)!r}; expected the name of a file to write")
    target = _target(path)
    with _explained(path):
        if target.is_dir():
            raise InputError(f"{path} is a folder; expected the name of a file to write")
        if target.exists() and not target.is_file():
            raise InputError(f"{path} is not a regular file; choose another path")
        _check_target(path, overwrite)


def check_folder(
    path: str | PathLike[str], *, overwrite: bool = False, replaceable: frozenset[str] = frozenset()
) -> None:
    """Raise InputError for an output folder that cannot or must not be written, before the work for it starts."""
    if not os.fspath(path):
        raise InputError("got an empty path; expected the name of a folder to write")
    target = _target(path)
    with _explained(path):
        if target.exists() and not target.is_dir():
            raise InputError(f"{path} is a file; expected the name of a folder to write")
        _check_target(path, overwrite)
        foreign = sorted(set(os.listdir(target)) - replaceable) if target.is_dir() else []
    if foreign:
        raise InputError(f"{path} holds {foreign[0]}, which l2p did not write there; choose another path")


def _check_target(path: str | PathLike[str], overwrite: bool) -> None:
    """Checks that files and folders share."""
    target = _target(path)
    if not target.parent.is_dir():
        raise InputError(f"the folder of {path} does not exist; create it or choose another path")
    if target.exists() and not overwrite:
        raise InputError(f"{path} exists; choose another path, or replace it (--force, overwrite=True)")
    # A trial write: permissions alone do not show whether the file system accepts files.
    with TemporaryFile(dir=target.parent):
        pass


def _put_folder(source: Path, target: Path) -> None:
    """Rename ``source`` to ``target``; if that fails, the old folder is restored."""
    if not target.exists():
        os.replace(source, target)
        return
    old = _sibling(target)
    os.replace(target, old)
    try:
        os.replace(source, target)
    except BaseException:
        os.replace(old, target)
        raise
    shutil.rmtree(old)


def _target(path: str | PathLike[str]) -> Path:
    """The path with links resolved: the file is replaced, not the link to it."""
    return Path(os.path.realpath(path))


def _sibling(path: str | PathLike[str]) -> Path:
    """A temporary name in the same folder, so that renaming is atomic."""
    target = _target(path)
    return target.with_name(f".l2p-{secrets.token_hex(8)}.tmp")


@contextmanager
def _explained(path: str | PathLike[str]) -> Iterator[None]:
    """Raise InputError in place of an OSError of the block."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write {path}: {(error.strerror or str(error)).lower()}") from error
