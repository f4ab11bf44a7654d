"""Likeness of the published appearance of a pair: the log likelihood ratio that the two are neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.embedding import SOURCES
from l2p.attacks.learned.inputs.family import Kind, Values


@dataclass(frozen=True)
class Likeness:
    """Likeness, and what it was computed from (:mod:`l2p.attacks.learned.embedding`)."""

    columns: ClassVar = {"likeness": Kind.NUMBER, **{f"of_{name}": Kind.NUMBER for name in SOURCES}}
    votes: ClassVar = ()
    needs: ClassVar = ("appearance",)

    def of(self, pairs: Candidates) -> Values:
        """Return the columns."""
        likeness = pairs.likeness
        of = pairs.attributes["appearance"].of
        return Values([likeness, *(torch.full_like(likeness, name in of) for name in SOURCES)])
