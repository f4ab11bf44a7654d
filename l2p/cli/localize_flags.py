"""Flags of localization: those of ``l2p localize``, and those of ``l2p audit`` that choose a release."""

from __future__ import annotations

import argparse

from l2p.schemes.scheme import DEFAULT_SCHEME, SCHEMES
from l2p.utility import BY_TRACKS, FRACTIONS, MATCHING, MOST_QUERIES, POINTS, WRONG


def add_localization(localize: argparse.ArgumentParser) -> None:
    """Add the flags of ``l2p localize`` that are its own."""
    localize.add_argument("scene", metavar="MODEL", help="COLMAP model folder with images and observations")
    localize.add_argument(
        "--scheme",
        dest="schemes",
        nargs="+",
        choices=(POINTS, *SCHEMES),
        default=(POINTS, DEFAULT_SCHEME),
        metavar="NAME",
        help=f"ways to publish: {POINTS}, as they are, or hidden by a scheme of l2p lift (default: {POINTS} and "
        f"{DEFAULT_SCHEME}); the points are the same for all",
    )
    localize.add_argument(
        "--fractions",
        type=float,
        nargs="+",
        default=FRACTIONS,
        metavar="F",
        help="fractions of the points to publish, in (0, 1] "
        f"(default: {' '.join(f'{share:g}' for share in FRACTIONS)})",
    )
    localize.add_argument(
        "--matches",
        choices=MATCHING,
        default=BY_TRACKS,
        help="by the tracks of the model, with a share of wrong ones, or by descriptors (default: %(default)s)",
    )
    localize.add_argument(
        "--wrong",
        type=float,
        nargs="+",
        default=(WRONG,),
        metavar="W",
        help=f"shares of wrong matches among those by tracks, in [0, 1) (default: {WRONG:g})",
    )
    localize.add_argument(
        "--features",
        metavar="FILE",
        help="features of the images, for matches by descriptors: COLMAP's database.db or hloc's (default: those found "
        "beside the model)",
    )
    localize.add_argument(
        "--gravity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="direction of gravity in the map, if the cameras know it: fewer matches then make a pose",
    )
    localize.add_argument("--queries", type=int, metavar="N", help="most images to localize (default: all)")
    localize.add_argument(
        "--metric", action="store_true", help="the map is in metres: count within 0.25 m and 2 deg ..."
    )


def add_decision(audit: argparse.ArgumentParser) -> None:
    """Add the flags of ``l2p audit`` that localize and choose a release."""
    audit.add_argument(
        "--queries",
        type=int,
        default=MOST_QUERIES,
        metavar="N",
        help="most images of a COLMAP model to localize in each release; 0 leaves it out (default: %(default)s)",
    )
    audit.add_argument(
        "--matches",
        choices=MATCHING,
        default=BY_TRACKS,
        help="match them by the tracks of the model, with a share of wrong ones, or by the descriptors of their "
        "features: --descriptors database.db, or hloc's (default: %(default)s)",
    )
    audit.add_argument(
        "--wrong",
        type=float,
        default=WRONG,
        metavar="W",
        help="share of wrong matches in that, in [0, 1) (default: %(default)s)",
    )
    audit.add_argument(
        "--localize",
        metavar="LIMIT=SHARE",
        help="name the release that gives away least of those that localize this share of the images, such as "
        "0.25m,2deg=90%% (with --metric) or 0.5%%=90%%, of the extent of the cameras",
    )
    audit.add_argument(
        "--recovered",
        metavar="SHARE",
        help="name the release that localizes best of those of which at most this share of the map comes back",
    )
