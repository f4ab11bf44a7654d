"""Lines of uniformly random direction, one through each point (Speciale et al., CVPR 2019)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.appearance import Appearance
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
        appearance: Appearance,
    ) -> Hiding:
        """Draw a direction for each point, and sort the lines by it."""
        direction = half_space(rng.normal(size=(len(chosen), 3)))
        order = np.lexsort(direction.T)
        chosen, direction = chosen[order], direction[order]
        hidden = within_lattice(points, chosen, rng)
        lines = LineCloud.through(hidden, direction, appearance.rows(chosen), self.name)
        return Hiding(lines, Truth(points[chosen], chosen))


def half_space(direction: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "lines 3"]:
    """Turn unit vectors into the half-space z > 0: (d, m) and (-d, -m) are the same line, and one of them is stored."""
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return np.where(direction[:, 2:] < 0, -direction, direction)
