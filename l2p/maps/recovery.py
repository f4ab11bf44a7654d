"""The result of an attack: points behind the lines, each with a confidence."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from l2p.checks import element_rows, point_rows
from l2p.errors import InputError
from l2p.maps.short_repr import short_repr


@dataclass(frozen=True, eq=False)
class Recovery:
    """Recovered points: one row per line **in the order of the lines**, unless ``element`` is given.

    Attributes
    ----------
    xyz : (rows, 3) float64
        Recovered points, in scene units, each on its line.
    confidence : (rows,) float32
        In [0, 1]; the greater, the more likely is the point correct.
    beta : (rows,) float64
        Position along the line from its canonical foot, in scene units: ``xyz = origin + beta * direction``.
    rgb : (rows, 3) uint8 or None
        Colours carried over from the line cloud.
    neighbors : (rows, k) int64 or None
        Neighbours used in the last round, or candidates judged in it by the learned method; -1 where a line has fewer.
    affinity : (rows, k) float32 or None
        Weight of each neighbour in the last round, in [0, 1]; for the learned method, the predicted probability that it
        is a true neighbour.
    kept : (rows,) bool or None
        Points that passed the filters, by confidence or outlier removal; only these are written to PLY and COLMAP.
    info : dict
        Method, settings, seed, seconds: plain values for a JSON file.
    calibrated : bool
        True: the confidence is the probability of lying within 1 spacing; False: it only ranks.
    element : (rows,) int64
        Line of each row; default: the row's own index. Two rows of one element are two points on one line, and an
        element may have no row.

    Raises
    ------
    InputError
        If the points are no numbers of shape (rows, 3), an element is negative, or there is not one of each for each
        row.

    Examples
    --------
    >>> import numpy as np, l2p
    >>> lines = l2p.lift(np.random.default_rng(1).normal(size=(5, 3)), seed=0)
    >>> beta = np.zeros(5)
    >>> feet = l2p.Recovery(lines.at(beta), np.full(5, 0.5, dtype=np.float32), beta)
    >>> len(feet), feet.calibrated, feet.element.tolist()
    (5, False, [0, 1, 2, 3, 4])
    """

    xyz: Float[np.ndarray, "rows 3"]
    confidence: Float[np.ndarray, " rows"]
    beta: Float[np.ndarray, " rows"]
    rgb: UInt8[np.ndarray, "rows 3"] | None = None
    neighbors: Int[np.ndarray, "rows k"] | None = None
    affinity: Float[np.ndarray, "rows k"] | None = None
    kept: Bool[np.ndarray, " rows"] | None = None
    info: dict[str, Any] = field(default_factory=dict)
    calibrated: bool = False
    element: Int[np.ndarray, " rows"] = None  # type: ignore[assignment]

    __repr__ = short_repr

    def __post_init__(self) -> None:
        object.__setattr__(self, "xyz", point_rows("xyz", self.xyz))
        for name in ("confidence", "beta"):
            if (shape := np.shape(getattr(self, name))) != (len(self.xyz),):
                raise InputError(f"got {name} of shape {shape}; expected one for each of {len(self.xyz)} points")
        object.__setattr__(self, "element", element_rows(self.element, len(self.xyz)))

    @property
    def one_each(self) -> bool:
        """Return whether row i belongs to line i, for all rows."""
        return np.array_equal(self.element, np.arange(len(self)))

    def rows(self, some: Bool[np.ndarray, " rows"] | Int[np.ndarray, " some"]) -> Recovery:
        """Select points by a mask or row numbers, without their neighbours."""
        columns = {
            name: None if (value := getattr(self, name)) is None else value[some]
            for name in ("xyz", "confidence", "beta", "rgb", "kept", "element")
        }
        return replace(self, **columns, neighbors=None, affinity=None)

    def __len__(self) -> int:
        return len(self.xyz)
