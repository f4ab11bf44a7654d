"""Appearance: what a map publishes beside each line, the colour and the descriptor of its point."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from l2p.errors import InputError
from l2p.maps import ATTRIBUTES as ATTRIBUTES
from l2p.maps.short_repr import short_repr

#: Kind of a descriptor whose source does not say it.
UNKNOWN_KIND = "unknown"
#: Kinds whose bytes are bits, compared by the Hamming distance.
BINARY_KINDS = frozenset(("akaze", "brief", "brisk", "freak", "latch", "orb"))
#: Least share of bytes with their highest bit set in bits without a name: it is 1/2 for bits, and about 0 for SIFT.
_HIGH_BITS = 0.25
#: Kinds that l2p names itself; any other name is allowed.
SIFT = "sift"


@dataclass(frozen=True, eq=False)
class Appearance:
    """Colours and descriptors of some points, each optional.

    Attributes
    ----------
    rgb : (rows, 3) uint8 or None
        Colours.
    descriptor : (rows, length) uint8 or float32, or None
        Descriptors: of one observation each, or means over tracks.
    descriptor_kind : str or None
        What computed the descriptors, in lower case: ``sift`` for COLMAP's; ``unknown`` by default. None without
        descriptors.

    Raises
    ------
    InputError
        If a shape or a type does not fit, a descriptor has a number that is not finite, or a kind is given without
        descriptors.
    """

    rgb: UInt8[np.ndarray, "rows 3"] | None = None
    descriptor: Float[np.ndarray, "rows length"] | UInt8[np.ndarray, "rows length"] | None = None
    descriptor_kind: str | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if self.rgb is not None:
            object.__setattr__(self, "rgb", np.asarray(self.rgb))
        if self.rgb is not None and (self.rgb.dtype != np.uint8 or self.rgb.ndim != 2 or self.rgb.shape[1] != 3):
            raise InputError(
                f"got rgb of type {self.rgb.dtype}, shape {self.rgb.shape}; expected uint8 of shape (rows, 3)"
            )
        if self.descriptor is None:
            if self.descriptor_kind is not None:
                raise InputError(f"got descriptor kind {self.descriptor_kind!r} without descriptors; expected both")
            return
        object.__setattr__(self, "descriptor", _checked(self.descriptor))
        kind = (self.descriptor_kind or UNKNOWN_KIND).strip().lower()
        object.__setattr__(self, "descriptor_kind", kind or UNKNOWN_KIND)
        if self.rgb is not None and len(self.rgb) != len(self.descriptor):
            raise InputError(
                f"got {len(self.rgb)} colours and {len(self.descriptor)} descriptors; expected equally many"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the attributes that are present, in the order of ``ATTRIBUTES``."""
        return tuple(name for name in ATTRIBUTES if getattr(self, name) is not None)

    def numbers(self) -> Float[np.ndarray, "rows width"] | None:
        """Descriptors as float32 whose differences mean something: those that are strings of bits as their bits."""
        if self.descriptor is None:
            return None
        return (np.unpackbits(self.descriptor, axis=1) if self._of_bits else self.descriptor).astype(np.float32)

    @property
    def width(self) -> int:
        """Numbers of each row: those of the colour, and of :meth:`numbers`."""
        bits = 8 if self._of_bits else 1
        return (0 if self.rgb is None else 3) + (0 if self.descriptor is None else bits * self.descriptor.shape[1])

    @property
    def _of_bits(self) -> bool:
        """Whether the descriptors are strings of bits."""
        return (
            self.descriptor is not None
            and self.descriptor.dtype == np.uint8
            and (
                self.descriptor_kind in BINARY_KINDS
                or (self.descriptor_kind == UNKNOWN_KIND and bool((self.descriptor >= 128).mean() > _HIGH_BITS))
            )
        )

    def check_rows(self, rows: int, of: str) -> None:
        """Refuse attributes that are not of ``rows`` points or lines; ``of`` names them."""
        for name in self.names:
            got = len(getattr(self, name))
            if got != rows:
                raise InputError(f"got {name} of {got} rows for {rows} {of}; expected one row each")

    def rows(self, index: Int[np.ndarray, " some"] | Bool[np.ndarray, " rows"]) -> Appearance:
        """Select rows by index or mask."""
        rgb, descriptor = (None if value is None else value[index] for value in (self.rgb, self.descriptor))
        return Appearance(rgb, descriptor, self.descriptor_kind)

    def without(self, names: Collection[str]) -> Appearance:
        """Leave out attributes by name; InputError if a name is unknown."""
        for name in names:
            if name not in ATTRIBUTES:
                raise InputError(f"got attribute {name!r} to leave out; expected some of {', '.join(ATTRIBUTES)}")
        rgb = None if "rgb" in names else self.rgb
        return Appearance(rgb) if "descriptor" in names else Appearance(rgb, self.descriptor, self.descriptor_kind)


class WithAppearance:
    """Base of frozen dataclasses with the fields ``rgb``, ``descriptor`` and ``descriptor_kind``."""

    rgb: UInt8[np.ndarray, "rows 3"] | None
    descriptor: np.ndarray | None
    descriptor_kind: str | None

    @property
    def appearance(self) -> Appearance:
        """Colours and descriptors."""
        return Appearance(self.rgb, self.descriptor, self.descriptor_kind)


#: Geometry alone.
NO_APPEARANCE = Appearance()


def _checked(descriptor: np.ndarray) -> np.ndarray:
    """Descriptors as uint8 or float32."""
    descriptor = np.asarray(descriptor)
    if descriptor.ndim != 2 or descriptor.shape[1] < 1 or descriptor.dtype.kind not in "fiu":
        raise InputError(
            f"got descriptors of type {descriptor.dtype}, shape {descriptor.shape}; expected numbers of shape "
            "(rows, length)"
        )
    if descriptor.dtype == np.uint8:
        return descriptor
    with np.errstate(over="ignore"):  # a number that is too large becomes infinite
        descriptor = descriptor.astype(np.float32)
    bad = ~np.isfinite(descriptor).all(axis=1)
    if bad.any():
        raise InputError(
            f"got {int(bad.sum())} descriptor(s) that are NaN or infinite, first in row {int(np.argmax(bad))}; remove "
            "them"
        )
    return descriptor
