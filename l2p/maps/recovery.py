"""What an attack gives back: points behind the lines, and how sure it is of each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from l2p.checks import element_rows


@dataclass(frozen=True, eq=False)
class Recovery:
    """Recovered points, a row for each line **in the order of the lines**, unless ``element`` says otherwise.

    Attributes
    ----------
    xyz : (rows, 3) float64
        Recovered points, in scene units, each on its line.
    confidence : (rows,) float32
        In [0, 1]; the greater, the likelier is the point to be right.
    beta : (rows,) float64
        Position along the line from its canonical foot, in scene units: ``xyz = origin + beta * direction``.
    rgb : (rows, 3) uint8 or None
        Colours carried over from the line cloud.
    neighbors : (rows, k) int64 or None
        The neighbours that the last round used, or for the learned method the candidates that it judged; -1 where a
        line has fewer.
    affinity : (rows, k) float32 or None
        Weight of each neighbour in the last round, in [0, 1]; for the learned method how likely the network takes it
        to be a true one.
    kept : (rows,) bool or None
        Points that passed ``--min-confidence`` and ``--clean``; a PLY and a COLMAP model hold these only.
    info : dict
        Method, settings, seed, seconds: plain values for a JSON file.
    calibrated : bool
        The confidence is the probability of lying within 1 spacing, and does not only rank.
    element : (rows,) int64
        The line of each row; the row itself when left out. Two rows of one element are two points on one line, and an
        element may have none.

    Raises
    ------
    InputError
        If an element is negative, or there are more or fewer than rows.

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

    def __post_init__(self) -> None:
        object.__setattr__(self, "element", element_rows(self.element, len(self.xyz)))

    @property
    def one_each(self) -> bool:
        """Whether row i is of line i, for all of them."""
        return np.array_equal(self.element, np.arange(len(self)))

    def rows(self, some: Bool[np.ndarray, " rows"] | Int[np.ndarray, " some"]) -> Recovery:
        """The points that a mask or row numbers choose, without their neighbours."""
        columns = {
            name: None if (value := getattr(self, name)) is None else value[some]
            for name in ("xyz", "confidence", "beta", "rgb", "kept", "element")
        }
        return replace(self, **columns, neighbors=None, affinity=None)

    def __len__(self) -> int:
        return len(self.xyz)
