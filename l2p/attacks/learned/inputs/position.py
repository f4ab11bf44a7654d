"""Positions on the line: the foot of a candidate's estimate, and the point closest to the candidate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.inputs.family import Kind, Values


@dataclass(frozen=True)
class Position:
    """Foot, closest point, and their distance; the closest point votes."""

    columns: ClassVar = {"foot": Kind.POSITION, "closest": Kind.POSITION, "foot_closest": Kind.LENGTH}
    votes: ClassVar = ("closest",)
    needs: ClassVar = ()

    def of(self, pairs: Candidates) -> Values:
        """Return columns and vote."""
        return Values([pairs.foot, pairs.closest, (pairs.closest - pairs.foot).abs()], [pairs.closest])
