"""Flags of ``l2p lift`` that choose how points are hidden."""

from __future__ import annotations

import argparse

from l2p.schemes.scheme import CELLS, DEFAULT_SCHEME, MEANINGS, SCHEMES
from l2p.utility import POINTS


def add_scheme(command: argparse.ArgumentParser) -> None:
    """Add ``--scheme`` and what single schemes need."""
    command.add_argument(
        "--scheme",
        choices=(*SCHEMES, POINTS),
        default=DEFAULT_SCHEME,
        metavar="NAME",
        help="how points are hidden, see below (default: %(default)s)",
    )
    command.add_argument(
        "--cell",
        type=float,
        metavar="L",
        help=f"side of the cells of {CELLS}, in scene units; the authors take half a metre (default: a twentieth of "
        "the map's largest side)",
    )


def scheme_table() -> str:
    """Return the names of all schemes, each with what it does, one a line."""
    meanings = {**MEANINGS, POINTS: "not hidden at all: the chosen fraction, as it is, to npz or PLY"}
    width = max(map(len, meanings))
    return "schemes:\n" + "\n".join(f"  {name:{width}}  {what}" for name, what in meanings.items())
