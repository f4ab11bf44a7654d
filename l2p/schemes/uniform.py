"""Lines of uniformly random direction, one through each point (Speciale et al., CVPR 2019)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8

from l2p.maps.lines import LineCloud
from l2p.maps.truth import Hiding, Truth
from l2p.schemes.rounding import within_lattice


class Uniform:
    """Scheme with one line per point; directions are independent and uniform on the sphere."""

    name = "uniform"
    answers = 1

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        rgb: UInt8[np.ndarray, "points 3"] | None,
    ) -> Hiding:
        """Draw a direction for each point, and sort the lines by it."""
        direction = half_space(rng.normal(size=(len(chosen), 3)))
        order = np.lexsort(direction.T)
        chosen, direction = chosen[order], direction[order]
        hidden = within_lattice(points, chosen, rng)
        lines = LineCloud.through(hidden, direction, None if rgb is None else rgb[chosen], self.name)
        return Hiding(lines, Truth(points[chosen], chosen))


def half_space(direction: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "lines 3"]:
    """Turn unit vectors into the half-space z > 0: (d, m) and (-d, -m) are the same line, and one of them is stored."""
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return np.where(direction[:, 2:] < 0, -direction, direction)
