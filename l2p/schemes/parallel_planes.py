"""Planes across an axis, one for each server (Geppert et al., CVPR 2022)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.appearance import Appearance
from l2p.maps.planes import PlaneCloud
from l2p.maps.truth import Hiding, Truth
from l2p.schemes.rounding import within_lattice


class Planes:
    """Scheme with one plane per point, as one server stores it: all planes are across the first axis of the map.

    *Inferred* from the abstract of the paper. By design one coordinate of every point is published, and two are not.
    """

    name = "planes"
    answers = 1
    publishes = PlaneCloud
    #: Axes of the servers.
    axes: tuple[int, ...] = (0,)

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Draw an order of the points for each server."""
        moved = within_lattice(points, chosen, rng)
        order = np.concatenate([rng.permutation(len(chosen)) for _ in self.axes])
        axis = np.repeat(self.axes, len(chosen))
        row = chosen[order]
        planes = _planes(np.eye(3)[axis], moved[order, axis], appearance.rows(row), self.name)
        return Hiding(planes, Truth(points[row], row))


class PlanesPooled(Planes):
    """Scheme with three planes per point: what three servers, one for each axis, know together.

    The planes of a server are in an order of their own, drawn at random. Descriptors are stored as they are: by design,
    whoever joins the servers on equal descriptors gets every point back exactly. The truth has three rows a point, one
    for each of its planes.
    """

    name = "planes-pooled"
    axes = (0, 1, 2)


def _planes(
    normal: Float[np.ndarray, "planes 3"], offset: Float[np.ndarray, " planes"], appearance: Appearance, scheme: str
) -> PlaneCloud:
    return PlaneCloud(normal, offset, appearance.rgb, scheme, appearance.descriptor, appearance.descriptor_kind)
