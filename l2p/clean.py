"""Statistical outlier removal on recovered points, with Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from l2p.errors import InputError

#: Neighbours and standard deviations of the two passes (Chelani et al., CVPR 2021, reference code).
PASSES = ((50, 2.0), (25, 2.0))

#: What Open3D needs from the system.
DEBIAN_PACKAGES = "libusb-1.0-0 libgl1 libegl1 libx11-6"


def inliers(xyz: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
    """The points that survive both passes: those not much farther from their neighbours than is usual.

    Notes
    -----
    Fewer than three points have no usual distance: all are kept.
    """
    open3d = load_open3d()
    kept = np.arange(len(xyz))
    for neighbors, deviations in PASSES:
        if len(kept) < 3:
            break
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz[kept]))
        kept = kept[np.asarray(cloud.remove_statistical_outlier(neighbors, deviations)[1], dtype=np.int64)]
    mask = np.zeros(len(xyz), dtype=np.bool_)
    mask[kept] = True
    return mask


def load_open3d(flag: str = "--clean") -> Any:
    """The module open3d, or a sentence on how to get it to load; ``flag`` is what asks for it."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"Open3D does not load ({reason}); install it with pip install open3d and apt install {DEBIAN_PACKAGES}, "
            f"or leave out {flag}"
        ) from error
    return open3d
