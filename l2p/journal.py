"""What is kept of the rounds of an attack that are done, so that a run that was ended goes on from there."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Kept(NamedTuple):
    """What is known of all lines after so many rounds, by name: the rounds after them need no more."""

    rounds: int
    parts: dict[str, np.ndarray]


class Journal:
    """Keeps nothing; :class:`l2p.io.state_files.StateFile` writes to a file."""

    def begin(self, about: dict[str, Any]) -> None:
        """Begin a run on these lines with this method and its settings, or refuse to go on from that of another."""

    def last(self) -> Kept | None:
        """What the run goes on from, if it was begun before."""
        return None

    def keep(self, kept: Kept) -> None:
        """Keep what is known after a round, in place of what was known before."""
