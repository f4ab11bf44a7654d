"""The plane cloud: each point is replaced by a plane through it (Geppert et al., CVPR 2022; 3DV 2025)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from l2p.checks import finite_rows, refuse
from l2p.errors import InputError
from l2p.maps.appearance import Appearance, WithAppearance
from l2p.maps.lines import UNIT_TOLERANCE
from l2p.maps.short_repr import short_repr


@dataclass(frozen=True, eq=False)
class PlaneCloud(WithAppearance):
    """N planes ``normal . x = offset``.

    Parameters
    ----------
    normal : (planes, 3) float64
        Unit vectors; (normal, offset) and (-normal, -offset) are the same plane.
    offset : (planes,) float64
        Signed distance of the plane from the origin, scene units.
    rgb : (planes, 3) uint8, optional
        Colour of the point in each plane.
    scheme : str
        Scheme that drew the normals, a name of :data:`l2p.schemes.scheme.SCHEMES`.
    descriptor : (planes, length) uint8 or float32, optional
        Descriptor of the point in each plane.
    descriptor_kind : str, optional
        What computed the descriptors (:class:`l2p.maps.appearance.Appearance`).

    Raises
    ------
    InputError
        If shapes differ, numbers are not finite or a normal is not a unit vector.

    Examples
    --------
    >>> import numpy as np
    >>> plane = PlaneCloud(np.array([[0.0, 0, 1]]), np.array([2.0]))
    >>> len(plane), plane.distance(np.array([[5.0, 5, 3]]))
    (1, array([1.]))
    """

    normal: Float[np.ndarray, "planes 3"]
    offset: Float[np.ndarray, " planes"]
    rgb: UInt8[np.ndarray, "planes 3"] | None = None
    scheme: str = "planes"
    descriptor: np.ndarray | None = None
    descriptor_kind: str | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        normal = finite_rows("normal", self.normal)
        offset = np.array(self.offset, dtype=np.float64)
        if offset.shape != (len(normal),):
            raise InputError(f"got {len(normal)} normals and offsets of shape {offset.shape}; expected one offset each")
        refuse(~np.isfinite(offset), "offset that is NaN or infinite", "remove the plane")
        length = np.linalg.norm(normal, axis=1)
        refuse(np.abs(length - 1) > UNIT_TOLERANCE, "normal of length other than 1", "normalise the normal")
        appearance = Appearance(self.rgb, self.descriptor, self.descriptor_kind)
        appearance.check_rows(len(normal), "planes")
        for name, value in (("normal", normal), ("offset", offset)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "descriptor", appearance.descriptor)
        object.__setattr__(self, "descriptor_kind", appearance.descriptor_kind)

    def distance(self, points: Float[np.ndarray, "planes 3"]) -> Float[np.ndarray, " planes"]:
        """Signed distance of point i from plane i, scene units."""
        return np.sum(self.normal * points, axis=1) - self.offset

    def without(self, names: Collection[str]) -> PlaneCloud:
        """Leave out published attributes, some of ``rgb`` and ``descriptor``."""
        return self._with(self.appearance.without(names))

    def rows(self, index: Int[np.ndarray, " some"] | Bool[np.ndarray, " planes"]) -> PlaneCloud:
        """Select planes by index, which may repeat, or by mask."""
        some = replace(
            self, normal=self.normal[index], offset=self.offset[index], rgb=None, descriptor=None, descriptor_kind=None
        )
        return some._with(self.appearance.rows(index))

    def _with(self, appearance: Appearance) -> PlaneCloud:
        return replace(
            self, rgb=appearance.rgb, descriptor=appearance.descriptor, descriptor_kind=appearance.descriptor_kind
        )

    def __len__(self) -> int:
        return len(self.normal)
