"""The names of the attacks, apart from their code, so that ``l2p --help`` knows them without loading torch."""

from __future__ import annotations

#: Every method that ``l2p.recover`` knows.
METHODS = ("learned", "tomography", "heuristic")

DEFAULT_METHOD = "learned"

#: Settings that not every method has, and the methods that have them.
SETTINGS = {
    "checkpoint": ("learned",),
    "density": ("learned", "heuristic"),
    "scene_kind": ("heuristic",),
}

#: Kinds of scene in the heuristic's table of neighbours; the first is the default.
SCENE_KINDS = ("indoor", "outdoor")
#: Share of the map's points that lines hold, unless it is given.
DENSITY = 1.0
