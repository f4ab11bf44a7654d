"""Lines that meet, are parallel or the same: the measurements by which a line cloud is recognised."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

#: Two lines are the same, or parallel, if they differ by less, as a share of their length or of the cloud's size: files
#: with six digits still count, and chance gives one pair of parallel lines among 200,000.
SAME = 1e-5
#: A line passes through a centre if its distance, in units of the cloud's size, is below this.
THROUGH = 1e-4
#: Most centres and bundles that are counted.
MOST_CENTRES = 8
#: Lines in which centres and bundles are searched; all lines are then compared with those that are found.
_SAMPLE = 1000
#: Most pairs of lines whose meeting point is tried as a centre, of the pairs that meet best.
_TRIED = 300
#: Least share of the lines through a centre, and least number.
_LEAST_SHARE, _LEAST = 0.02, 3
#: Distances that count as rounding: as a share of the distance from the origin of the scene, and in its units.
_ROUNDING, _TINY = 1e-9, 1e-13
#: Numbers in a block of reciprocal products, 16 MiB.
_BLOCK = 1 << 21


class Centred(NamedTuple):
    """Lines relative to a place amid them, in units of the cloud's size."""

    direction: Float[np.ndarray, "lines 3"]
    moment: Float[np.ndarray, "lines 3"]
    place: Float[np.ndarray, "3"]
    unit: float

    @property
    def foot(self) -> Float[np.ndarray, "lines 3"]:
        """Point of each line nearest to the place."""
        return np.cross(self.direction, self.moment)

    def rows(self, some: np.ndarray) -> Centred:
        """Select lines."""
        return Centred(self.direction[some], self.moment[some], self.place, self.unit)


def centred(
    direction: Float[np.ndarray, "lines 3"], moment: Float[np.ndarray, "lines 3"], rng: np.random.Generator
) -> Centred:
    """Move the origin to the point of least sum of distances to the lines; the unit is their median distance from it.

    Lines through that point up to rounding do not count for the unit; it is 0 if there are no others.
    """
    some = sample(len(direction), 4 * _SAMPLE, rng)
    place = np.median(np.cross(direction[some], moment[some]), axis=0)
    for _ in range(30):
        foot = np.cross(direction[some], moment[some] - np.cross(place, direction[some]))
        distance = np.linalg.norm(foot, axis=1)
        floor = 1e-6 * np.median(distance) + np.finfo(float).tiny ** 0.25
        step = meeting_point(direction[some], foot, 1 / np.maximum(distance, floor))
        place = place + step
        if np.linalg.norm(step) <= 1e-9 * np.median(distance):
            break
    moment = moment - np.cross(place, direction)
    distance = np.linalg.norm(moment, axis=1)
    apart = distance[distance > max(_ROUNDING * float(np.linalg.norm(place)), _TINY)]
    unit = float(np.median(apart)) if len(apart) else 0.0
    return Centred(direction, moment / (unit or 1.0), place, unit)


def meeting_point(
    direction: Float[np.ndarray, "lines 3"], foot: Float[np.ndarray, "lines 3"], weight: Float[np.ndarray, " lines"]
) -> Float[np.ndarray, "3"]:
    """The point of least weighted sum of squared distances to lines; if many, the one nearest to the origin."""
    weight = weight / weight.sum()
    normal = np.eye(3) - np.einsum("n,ni,nj->ij", weight, direction, direction)
    return np.linalg.lstsq(normal, weight @ foot, rcond=1e-12)[0]


def least_products(cloud: Centred, rows: Int[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Least reciprocal product of each given line with any other line, O(rows x lines) in blocks.

    The reciprocal product |d . m' + d' . m| of two lines is their distance times the sine of their angle (Plücker):
    the inner product of two vectors of six numbers.
    """
    other = np.concatenate((cloud.moment, cloud.direction), axis=1).T
    least = np.empty(len(rows))
    step = max(1, _BLOCK // other.shape[1])
    for begin in range(0, len(rows), step):
        block = rows[begin : begin + step]
        product = np.concatenate((cloud.direction[block], cloud.moment[block]), axis=1) @ other
        np.abs(product, out=product)
        product[np.arange(len(block)), block] = np.inf
        least[begin : begin + step] = product.min(axis=1)
    return least


def chance_meetings(cloud: Centred, rows: Int[np.ndarray, " rows"], rng: np.random.Generator) -> np.ndarray:
    """Number of lines that meet each given line as well as its best partner does, as expected by chance, (rows,).

    Near 0, the products of a line with independent lines have a constant density, which is estimated from the smallest
    2 % (at least 8) of its products with a sample of the lines. The number is then distributed as the waiting time of a
    Poisson process, exponential with mean 1, whatever the points behind the lines.
    """
    columns = sample(len(cloud.direction), _SAMPLE, rng)
    rank = min(len(columns) - 1, max(8, round(0.02 * len(columns))))
    product = np.abs(products(cloud.rows(rows), cloud.rows(columns)))
    product[rows[:, None] == columns[None]] = np.inf
    reach = np.partition(product, rank - 1, axis=1)[:, rank - 1]
    rate = rank / len(columns) * len(cloud.direction) / np.maximum(reach, np.finfo(float).tiny)
    return rate * least_products(cloud, rows)


def products(some: Centred, other: Centred) -> Float[np.ndarray, "some other"]:
    """Signed reciprocal products of all pairs of lines."""
    return some.direction @ other.moment.T + some.moment @ other.direction.T


def centres(cloud: Centred, rng: np.random.Generator) -> tuple[Float[np.ndarray, "centers 3"], np.ndarray]:
    """Find points through which many lines pass: the points, the most lines first, and the point of each line or -1.

    Of a sample of the lines, the meeting points of the pairs that meet best are tried (RANSAC with pairs that are not
    drawn blindly); the best is refined by least squares, its lines are taken away, and the search is repeated.
    """
    found: list[np.ndarray] = []
    family = np.full(len(cloud.direction), -1)
    least = max(_LEAST, round(_LEAST_SHARE * len(family)))
    while len(found) < MOST_CENTRES:
        left = np.flatnonzero(family < 0)
        if len(left) < least:
            break
        center = _centre(cloud.rows(left), rng)
        if center is None:
            break
        through = left[distance(cloud.rows(left), center) < THROUGH]
        if len(through) < least:
            break
        family[through] = len(found)
        found.append(center)
    points = np.reshape(np.array(found), (-1, 3)) * cloud.unit + cloud.place
    return points, family


def _centre(cloud: Centred, rng: np.random.Generator) -> np.ndarray | None:
    """The point, of those tried, through which most lines of the cloud pass; None without a pair that meets."""
    some = cloud.rows(sample(len(cloud.direction), _SAMPLE, rng))
    first, second = np.triu_indices(len(some.direction), 1)
    product = np.abs(products(some, some))[first, second]
    sine = np.sqrt(np.maximum(0.0, 1 - (some.direction @ some.direction.T)[first, second] ** 2))
    meet = np.flatnonzero((product < THROUGH * sine) & (sine > 1e-3))
    if len(meet) > _TRIED:
        meet = rng.choice(meet, _TRIED, replace=False)
    if len(meet) == 0:
        return None
    tried = _meeting_points(some.rows(first[meet]), some.rows(second[meet]))
    # |(x - foot) x d| of every tried point and line of the sample.
    apart = np.cross(tried[:, None], some.direction[None]) - some.moment[None]
    count = (np.linalg.norm(apart, axis=2) < THROUGH).sum(axis=1)
    center = tried[int(np.argmax(count))]
    for _ in range(3):
        near = cloud.rows(distance(cloud, center) < THROUGH)
        if len(near.direction) < 2:
            return None
        foot = np.cross(near.direction, near.moment - np.cross(center, near.direction))
        center = center + meeting_point(near.direction, foot, np.ones(len(foot)))
    return center


def _meeting_points(first: Centred, second: Centred) -> Float[np.ndarray, "pairs 3"]:
    """The middle of the shortest segment between the two lines of each pair."""
    cosine = np.sum(first.direction * second.direction, axis=1)
    apart = second.foot - first.foot
    along, along_second = np.sum(apart * first.direction, axis=1), np.sum(apart * second.direction, axis=1)
    square = 1 - cosine**2
    beta = (along - cosine * along_second) / square
    beta_second = (cosine * along - along_second) / square
    ends = first.foot + beta[:, None] * first.direction, second.foot + beta_second[:, None] * second.direction
    return (ends[0] + ends[1]) / 2


def distance(cloud: Centred, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, " lines"]:
    """Distance of a point from each line, in the units of the cloud."""
    return np.linalg.norm(np.cross(point, cloud.direction) - cloud.moment, axis=1)


def repeats(cloud: Centred, rng: np.random.Generator) -> Bool[np.ndarray, " lines"]:
    """Mark lines that are the same as one that is not marked, O(lines log lines)."""
    same = np.zeros(len(cloud.direction), dtype=bool)
    parallel = np.flatnonzero(with_equal(tensors(cloud.direction), rng)[0])
    some = cloud.rows(parallel)
    # Far feet are compared relative to their distance.
    size = np.maximum(1.0, np.linalg.norm(some.moment, axis=1, keepdims=True))
    same[parallel] = with_equal(np.concatenate((tensors(some.direction), some.foot / size, 1 / size), axis=1), rng)[1]
    return same


def bundles(direction: Float[np.ndarray, "lines 3"], rng: np.random.Generator) -> Int[np.ndarray, " bundles"]:
    """Numbers of lines in the largest bundles of parallel lines, at most ``MOST_CENTRES``, the largest first."""
    sizes = []
    while len(direction) > 1 and len(sizes) < MOST_CENTRES:
        some = direction[sample(len(direction), _SAMPLE, rng)]
        tensor = tensors(some)
        count = (np.abs(tensor @ tensor.T - 1) < SAME**2).sum(axis=1)
        axis = some[int(np.argmax(count))]
        alike = np.linalg.norm(np.cross(axis, direction), axis=1) < SAME
        if alike.sum() < 2:
            break
        sizes.append(int(alike.sum()))
        direction = direction[~alike]
    return np.array(sorted(sizes, reverse=True), dtype=np.int64)


def sample(count: int, most: int, rng: np.random.Generator) -> Int[np.ndarray, " some"]:
    """All rows, or ``most`` of them at random."""
    return np.arange(count) if count <= most else np.sort(rng.choice(count, most, replace=False))


def tensors(direction: Float[np.ndarray, "lines 3"]) -> Float[np.ndarray, "lines 6"]:
    """The six different numbers of d d^T, scaled to length 1: the same for a direction and its opposite."""
    first, second = np.triu_indices(3)
    return direction[:, first] * direction[:, second] * np.where(first == second, 1.0, np.sqrt(2.0))


def with_equal(
    value: Float[np.ndarray, "lines numbers"], rng: np.random.Generator
) -> tuple[Bool[np.ndarray, " lines"], Bool[np.ndarray, " lines"]]:
    """Mark rows that equal another up to ``SAME``, and of these all but the first of each group of equal rows.

    Equal rows are neighbours in the order of a random projection.
    """
    equal, further = np.zeros((2, len(value)), dtype=bool)
    order = np.argsort(value @ rng.normal(size=value.shape[1]), kind="stable")
    columns = np.ascontiguousarray(value[order].T)
    # Rounding lets a few other rows of a large cloud come between two equal ones.
    for step in range(1, 6):
        row = np.arange(len(value) - step)
        for column in columns:
            row = row[np.abs(column[row + step] - column[row]) < SAME]
        equal[order[row]] = equal[order[row + step]] = further[order[row + step]] = True
    return equal, further
