"""Permuted coordinates: points swap one coordinate in pairs (Pan et al., ICCV 2023)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.permuted import PermutedCloud
from l2p.maps.truth import Hiding, Truth
from l2p.schemes.rounding import within_lattice


class Permuted:
    """Scheme with one stored point per point; each two points of a random pair swap a random coordinate.

    *Inferred*: no code is known. A point keeps two of its coordinates and its appearance. Of an odd number, the last
    point is left out, since without a partner it would be stored as it is. By design the map tells two coordinates of
    each point, not which two, and the third is among those of the others: the values of each axis are the true ones.

    Notes
    -----
    Points are moved within their lattice cells first. If the points of a map were rounded in different ways, a
    coordinate would else be told from those of its new point by its digits.
    """

    name = "permuted"
    answers = 1
    publishes = PermutedCloud

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Draw pairs, the axis that each swaps, and an order; InputError of fewer than two points."""
        if len(chosen) < 2:
            raise InputError(f"got {len(chosen)} point(s) for {self.name}; expected at least 2, as they swap in pairs")
        chosen = rng.permutation(chosen[: len(chosen) // 2 * 2])
        stored = within_lattice(points, chosen, rng).reshape(-1, 2, 3)
        pair, axis = np.arange(len(stored)), rng.integers(3, size=len(stored))
        stored[pair, :, axis] = stored[pair, ::-1, axis]
        order = rng.permutation(len(chosen))
        chosen, own = chosen[order], appearance.rows(chosen[order])
        stored = stored.reshape(-1, 3)[order]
        cloud = PermutedCloud(stored, own.rgb, self.name, own.descriptor, own.descriptor_kind)
        return Hiding(cloud, Truth(points[chosen], chosen))
