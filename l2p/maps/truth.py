"""The points behind a line cloud, stored apart from it to judge an attack."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.checks import element_rows, point_rows
from l2p.errors import InputError
from l2p.maps.lines import LineCloud
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud
from l2p.maps.short_repr import short_repr

#: What schemes publish.
MAPS = (LineCloud, PlaneCloud, PermutedCloud)


@dataclass(frozen=True, eq=False)
class Truth:
    """The points behind the elements (lines) of a map, stored apart from it to judge an attack.

    Attributes
    ----------
    xyz : (points, 3) float64
        Hidden points, scene units.
    index : (points,) int64
        Row of each point in the scene that was hidden.
    spacing : float or None
        Median distance to the 50th neighbour in the whole scene, also if only a fraction was hidden; scene units.
        None: not measured.
    ids : (points,) int64 or None
        Identifiers of the source (COLMAP ``point3D_id``).
    seed : int or None
        Seed of the hiding, if one was given.
    element : (points,) int64
        Line that hides each point; default: the row's own index. Two rows of one element are a pair; an element
        without a row is a fake.

    Raises
    ------
    InputError
        If the points are no numbers of shape (points, 3), an element is negative, or their number is another one.
    """

    xyz: Float[np.ndarray, "points 3"]
    index: Int[np.ndarray, " points"]
    spacing: float | None = None
    ids: Int[np.ndarray, " points"] | None = None
    seed: int | None = None
    element: Int[np.ndarray, " points"] = None  # type: ignore[assignment]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", point_rows("xyz", self.xyz))
        object.__setattr__(self, "element", element_rows(self.element, len(self.xyz)))

    @property
    def one_each(self) -> bool:
        """Return whether point i is behind line i, for all points."""
        return np.array_equal(self.element, np.arange(len(self)))

    def rows(self, some: Bool[np.ndarray, " points"] | Int[np.ndarray, " some"]) -> Truth:
        """Select points by a mask or row numbers."""
        ids = None if self.ids is None else self.ids[some]
        return replace(self, xyz=self.xyz[some], index=self.index[some], ids=ids, element=self.element[some])

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class Hiding:
    """A hidden scene: the published map and the secret truth.

    Attributes
    ----------
    map : LineCloud, PlaneCloud or PermutedCloud
    truth : Truth

    Raises
    ------
    InputError
        If the map is of another type, or a point is behind an element that is not in it.
    """

    map: Any
    truth: Truth

    def __post_init__(self) -> None:
        if not isinstance(self.map, MAPS):
            names = ", ".join(kind.__name__ for kind in MAPS)
            raise InputError(f"got a map of type {type(self.map).__name__}; expected one of {names}")
        last = self.truth.element.max(initial=-1)
        if last >= len(self.map):
            raise InputError(f"got a point behind element {last} of {len(self.map)}; expected elements of the map")
