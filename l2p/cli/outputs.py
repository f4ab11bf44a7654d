"""Helpers shared by the commands of ``l2p``: early checks of outputs, figures as JSON, threads."""

from __future__ import annotations

import json
import os
import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from l2p.attacks.settings import checked_settings
from l2p.checks import check_fraction
from l2p.cli.flags import settings_of
from l2p.errors import InputError
from l2p.io.atomic import atomic_file, check_file
from l2p.io.taken_for import taken_for
from l2p.maps.lines import LineCloud
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud
from l2p.maps.scene import Scene
from l2p.work.launched import MOST_THREADS


def check_outputs(inputs: list[str], outputs: list[str | None], force: bool) -> None:
    """Refuse, before any work, outputs that cannot be written, are also inputs, or are given twice."""
    taken = {os.path.realpath(path) for path in inputs}
    for path in outputs:
        if path is None:
            continue
        if os.path.realpath(path) in taken:
            raise InputError(f"got {path} twice; expected every output to be a file of its own")
        taken.add(os.path.realpath(path))
        check_file(path, overwrite=force)


def check_inputs(*paths: str | None, expected: str = "") -> None:
    """Refuse, before any work, files and folders that are not there; ``expected`` says what should be."""
    for path in paths:
        if path and not os.path.lexists(path):
            raise FileNotFoundError(f"{path} does not exist" + (f"; expected {expected}" if expected else ""))


def file_of(json_path: str | None) -> str | None:
    return None if json_path == "-" else json_path


def say_taken(path: str, content: Scene | LineCloud | PlaneCloud | PermutedCloud, arguments: Namespace) -> None:
    """Say what a file was taken for, on stdout unless that is for the figures."""
    print(taken_for(path, content, arguments.columns), file=sys.stderr if arguments.json == "-" else sys.stdout)


@contextmanager
def figures_file(arguments: Namespace, figures: dict[str, Any]) -> Iterator[None]:
    """Write the figures to the file of --json, after the block has written its own output."""
    text = json.dumps(figures, indent=2) + "\n"
    if arguments.json in (None, "-"):
        yield
        if arguments.json == "-":
            print(text, end="")
        return
    with atomic_file(arguments.json, overwrite=arguments.force) as file:
        file.write(text.encode("utf-8"))
        yield


def check_attack(arguments: Namespace) -> None:
    """Refuse, before torch is loaded, an attack or settings that cannot be, and a checkpoint that is not there."""
    checked_settings(arguments.method, settings_of(arguments))
    if getattr(arguments, "fraction", None) is not None:
        check_fraction(arguments.fraction)
    check_inputs(arguments.checkpoint, expected="a checkpoint file, *.safetensors")
    check_threads(arguments.threads)


def check_threads(threads: int | None) -> None:
    if threads is None:
        return
    if not 1 <= threads <= MOST_THREADS:
        raise InputError(f"got --threads {threads}; expected at least 1, at most {MOST_THREADS}")


def set_threads(threads: int | None) -> None:
    if threads is not None:
        import torch

        torch.set_num_threads(threads)
