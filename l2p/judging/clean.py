"""Statistical outlier removal on recovered points, with Open3D."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from l2p.io.open3d import load_open3d
from l2p.judging import CLEANING


def inliers(xyz: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """Mask of the points that pass twice: their mean distance to their neighbours is not unusually large.

    Notes
    -----
    Fewer than three points are all kept: they have no usual distance.
    """
    open3d = load_open3d()
    kept = np.arange(len(xyz))
    for neighbors, deviations in CLEANING:
        if len(kept) < 3:
            break
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz[kept]))
        kept = kept[np.asarray(cloud.remove_statistical_outlier(neighbors, deviations)[1], dtype=np.int64)]
    mask = np.zeros(len(xyz), dtype=np.bool_)
    mask[kept] = True
    return mask
