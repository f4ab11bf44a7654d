"""Planes of several servers, joined on their descriptors: three planes of one point meet in it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from l2p.maps.planes import PlaneCloud

#: Most servers, and the number of digits in which normals of one server agree.
_MOST, _DIGITS = 16, 6
#: Rows per block of the search of the nearest descriptors.
_BLOCK = 512
#: Most planes of one descriptor in one server that are told apart by geometry.
_MOST_ALIKE = 6


def servers(normal: Float[np.ndarray, "planes 3"]) -> Int[np.ndarray, " planes"] | None:
    """Server of each plane, if the normals are a few (three or more that span the space); None if they are not."""
    first = np.take_along_axis(normal, np.argmax(np.abs(normal) > 1e-4, axis=1)[:, None], axis=1)
    kinds, group = np.unique(np.round(normal * np.sign(first), _DIGITS), axis=0, return_inverse=True)
    few = 3 <= len(kinds) <= min(_MOST, len(normal) // 2)
    if not few or np.linalg.matrix_rank(kinds, tol=1e-3) < 3:
        return None
    return group.reshape(-1)


def joined(
    cloud: PlaneCloud, group: Int[np.ndarray, " planes"]
) -> tuple[Float[np.ndarray, "planes 3"], Float[np.ndarray, " planes"]]:
    """The point of each plane and a confidence: 1 where one plane of each server has the same descriptor.

    Notes
    -----
    1. A descriptor that occurs once at each server joins its planes; their point solves the system of all of them.
    2. One that occurs k > 1 times at each is ambiguous: of the combinations, those that lie nearest to points of
       step 1 are taken, confidence 1 / k.
    3. Planes that are left (descriptors computed anew at each server) are joined with the nearest descriptor of each
       other server, if the nearness is mutual with the first server; the confidence is 1 - (nearest distance / second).
    4. Without partners, the point is the foot of the plane nearest to the mean of the others, confidence 0.
    """
    assert cloud.descriptor is not None
    count = int(group.max()) + 1
    kind = np.unique(cloud.descriptor, axis=0, return_inverse=True)[1].reshape(-1)
    table = np.zeros((kind.max() + 1, count), dtype=np.int64)
    np.add.at(table, (kind, group), 1)
    xyz, confidence = np.full((len(cloud), 3), np.nan), np.zeros(len(cloud))
    once = np.flatnonzero((table == 1).all(axis=1)[kind])
    order = once[np.lexsort((group[once], kind[once]))].reshape(-1, count)
    _place(cloud, order, np.ones(len(order)), xyz, confidence)
    several = np.flatnonzero((table == table[:, :1]).all(axis=1) & (table[:, 0] > 1) & (table[:, 0] <= _MOST_ALIKE))
    for each in several:
        rows = np.flatnonzero(kind == each)
        sets = _by_geometry(cloud, [rows[group[rows] == server] for server in range(count)], xyz)
        _place(cloud, sets, np.full(len(sets), 1 / len(sets)), xyz, confidence)
    left = np.flatnonzero(np.isnan(xyz[:, 0]))
    if len(left):
        _place(cloud, *_by_nearness(cloud, group, left, count), xyz, confidence)
    left = np.isnan(xyz[:, 0])
    middle = np.zeros(3) if left.all() else xyz[~left].mean(axis=0)
    reach = cloud.normal[left] @ middle - cloud.offset[left]
    xyz[left] = middle - reach[:, None] * cloud.normal[left]
    return xyz, confidence


def _place(
    cloud: PlaneCloud,
    sets: Int[np.ndarray, "sets servers"],
    sure: Float[np.ndarray, " sets"],
    xyz: Float[np.ndarray, "planes 3"],
    confidence: Float[np.ndarray, " planes"],
) -> None:
    """Write the points of sets of planes, in place."""
    if len(sets):
        xyz[sets] = met(cloud, sets)[:, None]
        confidence[sets] = sure[:, None]


def met(cloud: PlaneCloud, sets: Int[np.ndarray, "sets servers"]) -> Float[np.ndarray, "sets 3"]:
    """The point in which the planes of each set meet, by least squares."""
    normal = cloud.normal[sets]
    return (np.linalg.pinv(normal) @ cloud.offset[sets][..., None])[..., 0]


def _by_geometry(
    cloud: PlaneCloud, rows: list[Int[np.ndarray, " own"]], xyz: Float[np.ndarray, "planes 3"]
) -> Int[np.ndarray, "sets servers"]:
    """Divide planes of one descriptor into sets: greedily those whose point is nearest to a known point."""
    from scipy.spatial import KDTree

    sets = np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1).reshape(-1, len(rows))
    known = xyz[~np.isnan(xyz[:, 0])]
    far = np.asarray(KDTree(known).query(met(cloud, sets))[0]) if len(known) else np.zeros(len(sets))
    taken: list[np.ndarray] = []
    for each in sets[np.argsort(far, kind="stable")]:
        if not any((each == other).any() for other in taken):
            taken.append(each)
    return np.array(taken)


def _by_nearness(
    cloud: PlaneCloud, group: Int[np.ndarray, " planes"], left: Int[np.ndarray, " left"], count: int
) -> tuple[Int[np.ndarray, "sets servers"], Float[np.ndarray, " sets"]]:
    """Join each plane of the first server with the planes of nearest descriptor of the others, if that is mutual."""
    numbers = cloud.appearance.numbers()
    assert numbers is not None
    own = [left[group[left] == server] for server in range(count)]
    if min(map(len, own)) == 0:
        return np.zeros((0, count), dtype=np.int64), np.zeros(0)
    columns, sure, good = [own[0]], np.ones(len(own[0])), np.ones(len(own[0]), dtype=bool)
    for rows in own[1:]:
        there, ratio = _nearest(numbers[own[0]], numbers[rows])
        back = _nearest(numbers[rows], numbers[own[0]])[0]
        good &= back[there] == np.arange(len(there))
        columns.append(rows[there])
        sure = np.minimum(sure, 1 - ratio)
    return np.stack(columns, axis=1)[good], sure[good]


def _nearest(
    some: Float[np.ndarray, "some length"], others: Float[np.ndarray, "others length"]
) -> tuple[Int[np.ndarray, " some"], Float[np.ndarray, " some"]]:
    """The nearest of ``others`` to each row, and its distance over that of the second nearest."""
    index, ratio = np.zeros(len(some), dtype=np.int64), np.zeros(len(some))
    square = np.sum(others**2, axis=1)
    for begin in range(0, len(some), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        own = np.sum(some[rows] ** 2, axis=1)
        distance = np.maximum(own[:, None] + square - 2 * some[rows] @ others.T, 0)
        index[rows] = distance.argmin(axis=1)
        two = np.partition(distance, 1, axis=1)[:, :2] if len(others) > 1 else np.full((len(own), 2), np.inf)
        ratio[rows] = np.sqrt(two[:, 0] / np.maximum(two[:, 1], 1e-30)) if len(others) > 1 else 0
    return index, np.minimum(ratio, 1)
