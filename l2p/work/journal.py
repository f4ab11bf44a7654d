"""State saved after each finished round, so that an interrupted run can continue."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Saved(NamedTuple):
    """Tensors of all lines after ``rounds`` rounds, by name; sufficient to continue."""

    rounds: int
    state: dict[str, np.ndarray]


class Journal:
    """A journal that saves nothing; :class:`l2p.io.state_files.StateFile` writes to a file."""

    def begin(self, about: dict[str, Any]) -> None:
        """Begin a run with these lines, attack and settings; refuse to continue another."""

    def last(self) -> Saved | None:
        """Return the last saved round of a run that is continued."""
        return None

    def save(self, saved: Saved) -> None:
        """Replace the saved round."""
