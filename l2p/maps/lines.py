"""The line cloud: unit directions and Plücker moments in float64; nothing depends on the points' positions."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from l2p.checks import finite_rows, refuse
from l2p.errors import InputError
from l2p.maps.appearance import NO_APPEARANCE, Appearance, WithAppearance
from l2p.maps.short_repr import short_repr

#: Largest |d| - 1 and |d . m| / |m| that count as rounding: files may be written in single precision.
UNIT_TOLERANCE = 1e-4
#: Largest |d| - 1 and |d . m| / |m| of normalised lines, from rounding in double precision. Lines below it are not
#: normalised again, so that a line cloud read back from its file is equal to the bit.
_ROUNDING = 8 * np.finfo(np.float64).eps


@dataclass(frozen=True, eq=False)
class LineCloud(WithAppearance):
    """N lines in Plücker coordinates.

    Parameters
    ----------
    direction : (lines, 3) float64
        Unit vectors; the sign has no meaning.
    moment : (lines, 3) float64
        p x d for any point p on the line, in scene units.
    rgb : (lines, 3) uint8, optional
        Colour of the point behind each line.
    scheme : str
        Scheme that drew the directions; ``uniform`` is the line cloud of Speciale et al. (CVPR 2019).
    descriptor : (lines, length) uint8 or float32, optional
        Descriptor of the point behind each line.
    descriptor_kind : str, optional
        What computed the descriptors (:class:`l2p.maps.appearance.Appearance`).
    second : Appearance, optional
        Appearance of the second point behind each line, where lines pass through pairs of points; which of the two
        points is the first is not told. It has the same attributes as the first.

    Raises
    ------
    InputError
        If shapes differ, numbers are not finite or beyond 1e30, a direction is not a unit vector or a moment is not
        perpendicular to it.

    Examples
    --------
    >>> import numpy as np, l2p
    >>> lines = l2p.LineCloud.through(np.array([[0.0, 0, 2]]), direction=np.array([[1.0, 0, 0]]))
    >>> lines.moment, lines.at(np.array([3.0]))
    (array([[0., 2., 0.]]), array([[3., 0., 2.]]))
    """

    direction: Float[np.ndarray, "lines 3"]
    moment: Float[np.ndarray, "lines 3"]
    rgb: UInt8[np.ndarray, "lines 3"] | None = None
    scheme: str = "uniform"
    descriptor: np.ndarray | None = None
    descriptor_kind: str | None = None
    second: Appearance | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        direction = finite_rows("direction", self.direction)
        moment = finite_rows("moment", self.moment)
        if len(moment) != len(direction):
            raise InputError(
                f"got {len(direction)} directions and {len(moment)} moments; expected one moment for each line"
            )
        appearance = Appearance(self.rgb, self.descriptor, self.descriptor_kind)
        appearance.check_rows(len(direction), "lines")
        if self.second is not None:
            self.second.check_rows(len(direction), "lines")
            if self.second.names != appearance.names:
                raise InputError(
                    f"got {', '.join(self.second.names) or 'nothing'} of the second points and "
                    f"{', '.join(appearance.names) or 'nothing'} of the first; expected the same of both"
                )
        length = np.linalg.norm(direction, axis=1, keepdims=True)
        refuse(np.abs(length[:, 0] - 1) > UNIT_TOLERANCE, "direction of length other than 1", "normalise the direction")
        direction = np.where(np.abs(length - 1) > _ROUNDING, direction / length, direction)
        along = np.sum(direction * moment, axis=1)
        size = np.linalg.norm(moment, axis=1)
        refuse(
            np.abs(along) > UNIT_TOLERANCE * size + np.finfo(float).tiny,
            "moment that is not perpendicular to its direction",
            "store p x d for a point p on the line",
        )
        moment = moment - np.where(np.abs(along) > _ROUNDING * size, along, 0.0)[:, None] * direction
        for name, value in (("direction", direction), ("moment", moment)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "descriptor", appearance.descriptor)
        object.__setattr__(self, "descriptor_kind", appearance.descriptor_kind)

    @classmethod
    def through(
        cls,
        point: Float[np.ndarray, "lines 3"],
        direction: Float[np.ndarray, "lines 3"],
        appearance: Appearance = NO_APPEARANCE,
        scheme: str = "uniform",
        second: Appearance | None = None,
    ) -> LineCloud:
        """Make lines through ``point`` along ``direction`` (any length but zero); the position on it is not stored."""
        point, direction = finite_rows("point", point), finite_rows("direction", direction)
        if len(point) != len(direction):
            raise InputError(f"got {len(point)} points and {len(direction)} directions; expected one direction a point")
        length = np.linalg.norm(direction, axis=1, keepdims=True)
        refuse(length[:, 0] == 0, "direction of length 0", "remove the line")
        direction = direction / length
        # The moment is computed at the foot of the perpendicular from the origin, so that its rounding also depends on
        # the line and hardly on the point.
        foot = point - np.sum(point * direction, axis=1, keepdims=True) * direction
        moment = np.cross(foot, direction)
        kind = appearance.descriptor_kind
        return cls(direction, moment, appearance.rgb, scheme, appearance.descriptor, kind, second)

    def without(self, names: Collection[str]) -> LineCloud:
        """Leave out published attributes, some of ``rgb`` and ``descriptor``."""
        second = None if self.second is None else self.second.without(names)
        return self._with(self.direction, self.moment, self.appearance.without(names), second)

    @property
    def origin(self) -> Float[np.ndarray, "lines 3"]:
        """Canonical foot d x m: the point of each line nearest to the frame's origin."""
        return np.cross(self.direction, self.moment)

    def at(self, beta: Float[np.ndarray, " lines"]) -> Float[np.ndarray, "lines 3"]:
        """Points origin + beta * direction, (lines, 3) in scene units."""
        return self.origin + np.asarray(beta, dtype=np.float64)[:, None] * self.direction

    def rows(self, index: Int[np.ndarray, " some"]) -> LineCloud:
        """Select lines by index, which may repeat."""
        second = None if self.second is None else self.second.rows(index)
        return self._with(self.direction[index], self.moment[index], self.appearance.rows(index), second)

    def _with(
        self, direction: np.ndarray, moment: np.ndarray, appearance: Appearance, second: Appearance | None
    ) -> LineCloud:
        kind = appearance.descriptor_kind
        return LineCloud(direction, moment, appearance.rgb, self.scheme, appearance.descriptor, kind, second)

    def __len__(self) -> int:
        return len(self.direction)
