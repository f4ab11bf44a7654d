"""The permuted cloud: points that swapped coordinates with others (Pan et al., ICCV 2023)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from l2p.checks import finite_rows
from l2p.maps.appearance import Appearance, WithAppearance
from l2p.maps.short_repr import short_repr


@dataclass(frozen=True, eq=False)
class PermutedCloud(WithAppearance):
    """N points, in each of which one coordinate belongs to another point of the map.

    Parameters
    ----------
    xyz : (points, 3) float64
        Stored positions, scene units.
    rgb : (points, 3) uint8, optional
        Colour of each point.
    scheme : str
        A name of :data:`l2p.schemes.scheme.SCHEMES`.
    descriptor : (points, length) uint8 or float32, optional
        Descriptor of each point.
    descriptor_kind : str, optional
        What computed the descriptors (:class:`l2p.maps.appearance.Appearance`).

    Raises
    ------
    InputError
        If shapes differ or numbers are not finite.
    """

    xyz: Float[np.ndarray, "points 3"]
    rgb: UInt8[np.ndarray, "points 3"] | None = None
    scheme: str = "permuted"
    descriptor: np.ndarray | None = None
    descriptor_kind: str | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        xyz = finite_rows("xyz", self.xyz)
        appearance = Appearance(self.rgb, self.descriptor, self.descriptor_kind)
        appearance.check_rows(len(xyz), "points")
        xyz.setflags(write=False)
        for name, value in (
            ("xyz", xyz),
            ("descriptor", appearance.descriptor),
            ("descriptor_kind", appearance.descriptor_kind),
        ):
            object.__setattr__(self, name, value)

    def without(self, names: Collection[str]) -> PermutedCloud:
        """Leave out published attributes, some of ``rgb`` and ``descriptor``."""
        return self._with(self.appearance.without(names))

    def rows(self, index: Int[np.ndarray, " some"] | Bool[np.ndarray, " points"]) -> PermutedCloud:
        """Select points by index, which may repeat, or by mask."""
        some = replace(self, xyz=self.xyz[index], rgb=None, descriptor=None, descriptor_kind=None)
        return some._with(self.appearance.rows(index))

    def _with(self, appearance: Appearance) -> PermutedCloud:
        return replace(
            self, rgb=appearance.rgb, descriptor=appearance.descriptor, descriptor_kind=appearance.descriptor_kind
        )

    def __len__(self) -> int:
        return len(self.xyz)
