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
        confidence = pairs.other(pairs.nodes.confidence)
        own = pairs.own(pairs.nodes.confidence).expand_as(confidence)
        return Values([confidence, own, pairs.other(pairs.nodes.crowd)])
