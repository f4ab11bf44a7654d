"""The angle between the lines of a pair: votes of nearly parallel lines are uncertain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.inputs.family import Kind, Values


@dataclass(frozen=True)
class Angle:
    """The cosine, whichever way the lines run."""

    columns: ClassVar = {"cosine": Kind.NUMBER}
    votes: ClassVar = ()
    needs: ClassVar = ()

    def of(self, pairs: Candidates) -> Values:
        """Read it off the pairs."""
        return Values([pairs.cosine.abs()])
