"""Intersections of the line with the surfaces around a candidate's estimate, and its angle to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from l2p.attacks.learned.candidates import Candidates
from l2p.attacks.learned.inputs.family import Kind, Values
from l2p.geometry.local_planes import Surface, crossing


@dataclass(frozen=True)
class _Cut:
    """A surface of the candidate.

    Attributes
    ----------
    grazing : float
        Least absolute cosine to the normal; lines at a shallower angle are clamped to it.
    farthest : float
        Largest distance of a vote from the foot, in local scales.
    """

    needs: ClassVar = ()
    grazing: float = 0.05
    farthest: float = 3.0

    def _of(self, pairs: Candidates, surface: Surface) -> Values:
        met = crossing(surface, pairs.direction, pairs.at_foot, pairs.at_closest, pairs.here, self.grazing)
        farthest = self.farthest * pairs.scale
        vote = pairs.foot + torch.maximum(torch.minimum(met.cut, farthest), -farthest)
        shape = [met.slope.abs(), surface.planarity, surface.linearity]
        return Values([pairs.foot + met.cut, *(off.abs() for off in met.off), *shape], [vote])


@dataclass(frozen=True)
class NearSurface(_Cut):
    """Surface of the nearest estimates."""

    columns: ClassVar = {
        "cut": Kind.POSITION,
        "foot_off_plane": Kind.LENGTH,
        "closest_off_plane": Kind.LENGTH,
        "own_off_plane": Kind.LENGTH,
        "incidence": Kind.NUMBER,
        "planarity": Kind.NUMBER,
        "linearity": Kind.NUMBER,
    }
    votes: ClassVar = ("cut",)

    def of(self, pairs: Candidates) -> Values:
        """Cut the line with it."""
        return self._of(pairs, pairs.nodes.surface.at(pairs.index))


@dataclass(frozen=True)
class WideSurface(_Cut):
    """Surface of many estimates."""

    columns: ClassVar = {f"wide_{name}": kind for name, kind in NearSurface.columns.items()}
    votes: ClassVar = ("wide_cut",)

    def of(self, pairs: Candidates) -> Values:
        """Cut the line with it."""
        return self._of(pairs, pairs.nodes.wide.at(pairs.index))
