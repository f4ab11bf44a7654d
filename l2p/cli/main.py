"""Command ``l2p``: flags and exit codes; the work is in :mod:`l2p.cli.commands`, loaded when a command runs."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

from l2p.auditing import FRACTIONS
from l2p.cli.completion import SHELLS, completion_script
from l2p.cli.flags import add_columns, add_method, add_points
from l2p.cli.help_words import ending
from l2p.cli.localize_flags import add_decision, add_localization
from l2p.cli.parser import USER_ERROR, Parser, complain
from l2p.cli.picture_flags import add_picture, add_views
from l2p.cli.scheme_flags import add_scheme, scheme_table
from l2p.cli.shared_flags import add_device, add_force, add_ignore, add_json, add_memory, add_threads, seed_of
from l2p.cli.shown_once import warnings_shown_once
from l2p.errors import InputError, LostProcessError, sentence
from l2p.judging import CLEANING
from l2p.schemes.scheme import SCHEMES
from l2p.show.page import MOST_POINTS
from l2p.version import __version__

#: Exit codes: a rank died, and Ctrl-C (128 + SIGINT).
LOST, INTERRUPTED = 1, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0 done, 1 if a rank died, 2 for a user's error, 130 after Ctrl-C."""
    parser, words = _parser(), sys.argv[1:] if argv is None else list(argv)
    if not words:
        parser.print_help()
        return 0
    arguments = parser.parse_args(words)
    arguments.words = words
    if arguments.command == "completion":
        print(completion_script(parser, arguments.shell), end="")
        return 0
    # Waiting threads should sleep: on a busy machine, spinning threads take several times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Silence torch's stack trace when a rank dies.
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "FATAL")
    try:
        from l2p.cli import commands

        with warnings_shown_once():
            getattr(commands, arguments.command)(arguments)
    except (InputError, OSError) as error:
        complain(sentence(error))
        return USER_ERROR
    except LostProcessError as error:
        complain(sentence(error))
        return LOST
    except KeyboardInterrupt:
        print(f"l2p: interrupted; {_left(arguments)}", file=sys.stderr)
        return INTERRUPTED
    return 0


def _left(arguments: argparse.Namespace) -> str:
    """Describe the state that an interrupted command leaves behind."""
    if arguments.command == "recover":
        from l2p.io.state_files import state_path

        if state_path(arguments.output).exists():
            return f"start again with --resume to go on from the finished rounds in {state_path(arguments.output)}"
    return "nothing was written"


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="l2p",
        description="Lift points to lines, and recover the points behind a line cloud.",
        epilog="l2p COMMAND --help explains a command, with an example.\nA first look: l2p demo -o demo",
    )
    parser.add_argument("--version", action="version", version=f"l2p {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (
        _add_lift,
        _add_recover,
        _add_evaluate,
        _add_localize,
        _add_audit,
        _add_view,
        _add_picture,
        _add_info,
        _add_demo,
    ):
        add(commands)
    completion = _command(commands, "completion", "print a script that completes the words of l2p in a shell")
    completion.add_argument("shell", choices=SHELLS, help="bash or zsh")
    return parser


def _command(commands: Any, name: str, what: str) -> Parser:
    command = commands.add_parser(name, help=what, description=what[0].upper() + what[1:] + ".")
    # Its address takes a look at the installed packages, which only a reader of the help should wait for.
    command.ending = lambda: ending(name)
    return command


def _add_lift(commands: Any) -> None:
    lift = _command(commands, "lift", "hide the points of a scene, by lines through them or by another scheme")
    lift.epilog = scheme_table()
    lift.add_argument("scene", metavar="SCENE", help="COLMAP model folder (bin or txt), PLY, npz with xyz, or text")
    lift.add_argument(
        "-o",
        dest="output",
        metavar="LINES.npz",
        required=True,
        help="line cloud to write, .ply and .obj to look at; planes and permuted points go to .npz only",
    )
    lift.add_argument("--truth", metavar="TRUTH.npz", help="also write the points, and which line hides each")
    lift.add_argument(
        "--fraction",
        type=float,
        default=1.0,
        metavar="F",
        help="fraction of the points, in (0, 1] (default: %(default)s)",
    )
    add_scheme(lift)
    lift.add_argument(
        "--seed",
        type=seed_of,
        metavar="S",
        help="seed of the directions and the subset; without it a fresh one comes from the system and is kept nowhere: "
        "whoever can guess the seed can redraw the directions and learn which line belongs to which point, so leave "
        "it out for a line cloud that is published",
    )
    lift.add_argument("--rgb", action="store_true", help="store the colours of the points, which help an attacker")
    lift.add_argument(
        "--descriptors",
        nargs="?",
        const="",
        metavar="FILE",
        help="store the descriptors of the points, which help an attacker more: those of FILE (COLMAP's database.db, "
        "hloc's features, or npz), or, without FILE, those of an npz scene or found beside a COLMAP model",
    )
    add_columns(lift)
    add_points(lift, "drop")
    add_force(lift)


def _add_recover(commands: Any) -> None:
    recover = _command(commands, "recover", "recover the points behind a line cloud")
    recover.add_argument(
        "lines",
        metavar="LINES",
        nargs="+",
        help="line cloud: npz, PLY or OBJ line set, text (see --columns); further ones are other releases of the "
        "same map, in the same coordinates: their lines meet those of the first in its points",
    )
    recover.add_argument(
        "-o",
        dest="output",
        metavar="OUT",
        required=True,
        help="OUT.npz (every line, in order), OUT.ply, OUT.txt, OUT.csv (with confidence), OUT.xyz, or a folder for a "
        "COLMAP model",
    )
    add_method(recover)
    recover.add_argument(
        "--scheme",
        choices=tuple(SCHEMES),
        metavar="NAME",
        help="scheme of lines whose file does not say it, as of lines through pairs: a name of l2p lift --scheme",
    )
    add_columns(recover)
    add_ignore(recover, "of the file")
    _add_filters(recover)
    recover.add_argument(
        "--double",
        action="store_true",
        help="write coordinates of a PLY with 64 bits (default: with 32, unless these would lose digits)",
    )
    recover.add_argument("--model", metavar="MODEL", help="for a COLMAP model: the model that was lifted")
    recover.add_argument(
        "--truth", metavar="TRUTH.npz", help="for a COLMAP model: which line is which point id (nothing else is used)"
    )
    add_device(recover)
    recover.add_argument(
        "--seed",
        type=seed_of,
        metavar="S",
        help="recorded with the result; no attack draws random numbers",
    )
    add_threads(recover)
    recover.add_argument(
        "--processes",
        type=int,
        metavar="P",
        help="share the lines out over so many processes of this machine; torchrun does it over several machines",
    )
    recover.add_argument(
        "--resume",
        action="store_true",
        help="continue an interrupted run from OUT.state, if there is one",
    )
    add_memory(recover)
    add_json(recover, "STATS", "settings, seconds and confidences")
    add_force(recover)


def _add_filters(recover: argparse.ArgumentParser) -> None:
    recover.add_argument(
        "--min-confidence",
        type=float,
        metavar="C",
        help="drop less confident points from a PLY or COLMAP model; an npz, which keeps the order of the lines, "
        "marks the others in its array kept. In [0, 1]: with learned the probability of lying within one spacing, "
        "with other methods a number that only ranks",
    )
    recover.add_argument(
        "--clean",
        action="store_true",
        help="drop outliers among the recovered points in the same way (Open3D; "
        + ", then ".join(f"{neighbors} neighbours, {sigma:g} sigma" for neighbors, sigma in CLEANING)
        + ")",
    )


def _add_evaluate(commands: Any) -> None:
    evaluate = _command(commands, "evaluate", "measure a recovery against the truth")
    evaluate.add_argument("recovery", metavar="OUT.npz", help="recovery that l2p recover wrote")
    evaluate.add_argument("truth", metavar="TRUTH.npz", help="truth that l2p lift --truth wrote")
    evaluate.add_argument("--metric", action="store_true", help="the scene is in metres: also count within 1 to 50 cm")
    add_json(evaluate, "FILE", "the figures")
    add_force(evaluate)


def _add_localize(commands: Any) -> None:
    localize = _command(commands, "localize", "tell how well the images of a model are localized in what is published")
    add_localization(localize)
    localize.add_argument(
        "--seed", type=seed_of, default=0, metavar="S", help="seed of the releases and samples (default: %(default)s)"
    )
    add_json(localize, "FILE", "the figures")
    localize.add_argument("--csv", metavar="FILE", help="write every query of every release as CSV")
    add_force(localize)


def _add_audit(commands: Any) -> None:
    audit = _command(commands, "audit", "tell what could be got back of a map, as a page to look at")
    audit.add_argument(
        "scene",
        metavar="SCENE",
        help="COLMAP model folder, PLY, npz or text; or a line cloud, of which less can be told",
    )
    audit.add_argument(
        "-o", dest="output", metavar="REPORT_DIR", required=True, help="folder to write: index.html, audit.json"
    )
    audit.add_argument(
        "--name", metavar="NAME", help="name of the map on the page (default: that of its file or folder)"
    )
    audit.add_argument(
        "--share",
        action="store_true",
        help="write a report that can be passed on: figures and curves, but no point of the map, no path, no machine",
    )
    audit.add_argument(
        "--fractions",
        type=float,
        nargs="+",
        metavar="F",
        help="fractions of the points to publish, in (0, 1] "
        f"(default: {' '.join(f'{share:g}' for share in FRACTIONS)}); not with a line cloud",
    )
    audit.add_argument(
        "--seed", type=seed_of, default=0, metavar="S", help="seed of the line clouds (default: %(default)s)"
    )
    add_method(audit, leave_out=("fraction",))
    audit.add_argument(
        "--descriptors",
        nargs="?",
        const="",
        metavar="FILE",
        help="descriptors that are published with a COLMAP model (default without FILE: those found beside the model); "
        "an npz scene has its own",
    )
    add_columns(audit)
    add_ignore(audit, "of the map")
    add_points(audit, "drop")
    add_points(audit, "region")
    audit.add_argument(
        "--schemes",
        nargs="+",
        default=[],
        choices=tuple(SCHEMES),
        metavar="NAME",
        help="other ways to hide the map, to compare: names of l2p lift --scheme",
    )
    audit.add_argument(
        "--releases",
        type=int,
        default=1,
        metavar="R",
        help="also tell what R releases of the map, each with directions of its own, give away together",
    )
    audit.add_argument("--metric", action="store_true", help="the scene is in metres: tell lengths in centimetres")
    add_decision(audit)
    add_views(audit)
    audit.add_argument(
        "--max-view-points",
        type=int,
        default=MOST_POINTS,
        metavar="N",
        help="points of each cloud that the page draws; the figures count all (default: %(default)s)",
    )
    audit.add_argument("--open", action="store_true", help="show the page in the browser, where there is a display")
    add_device(audit)
    add_threads(audit)
    add_memory(audit)
    add_json(audit, "FILE", "the figures of audit.json")
    add_force(audit)


def _add_view(commands: Any) -> None:
    view = _command(commands, "view", "show a scene, a line cloud or a recovery on a page")
    view.add_argument("file", metavar="FILE", help="a scene, line cloud, recovery or truth, or a COLMAP model folder")
    view.add_argument(
        "-o",
        dest="output",
        metavar="PAGE.html",
        help="page to write (default: one in the folder of temporary files, shown in the browser)",
    )
    add_columns(view)
    view.add_argument("--open", action="store_true", help="show the page of -o in the browser, too")
    view.add_argument(
        "--pictures",
        action="store_true",
        help="serve the page to this machine until Ctrl-C: its button Stand here makes a picture of that place",
    )
    view.add_argument(
        "--lines", metavar="LINES.npz", help="with --pictures of a recovery: its line cloud, for the descriptors"
    )
    view.add_argument("--window", action="store_true", help="open a window instead (Open3D; needs a display)")
    add_force(view)


def _add_picture(commands: Any) -> None:
    picture = _command(commands, "picture", "draw what a camera would have seen, from points or recovered ones")
    add_picture(picture)
    add_ignore(picture, "of the points")
    add_json(picture, "FILE", "the figures")
    add_force(picture)


def _add_info(commands: Any) -> None:
    info = _command(commands, "info", "say what a file is: scene, line cloud, recovery, truth or checkpoint")
    info.add_argument("file", metavar="FILE", help="any file that l2p reads, or a COLMAP model folder")
    add_columns(info)


def _add_demo(commands: Any) -> None:
    demo = _command(commands, "demo", "simulate a room, lift it, recover it, and draw what an attacker sees")
    demo.add_argument("-o", dest="output", metavar="DIR", required=True, help="folder to write")
    demo.add_argument(
        "--points", type=int, default=20_000, metavar="N", help="points in the room (default: %(default)s)"
    )
    demo.add_argument("--seed", type=seed_of, default=3, metavar="S", help="seed of the room (default: %(default)s)")
    add_force(demo)
