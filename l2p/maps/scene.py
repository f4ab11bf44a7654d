"""A Structure-from-Motion scene: points and their attributes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from l2p.checks import point_rows
from l2p.errors import InputError
from l2p.maps.appearance import Appearance, WithAppearance
from l2p.maps.short_repr import short_repr


@dataclass(frozen=True, eq=False)
class Scene(WithAppearance):
    """The sparse points of an SfM model.

    Attributes
    ----------
    xyz : (points, 3) float64
        Points in scene units (metres only if the model is metric).
    rgb : (points, 3) uint8 or None
        Colours of the points.
    error : (points,) float32 or None
        Mean reprojection error in pixels.
    track_length : (points,) int32 or None
        Number of images that see the point.
    ids : (points,) int64 or None
        Identifiers of the source (COLMAP ``point3D_id``).
    camera_centers : (cameras, 3) float64 or None
        Centres of the cameras that see the points, scene units.
    descriptor : (points, length) uint8 or float32, or None
        Descriptor of each point: the mean over its track, or one observation.
    descriptor_kind : str or None
        What computed the descriptors (:class:`l2p.maps.appearance.Appearance`).
    up : (3,) float64 or None
        Unit vector of up in the scene, if it is known; pictures stand by it.

    Raises
    ------
    InputError
        If the points are no numbers of shape (points, 3), or colours, descriptors or others are not of these points.
    """

    xyz: Float[np.ndarray, "points 3"]
    rgb: UInt8[np.ndarray, "points 3"] | None = None
    error: Float[np.ndarray, " points"] | None = None
    track_length: Int[np.ndarray, " points"] | None = None
    ids: Int[np.ndarray, " points"] | None = None
    camera_centers: Float[np.ndarray, "cameras 3"] | None = None
    descriptor: np.ndarray | None = None
    descriptor_kind: str | None = None
    up: Float[np.ndarray, "3"] | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", point_rows("xyz", self.xyz))
        for name in ("error", "track_length", "ids"):
            value = getattr(self, name)
            if value is not None and np.shape(value) != (len(self.xyz),):
                raise InputError(
                    f"got {name} of shape {np.shape(value)}; expected one for each of {len(self.xyz)} points"
                )
        appearance = Appearance(self.rgb, self.descriptor, self.descriptor_kind)
        appearance.check_rows(len(self.xyz), "points")
        object.__setattr__(self, "descriptor", appearance.descriptor)
        object.__setattr__(self, "descriptor_kind", appearance.descriptor_kind)

    def rows(self, some: Bool[np.ndarray, " points"] | Int[np.ndarray, " some"]) -> Scene:
        """Select points by a mask or row numbers, with all that belongs to them; camera centres and up stay."""
        names = ("xyz", "rgb", "error", "track_length", "ids", "descriptor")
        own = {name: value[some] for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **own)

    def __len__(self) -> int:
        return len(self.xyz)
