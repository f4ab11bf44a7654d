"""Confidence of the round before, in the estimates of a pair and in those around the candidate's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.inputs.family import Kind, Values


@dataclass(frozen=True)
class Confidence:
    """Confidence of the candidate, of the line itself, and the mean around the candidate."""

    columns: ClassVar = {"confidence": Kind.NUMBER, "own_confidence": Kind.NUMBER, "crowd": Kind.NUMBER}
    votes: ClassVar = ()
    needs: ClassVar = ()

    def of(self, pairs: Candidates) -> Values:
        """Return the columns."""
        return Values([pairs.confidence, pairs.own_confidence.expand_as(pairs.confidence), pairs.crowd])
