"""Flags of ``l2p picture``."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError

from l2p.auditing import MOST_VIEWS, VIEWS


def add_picture(command: ArgumentParser) -> None:
    """Add the arguments of the command."""
    command.add_argument(
        "source",
        metavar="SOURCE",
        help="recovery npz, scene with colours or descriptors, or a line cloud whose lines meet in centres (a ray "
        "cloud or a sphere cloud), which is a picture before any depth is recovered",
    )
    command.add_argument("-o", dest="output", metavar="OUT.png", required=True, help="picture to write, .png or .jpg")
    command.add_argument("--model", metavar="MODEL", help="COLMAP model of the view (default: SOURCE, if it is one)")
    command.add_argument("--view", metavar="NAME", help="name of an image of the model, whose camera to take")
    command.add_argument("--at", type=_place, metavar="X,Y,Z", help="place of a camera, in place of --view")
    command.add_argument("--toward", type=_place, metavar="X,Y,Z", help="place that this camera looks at")
    command.add_argument(
        "--up", type=_place, default=(0.0, -1.0, 0.0), metavar="X,Y,Z", help="upward direction (default: 0,-1,0)"
    )
    command.add_argument(
        "--angle", type=float, default=60.0, metavar="DEG", help="angle of view across the picture (default: 60)"
    )
    command.add_argument("--size", type=_size, metavar="WxH", help="pixels of the picture of a placed camera")
    command.add_argument(
        "--lines", metavar="LINES.npz", help="line cloud that a recovery is of: its descriptors are used, too"
    )
    command.add_argument("--center", type=int, default=1, metavar="N", help="centre to look from, of a line cloud")
    command.add_argument(
        "--photographs",
        metavar="FOLDER",
        help="photographs of the model, to tell how like its own the picture is (default: images or thumbs beside it)",
    )
    command.add_argument("--weights", metavar="FILE", help="weights of python -m train --config-name pictures")


def add_views(command: ArgumentParser) -> None:
    """Add which pictures an audit shows."""
    command.add_argument(
        "--views",
        type=int,
        metavar="N",
        help=f"pictures of so many views of a COLMAP model as attackers see them, 0 to {MOST_VIEWS} (default: {VIEWS})",
    )
    command.add_argument(
        "--photographs",
        metavar="FOLDER",
        help="photographs of the model, shown beside the pictures (default: images or thumbs beside it)",
    )


def _place(word: str) -> tuple[float, ...]:
    try:
        parts = tuple(float(part) for part in word.split(","))
    except ValueError:
        parts = ()
    if len(parts) != 3 or not all(abs(part) < float("inf") for part in parts):
        raise ArgumentTypeError(f"got {word!r}; expected three numbers, X,Y,Z")
    return parts


def _size(word: str) -> tuple[int, int]:
    width, _, height = word.partition("x")
    if not (width.isdecimal() and height.isdecimal() and 16 <= int(width) <= 4096 and 16 <= int(height) <= 4096):
        raise ArgumentTypeError(f"got {word!r}; expected WIDTHxHEIGHT, each 16 to 4096 pixels")
    return int(width), int(height)
