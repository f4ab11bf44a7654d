"""The contract of a scheme, a way to replace points by lines, and the names of all schemes."""

from __future__ import annotations

import pkgutil
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from l2p.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float, Int

    from l2p.maps.appearance import Appearance
    from l2p.maps.truth import Hiding

DEFAULT_SCHEME = "uniform"

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
}


@runtime_checkable
class Scheme(Protocol):
    """A way to replace points by lines.

    Attributes
    ----------
    name : str
        Name in :data:`SCHEMES` and in ``LineCloud.scheme``.
    answers : int
        Largest number of points behind a line: 1, or 2 if lines pass through pairs of points.
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
        """Draw the lines, in an order that does not depend on the points.

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


def scheme_of(name: str) -> Any:
    """Load the :class:`Scheme` of this name.

    Raises
    ------
    InputError
        If there is no such scheme.
    """
    if name not in SCHEMES:
        raise InputError(f"got scheme {name!r}; expected one of {', '.join(SCHEMES)}")
    return pkgutil.resolve_name(SCHEMES[name])()
