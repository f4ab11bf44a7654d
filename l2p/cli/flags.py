"""Flags for the settings of the attacks, generated from their declarations (:mod:`l2p.attacks.settings`)."""

from __future__ import annotations

import argparse
from dataclasses import fields
from typing import Any

from l2p.attacks.settings import ATTACKS, DEFAULT_METHOD, METHODS, owners_of, setting_names

#: Type of a flag by the annotation of its setting.
_TYPES = {"str": str, "int": int, "float": float}


def add_method(command: argparse.ArgumentParser, leave_out: tuple[str, ...] = ()) -> None:
    """Add ``--method``, and a flag for each setting of an attack, except those in ``leave_out``."""
    command.add_argument(
        "--method",
        metavar="NAME",
        default=DEFAULT_METHOD,
        help=f"the attack: {', '.join(METHODS)}, or your own, package.module:Attack (default: %(default)s)",
    )
    for name in setting_names():
        if name not in leave_out:
            _add_setting(command, name)


#: What the flags of points do, by their first word.
POINT_FLAGS = {"drop": "leave out", "region": "tell how much comes back of"}


def add_points(command: argparse.ArgumentParser, flag: str) -> None:
    """Add the flags that choose points, ``--drop-box`` and so on (:mod:`l2p.cli.chosen`)."""
    what = POINT_FLAGS[flag]
    command.add_argument(
        f"--{flag}-box",
        type=float,
        nargs=6,
        action="append",
        default=[],
        metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help=f"{what} the points in the box between two corners, scene units; may be given more than once, and inf has "
        "no end",
    )
    command.add_argument(
        f"--{flag}-ids",
        metavar="FILE",
        help=f"{what} the points of these ids (COLMAP's point3D_id): text, npy, or npz with point3D_id",
    )
    command.add_argument(
        f"--{flag}-masks",
        metavar="FOLDER",
        help=f"{what} each point that an image of the COLMAP model sees in a black pixel of its mask, "
        "FOLDER/IMAGE_NAME.png",
    )


def add_columns(command: argparse.ArgumentParser) -> None:
    """Add ``--columns``."""
    command.add_argument(
        "--columns",
        metavar="NAMES",
        help="what the columns of a text or npy file hold, in their order: x,y,z,dx,dy,dz (points and directions), "
        "x1,y1,z1,x2,y2,z2 (two points of each line), dx,dy,dz,mx,my,mz (Plücker), x,y,z,r,g,b or x,y,z,nx,ny,nz "
        "(points), - for one that is not used (default: what a header or the numbers tell)",
    )


def settings_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the settings given on the command line."""
    values = {name: getattr(arguments, name, None) for name in setting_names()}
    return {name: value for name, value in values.items() if value is not None}


def _add_setting(command: argparse.ArgumentParser, name: str) -> None:
    owners = owners_of(name)
    declared = [next(entry for entry in fields(ATTACKS[owner].settings) if entry.name == name) for owner in owners]
    texts = [
        f"{owner}: {entry.metadata['help']} (default: {entry.metadata['shown']})"
        for owner, entry in zip(owners, declared, strict=True)
    ]
    kind = _TYPES[str(declared[0].type).removesuffix(" | None")]
    flag = declared[0].metadata["flag"]
    command.add_argument(f"--{name.replace('_', '-')}", type=kind, help="; ".join(texts), **flag)
