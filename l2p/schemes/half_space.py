"""Two centres, each for the points on its own side of a plane (three-dimensional form of DCL, CVPR 2026)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.appearance import Appearance
from l2p.maps.truth import Hiding
from l2p.schemes.centers import lines_to_centers, moved_points, two_centers


class HalfSpace:
    """Scheme with one line per point, through the centre of the point's side of a plane.

    Notes
    -----
    *Inferred*: only a form for images is known, in which the left and the right half have an anchor each, both on the
    line between the halves. Here the centres are those of two clusters of the points (k-means, as in the ray cloud),
    and the plane is the one halfway between them, so that every point has the nearer centre. By design the map tells
    the centres and so the plane: whoever knows the scheme cuts each line at it, and then lines of different centres
    meet only at the border.
    """

    name = "half-space"
    answers = 1

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Find the side of each point; InputError if all points are the same."""
        moved = moved_points(points, chosen, rng)
        first, second = two_centers(moved, rng)
        beyond = (moved - (first + second) / 2) @ (second - first) > 0
        own = np.where(beyond[:, None], second, first)
        return lines_to_centers(points, chosen, moved, own, rng, appearance, self.name)
