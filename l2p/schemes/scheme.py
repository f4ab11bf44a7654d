"""The contract of a scheme, a way to hide the points of a map, and the names of all schemes."""

from __future__ import annotations

import pkgutil
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, runtime_checkable

from l2p.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float, Int

    from l2p.maps.appearance import Appearance
    from l2p.maps.truth import Hiding

DEFAULT_SCHEME = "uniform"
#: The scheme that has cells.
CELLS = "rays-voxel"

#: Schemes by name: ``module:class``, loaded on use, so that ``l2p --help`` does not wait for NumPy.
SCHEMES = {
    DEFAULT_SCHEME: "l2p.schemes.uniform:Uniform",
    "ppl": "l2p.schemes.ppl:Ppl",
    "ppl+": "l2p.schemes.ppl_plus:PplPlus",
    "ppl+published": "l2p.schemes.ppl_plus:PplPlusPublished",
    "rays": "l2p.schemes.rays:Rays",
    "rays-voxel": "l2p.schemes.rays_voxel:RaysVoxel",
    "half-space": "l2p.schemes.half_space:HalfSpace",
    "sphere": "l2p.schemes.sphere:Sphere",
    "sphere-50": "l2p.schemes.sphere:Sphere50",
    "sphere-33": "l2p.schemes.sphere:Sphere33",
    "sphere-25": "l2p.schemes.sphere:Sphere25",
    "planes": "l2p.schemes.parallel_planes:Planes",
    "planes-pooled": "l2p.schemes.parallel_planes:PlanesPooled",
    "planes-random": "l2p.schemes.random_planes:RandomPlanes",
    "permuted": "l2p.schemes.swapped:Permuted",
    "spread-votes": "l2p.schemes.spread_votes:SpreadVotes",
    "decoys": "l2p.schemes.decoys:Decoys",
    "through-dense": "l2p.schemes.through_dense:ThroughDense",
}
#: Their names as a type, for completion in editors.
SchemeName: TypeAlias = Literal[
    "uniform",
    "ppl",
    "ppl+",
    "ppl+published",
    "rays",
    "rays-voxel",
    "half-space",
    "sphere",
    "sphere-50",
    "sphere-33",
    "sphere-25",
    "planes",
    "planes-pooled",
    "planes-random",
    "permuted",
    "spread-votes",
    "decoys",
    "through-dense",
]
#: What each scheme does, in a few words.
MEANINGS = {
    DEFAULT_SCHEME: "lines of random direction",
    "ppl": "lines through random pairs of points",
    "ppl+": "such lines that leave the surfaces of their points",
    "ppl+published": "ppl+ as its published code computes it",
    "rays": "lines to one of two centres, at random",
    "rays-voxel": "lines to two centres that alternate from cell to cell",
    "half-space": "lines to the centre of the point's side of a plane",
    "sphere": "directions from the mean of the points",
    "sphere-50": "as sphere, half of them fakes",
    "sphere-33": "as sphere, two thirds of them fakes",
    "sphere-25": "as sphere, three quarters of them fakes",
    "planes": "planes across one axis, what one server stores",
    "planes-pooled": "planes across all three axes, what three servers store together",
    "planes-random": "planes of random normal",
    "permuted": "points that swapped one coordinate in pairs",
    "spread-votes": "lines of which neighbours pass each other far from their points",
    "decoys": "lines that also meet in false places",
    "through-dense": "lines through other dense places of the map",
}
#: Schemes that no attack was made for: their lines are attacked as if they were uniform.
UNATTACKED = ("spread-votes",)


@runtime_checkable
class Scheme(Protocol):
    """A way to replace points by lines, planes or other points.

    Attributes
    ----------
    name : str
        Name in :data:`SCHEMES` and in the ``scheme`` of its maps.
    answers : int
        Largest number of points behind a line: 1, or 2 if lines pass through pairs of points.

    Notes
    -----
    A scheme that publishes no lines says so in ``publishes``, the type of its maps.
    """

    name: str
    answers: int

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Draw the lines (planes, points), in an order that does not depend on the points.

        Parameters
        ----------
        points : (points, 3) float64
            All points of the scene, scene units.
        chosen : (chosen,) int64
            Rows of the points to hide, in random order unless all are hidden.
        rng : numpy.random.Generator
            Source of all randomness.
        appearance : Appearance
            Colours and descriptors of all points of the scene, to be stored with the lines.

        Returns
        -------
        Hiding
            Its truth needs ``xyz``, ``index`` and, unless it is the identity, ``element``.
        """
        ...


def scheme_of(name: str, cell: float | None = None) -> Any:
    """Load the :class:`Scheme` of this name; ``cell`` is the side of the cells of ``rays-voxel``, in scene units.

    Raises
    ------
    InputError
        If there is no such scheme, or it has no cells.
    """
    if not isinstance(name, str) or name not in SCHEMES:
        raise InputError(f"got scheme {name!r}; expected one of {', '.join(SCHEMES)}")
    make = pkgutil.resolve_name(SCHEMES[name])
    if cell is None:
        return make()
    if name != CELLS:
        raise InputError(f"got a cell for {name}; expected none, as only {CELLS} has cells")
    return make(cell)


def published_by(name: str) -> type[Any]:
    """Type of the maps of a scheme; InputError if there is no such scheme."""
    from l2p.maps.lines import LineCloud

    return getattr(scheme_of(name), "publishes", LineCloud)
