"""Planes of uniformly random normal, one through each point (the general form of "3DV 2025", arXiv 2409.11536)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.appearance import Appearance
from l2p.maps.planes import PlaneCloud
from l2p.maps.truth import Hiding, Truth
from l2p.schemes.rounding import within_lattice
from l2p.schemes.uniform import half_space


class RandomPlanes:
    """Scheme with one plane per point; normals are independent and uniform on the sphere.

    By design the map tells, of each point, its distance from the origin of the map along the normal.
    """

    name = "planes-random"
    answers = 1
    publishes = PlaneCloud

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Draw a normal for each point, and sort the planes by it."""
        normal = half_space(rng.normal(size=(len(chosen), 3)))
        order = np.lexsort(normal.T)
        chosen, normal = chosen[order], normal[order]
        offset = np.sum(normal * within_lattice(points, chosen, rng), axis=1)
        own = appearance.rows(chosen)
        planes = PlaneCloud(normal, offset, own.rgb, self.name, own.descriptor, own.descriptor_kind)
        return Hiding(planes, Truth(points[chosen], chosen))
