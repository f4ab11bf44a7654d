"""The names of the attacks, apart from their code, so that ``l2p --help`` knows them without loading torch."""

from __future__ import annotations

#: Every method that ``l2p.recover`` knows.
METHODS = ("tomography", "heuristic")

DEFAULT_METHOD = "tomography"

#: What the heuristic's table of neighbours distinguishes.
SCENE_KINDS = ("indoor", "outdoor")
