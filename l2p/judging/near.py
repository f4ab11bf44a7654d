"""Points that have another cloud near them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def share_near(points: Float[np.ndarray, "points 3"], others: Float[np.ndarray, "others 3"], reach: float) -> float:
    """Share of the points whose nearest one of the others is at most ``reach`` (scene units) away; 0 without others."""
    from scipy.spatial import KDTree

    if len(others) == 0:
        return 0.0
    return float((KDTree(others).query(points)[0] <= reach).mean())
