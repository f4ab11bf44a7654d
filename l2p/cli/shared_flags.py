"""Flags that several commands have."""

from __future__ import annotations

import argparse

from l2p.maps import ATTRIBUTES
from l2p.work.memory import SHARE


def seed_of(word: str) -> int:
    """Parse a seed that random generators accept and files can hold."""
    value = int(word) if word.strip().isdecimal() else -1
    if not 0 <= value < 2**63:
        raise argparse.ArgumentTypeError(f"got {word}; expected 0 to 2^63 - 1")
    return value


def add_ignore(command: argparse.ArgumentParser, where: str) -> None:
    command.add_argument(
        "--ignore",
        type=attributes,
        default=(),
        metavar="NAMES",
        help=f"attributes {where} to leave out, as if they were not published: some of {', '.join(ATTRIBUTES)}, comma "
        "separated",
    )


def attributes(words: str) -> tuple[str, ...]:
    """Parse a comma-separated list of published attributes, in the order of ``ATTRIBUTES``."""
    names = {word.strip() for word in words.split(",")}
    if not names <= set(ATTRIBUTES):
        raise argparse.ArgumentTypeError(f"got {words!r}; expected some of {', '.join(ATTRIBUTES)}, comma separated")
    return tuple(name for name in ATTRIBUTES if name in names)


def add_device(command: argparse.ArgumentParser) -> None:
    command.add_argument("--device", default="cpu", help="torch device (default: %(default)s)")


def add_threads(command: argparse.ArgumentParser) -> None:
    command.add_argument("--threads", type=int, metavar="T", help="CPU threads (default: what torch chooses)")


def add_memory(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--memory",
        type=float,
        metavar="GIB",
        help="most memory that the attack may take beyond what the program holds anyway; sets how much is done at a "
        f"time, never what comes out (default: {100 * SHARE:g} %% of what is free)",
    )


def add_json(command: argparse.ArgumentParser, metavar: str, what: str) -> None:
    command.add_argument("--json", metavar=metavar, help=f"write {what} as JSON; - is stdout, in place of the table")


def add_force(command: argparse.ArgumentParser) -> None:
    command.add_argument("--force", action="store_true", help="replace outputs that exist")
