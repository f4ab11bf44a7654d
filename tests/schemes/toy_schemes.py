"""Schemes that l2p does not know: lines through pairs of points, and lines of which some hide nothing."""

from __future__ import annotations

import numpy as np

from l2p.maps.lines import LineCloud
from l2p.maps.truth import Hiding, Truth
from l2p.schemes.uniform import half_space


class Pairs:
    """A line through each two points; of an odd number, one is left out."""

    name, answers = "pairs", 2

    def hide(self, points, chosen, rng, appearance):
        pair = rng.permutation(chosen)[: len(chosen) // 2 * 2].reshape(-1, 2)
        lines = LineCloud.through(points[pair[:, 0]], points[pair[:, 1]] - points[pair[:, 0]], scheme=self.name)
        index = pair.ravel()
        return Hiding(lines, Truth(points[index], index, element=np.arange(len(pair)).repeat(2)))


class Fakes:
    """As many lines as points that hide nothing, among those that do."""

    name, answers = "fakes", 1

    def hide(self, points, chosen, rng, appearance):
        fake = rng.uniform(points.min(axis=0), points.max(axis=0), (len(chosen), 3))
        direction = half_space(rng.normal(size=(2 * len(chosen), 3)))
        order = np.lexsort(direction.T)
        lines = LineCloud.through(np.concatenate([points[chosen], fake])[order], direction[order], scheme=self.name)
        element = np.argsort(order)[: len(chosen)]
        return Hiding(lines, Truth(points[chosen], chosen, element=element))
