"""Where on the line a candidate's estimate has its foot, and where the two lines are closest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.inputs.family import Kind, Values


@dataclass(frozen=True)
class Position:
    """Foot and closest point, and how far they are apart; the closest point votes."""

    columns: ClassVar = {"foot": Kind.POSITION, "closest": Kind.POSITION, "foot_closest": Kind.LENGTH}
    votes: ClassVar = ("closest",)
    needs: ClassVar = ()

    def of(self, pairs: Candidates) -> Values:
        """Read them off the pairs."""
        return Values([pairs.foot, pairs.closest, (pairs.closest - pairs.foot).abs()], [pairs.closest])
