"""What an attack gives back: a point on every line, and how sure it is of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8


@dataclass(frozen=True, eq=False)
class Recovery:
    """Recovered points **in the order of the input lines**.

    Attributes
    ----------
    xyz : (lines, 3) float64
        Recovered points, in scene units, each on its line.
    confidence : (lines,) float32
        In [0, 1]; the greater, the likelier is the point to be right.
    beta : (lines,) float64
        Position along the line from its canonical foot, in scene units: ``xyz = origin + beta * direction``.
    rgb : (lines, 3) uint8 or None
        Colours carried over from the line cloud.
    neighbors : (lines, k) int64 or None
        The neighbours that the last round used, or for the learned method the candidates that it judged; -1 where a
        line has fewer.
    affinity : (lines, k) float32 or None
        Weight of each neighbour in the last round, in [0, 1]; for the learned method how likely the network takes it
        to be a true one.
    kept : (lines,) bool or None
        Points that passed ``--min-confidence`` and ``--clean``; a PLY and a COLMAP model hold these only.
    info : dict
        Method, settings, seed, seconds: plain values for a JSON file.
    calibrated : bool
        The confidence is the probability of lying within 1 spacing, and does not only rank.
    """

    xyz: Float[np.ndarray, "lines 3"]
    confidence: Float[np.ndarray, " lines"]
    beta: Float[np.ndarray, " lines"]
    rgb: UInt8[np.ndarray, "lines 3"] | None = None
    neighbors: Int[np.ndarray, "lines k"] | None = None
    affinity: Float[np.ndarray, "lines k"] | None = None
    kept: Bool[np.ndarray, " lines"] | None = None
    info: dict[str, Any] = field(default_factory=dict)
    calibrated: bool = False

    def __len__(self) -> int:
        return len(self.xyz)
