"""The contract of a family of inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from l2p.attacks.learned.candidates import Candidates


class Kind(Enum):
    """Conversion of a quantity to an input that does not depend on the scene's size or the sign of a direction.

    ``POSITION`` (along the line, from its foot): taken relative to the line's estimate, positive to the side where the
    feet are skewed, divided by the candidate's local scale, compressed by a signed logarithm. ``LENGTH``: divided by
    the candidate's local scale, compressed. ``RATIO``: its logarithm. ``NUMBER``: unchanged.
    """

    POSITION = 0
    LENGTH = 1
    RATIO = 2
    NUMBER = 3


class Values(NamedTuple):
    """Columns of a family for candidate pairs, in the order of ``Inputs.columns``, and its votes, positions on the line
    from its foot, in the order of ``Inputs.votes``."""

    columns: list[Float[Tensor, "rows k"]]
    votes: Sequence[Float[Tensor, "rows k"]] = ()


@runtime_checkable
class Inputs(Protocol):
    """A family: a frozen dataclass whose fields are its constants, all numbers, saved in checkpoints.

    Attributes
    ----------
    columns : mapping
        Name and kind of each input.
    votes : tuple of str
        Names of the votes of this family: positions on the line.
    needs : tuple of str
        Published attributes of the lines that the family needs. Each has a further column: 1 if present, 0 if absent.
        If one is absent, all columns of the family are 0. Such a family has no votes.
    """

    columns: Mapping[str, Kind]
    votes: tuple[str, ...]
    needs: tuple[str, ...]

    def of(self, pairs: Candidates) -> Values:
        """Compute columns and votes."""
        ...
