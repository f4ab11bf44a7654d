"""Ray cloud: lines from the points to two common centres, a random one each (Moon et al., CVPR 2024)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.appearance import Appearance
from l2p.maps.truth import Hiding
from l2p.schemes.centers import lines_to_centers, moved_points, two_centers


class Rays:
    """Scheme with one line per point, through one of two centres that k-means finds; a coin decides which.

    The centres can be found again, since all lines meet in them. By design the map tells them, and so where most points
    are. If a point is far from all others, k-means may make it a cluster of its own: its centre is then the point.
    """

    name = "rays"
    answers = 1

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Draw a centre for each point; InputError if all points are the same."""
        moved = moved_points(points, chosen, rng)
        centers = two_centers(moved, rng)
        own = centers[rng.integers(2, size=len(chosen))]
        return lines_to_centers(points, chosen, moved, own, rng, appearance, self.name)
