"""The angle between the lines of a pair: votes of nearly parallel lines are uncertain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.inputs.family import Kind, Values


@dataclass(frozen=True)
class Angle:
    """Absolute cosine of the angle, which does not depend on the signs of the directions."""

    columns: ClassVar = {"cosine": Kind.NUMBER}
    votes: ClassVar = ()
    needs: ClassVar = ()

    def of(self, pairs: Candidates) -> Values:
        """Return the column."""
        return Values([pairs.cosine.abs()])
