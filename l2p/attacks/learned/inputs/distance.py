"""Distances between the lines and the estimates of a pair."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.inputs.family import Kind, Values


@dataclass(frozen=True)
class Distance:
    """Distances line-line, estimate-line, line-estimate and estimate-estimate.

    Attributes
    ----------
    least : float
        Constant added to a distance before its logarithm, which is then finite; in typical scales.
    """

    columns: ClassVar = {
        "line_line": Kind.LENGTH,
        "point_line": Kind.LENGTH,
        "line_point": Kind.LENGTH,
        "point_point": Kind.LENGTH,
        "log_line_line": Kind.RATIO,
        "log_point_line": Kind.RATIO,
    }
    votes: ClassVar = ()
    needs: ClassVar = ()
    least: float = 1e-3

    def of(self, pairs: Candidates) -> Values:
        """Return the columns."""
        typical = pairs.nodes.typical
        between = (pairs.here - pairs.point).norm(dim=-1)
        logs = [length / typical + self.least for length in (pairs.line_line, pairs.point_line)]
        return Values([pairs.line_line, pairs.point_line, pairs.line_point, between, *logs])
