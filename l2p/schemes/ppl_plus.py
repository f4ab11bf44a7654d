"""Paired-point lines that leave the surfaces of their points (PPL+; Lee et al., CVPR 2023)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.errors import InputError
from l2p.maps.appearance import Appearance
from l2p.maps.truth import Hiding
from l2p.schemes.ppl import pair_lines, paired_rows

#: Neighbours of a local plane: a share of the points, at most so many, made even.
_NEIGHBORS, _MOST_NEIGHBORS = 0.01, 100
#: Least angle between a line and the local plane of its first point, degrees.
_ANGLE = 20.0
#: Most rounds of pairing; rejected pairs below which it ends; equal numbers of rejected pairs after which it ends, and
#: rounds before they count.
_ROUNDS, _FEW, _EQUAL, _PATIENCE = 1000, 10, 50, 100
#: Points whose neighbours are looked up at a time; it does not change what comes out.
_BLOCK = 4096


class PplPlus:
    """Scheme with a line through each two points, but for pairs whose line lies near the surface of the first.

    As :class:`l2p.schemes.ppl.Ppl`; a pair (a, b) is rejected if its line is within 20 degrees of the local plane of a.
    The plane goes through a, and its normal is the direction in which the nearest points (1 % of all, at most 100, an
    even number) spread least. Points of rejected pairs are paired anew, for at most 1,000 rounds, until fewer than 10
    pairs are rejected, or, after 100 rounds, their number was the same 50 times. What is left is not published.
    """

    name = "ppl+"
    answers = 2

    def hide(
        self,
        points: Float[np.ndarray, "points 3"],
        chosen: Int[np.ndarray, " chosen"],
        rng: np.random.Generator,
        appearance: Appearance,
    ) -> Hiding:
        """Draw pairs until their lines leave the planes.

        Raises
        ------
        InputError
            If there are fewer than 200 points, or no pair's line leaves its plane.
        """
        row = paired_rows(points, chosen, self.name)
        neighbors = int(min(_NEIGHBORS * len(row), _MOST_NEIGHBORS)) // 2 * 2
        if neighbors < 2:
            raise InputError(
                f"got {len(row)} points for {self.name}; expected at least 200, since a local plane takes 1 % of them"
            )
        xyz = points[row]
        pair = accepted_pairs(xyz, self.normals(_scatter(xyz, neighbors)), rng)
        if len(pair) == 0:
            raise InputError(f"got a map for {self.name} in which no two points leave a local plane; take ppl")
        return pair_lines(points, row[pair], rng, appearance, self.name)

    @staticmethod
    def normals(scatter: Float[np.ndarray, "points 3 3"]) -> Float[np.ndarray, "points 3"]:
        """Normal of each local plane, from the scatter of the vectors to the neighbours."""
        return np.linalg.eigh(scatter)[1][..., 0]


class PplPlusPublished(PplPlus):
    """PPL+ as its published code computes it, where the test of a pair is not that of the local plane.

    The code takes the first row of V for the first row of V^T, the singular vectors of the neighbours: the first
    components s of the three axes of spread in place of the axis of the largest. What it then takes for the normal is
    the main direction of the products s x v with the vectors v to the neighbours. That depends on the axes of the map
    (and on the signs that the singular vectors happen to have; here NumPy's).
    """

    name = "ppl+published"

    @staticmethod
    def normals(scatter: Float[np.ndarray, "points 3 3"]) -> Float[np.ndarray, "points 3"]:
        """What the published code takes for the normal."""
        across = np.cross(np.linalg.eigh(scatter)[1][..., 0, None, ::-1], np.eye(3))  # rows s x e_i
        # sum of (s x v) (s x v)^T over v, as s x v = sum of v_i s x e_i
        return np.linalg.eigh(across.swapaxes(-1, -2) @ scatter @ across)[1][..., -1]


def accepted_pairs(
    xyz: Float[np.ndarray, "points 3"], normal: Float[np.ndarray, "points 3"], rng: np.random.Generator
) -> Int[np.ndarray, "pairs 2"]:
    """Pair points until the line of each pair leaves the plane across the normal of its first point.

    Parameters
    ----------
    xyz : (points, 3) float64
        An even number of points, scene units.
    normal : (points, 3) float64
        Unit normal of the local plane of each.
    rng : numpy.random.Generator
    """
    accepted, rejected, left = [], [], np.arange(len(xyz))
    for _ in range(_ROUNDS):
        pair = rng.permutation(left).reshape(-1, 2)
        along = xyz[pair[:, 1]] - xyz[pair[:, 0]]
        height = np.abs(np.sum(along * normal[pair[:, 0]], axis=1))
        flat = height <= np.sin(np.deg2rad(_ANGLE)) * np.linalg.norm(along, axis=1)
        accepted.append(pair[~flat])
        rejected.append(int(flat.sum()))
        left = pair[flat].ravel()
        if rejected[-1] < _FEW or (len(rejected) > _PATIENCE and len(set(rejected[-_EQUAL:])) == 1):
            break
    return np.concatenate(accepted)


def _scatter(xyz: Float[np.ndarray, "points 3"], neighbors: int) -> Float[np.ndarray, "points 3 3"]:
    """Sum of v v^T over the vectors v from each point to its nearest ones."""
    from scipy.spatial import KDTree

    tree, scatter = KDTree(xyz), np.empty((len(xyz), 3, 3))
    for start in range(0, len(xyz), _BLOCK):
        some = xyz[start : start + _BLOCK]
        nearest = np.asarray(tree.query(some, k=neighbors + 1)[1])[:, 1:]
        vector = xyz[nearest] - some[:, None]
        scatter[start : start + _BLOCK] = vector.swapaxes(1, 2) @ vector
    return scatter
