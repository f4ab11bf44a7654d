"""Hidden maps that users have in hand: an object of l2p, or the path of a file. Nothing here reads points."""

from __future__ import annotations

import os
from os import PathLike

from l2p.checks import named
from l2p.errors import InputError
from l2p.io.hidden_files import load_hidden
from l2p.maps.lines import LineCloud
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud

#: What can be given where a hidden map is expected.
GivenMap = LineCloud | PlaneCloud | PermutedCloud | str | PathLike[str]

#: What to do with things that are no hidden map, by the name of their type: attacks must not load those of the truth.
_INSTEAD = {
    "Scene": "hide it first: l2p.lift(scene)",
    "Hiding": "give its map, hiding.map",
    "Truth": "which is what attacks must not see; give the map that hides it",
    "Recovery": "which is the result of an attack; give the map that was attacked",
}


def given_map(thing: GivenMap) -> LineCloud | PlaneCloud | PermutedCloud:
    """Return a hidden map as it is, or read it from its path.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InputError
        If it is anything else, or the file holds no hidden map.
    """
    if isinstance(thing, LineCloud | PlaneCloud | PermutedCloud):
        return thing
    if isinstance(thing, str | os.PathLike):
        return load_hidden(thing)
    raise InputError(f"got {named(thing)}; expected a LineCloud, or the path of its file: {_instead(thing)}")


def _instead(thing: object) -> str:
    if (kind := type(thing).__name__) in _INSTEAD:
        return _INSTEAD[kind]
    if isinstance(thing, list | tuple) and all(isinstance(each, LineCloud | str | os.PathLike) for each in thing):
        return "several releases of one map go to l2p.recover_releases"
    if hasattr(thing, "shape") or isinstance(thing, list | tuple):
        return (
            "points are hidden first, l2p.lift(points); lines are LineCloud.through(points, directions) or "
            "LineCloud(directions, moments)"
        )
    return "l2p.load reads one"
