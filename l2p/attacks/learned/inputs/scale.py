"""The local scale of a candidate, relative to that of the scene and of the line's own estimate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.inputs.family import Kind, Values


@dataclass(frozen=True)
class Scale:
    """Two ratios of local scales."""

    columns: ClassVar = {"log_scale": Kind.RATIO, "log_scale_ratio": Kind.RATIO}
    votes: ClassVar = ()
    needs: ClassVar = ()

    def of(self, pairs: Candidates) -> Values:
        """Divide by the typical scale and by the line's own."""
        return Values([pairs.scale / pairs.nodes.typical, pairs.scale / pairs.own(pairs.nodes.scale)])
