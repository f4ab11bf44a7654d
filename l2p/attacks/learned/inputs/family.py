"""The contract of a family of inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from l2p.attacks.learned.candidates import Candidates


class Kind(Enum):
    """How a quantity becomes an input, which does not depend on the scene's size nor on a line's direction.

    ``POSITION``: along the line from its foot; counted from its estimate, to the side where the feet are skewed, over
    the candidate's local scale, compressed by a signed logarithm. ``LENGTH``: over the candidate's local scale,
    compressed. ``RATIO``: its logarithm. ``NUMBER``: as it is.
    """

    POSITION = 0
    LENGTH = 1
    RATIO = 2
    NUMBER = 3


class Values(NamedTuple):
    """The columns of a family for candidate pairs, in the order of ``Inputs.columns``, and its votes, positions on the
    line from its foot, in the order of ``Inputs.votes``."""

    columns: list[Float[Tensor, "rows k"]]
    votes: Sequence[Float[Tensor, "rows k"]] = ()


@runtime_checkable
class Inputs(Protocol):
    """A family: a frozen dataclass whose fields are its constants, all numbers, which a checkpoint holds.

    Attributes
    ----------
    columns : mapping
        Name and kind of each input.
    votes : tuple of str
        Names of the places where this family says that a line's point is.
    needs : tuple of str
        Attributes that have to be published beside the lines. Where one is absent, the columns are 0, and so is a
        further column that says whether it is there. Such a family has no votes.
    """

    columns: Mapping[str, Kind]
    votes: tuple[str, ...]
    needs: tuple[str, ...]

    def of(self, pairs: Candidates) -> Values:
        """Compute columns and votes."""
        ...
