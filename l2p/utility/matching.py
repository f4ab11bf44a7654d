"""Matches of a query with the landmarks of a release: by the tracks of the model, or by descriptors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from l2p.utility.queries import Queries, Query, unit

#: Largest distance of a descriptor to its nearest neighbour, over that to the second nearest (Lowe, 2004).
RATIO = 0.8


class Matches(NamedTuple):
    """Matches of keypoints of a query with landmarks.

    ``keypoint`` are rows of the query, ``landmark`` rows of the release; ``right`` says whether the model agrees.
    """

    keypoint: Int[np.ndarray, " matches"]
    landmark: Int[np.ndarray, " matches"]
    right: Bool[np.ndarray, " matches"]

    def __len__(self) -> int:
        return len(self.keypoint)


def by_tracks(
    query: Query,
    landmark_of: Int[np.ndarray, " points"],
    wrong: float,
    rng: np.random.Generator,
) -> Matches:
    """Match each observation with its own landmark, then turn a share of the matches into wrong ones.

    Parameters
    ----------
    query : Query
    landmark_of : (points,) int64
        Landmark of each point of the map; -1 if the release does not have it, or the map without the query does not.
    wrong : float
        Share of the matches whose landmark is replaced by any other one of the map, in [0, 1).
    rng : numpy.random.Generator

    Notes
    -----
    Tables of the literature match by tracks, which is nearly free of wrong matches; hence the share.
    """
    seen = np.flatnonzero(query.point >= 0)
    # A point that an image sees twice gives one match.
    seen = seen[np.unique(query.point[seen], return_index=True)[1]]
    keypoint = seen[landmark_of[query.point[seen]] >= 0]
    landmark = landmark_of[query.point[keypoint]]
    right = np.ones(len(keypoint), dtype=bool)
    others = landmark_of[landmark_of >= 0]
    if len(others) > 1:
        change = rng.choice(len(keypoint), size=round(wrong * len(keypoint)), replace=False)
        # A shift in the list of landmarks never leads to the same one.
        others = np.sort(others)
        place = np.searchsorted(others, landmark[change])
        shift = rng.integers(1, len(others), size=len(change))
        landmark[change] = others[(place + shift) % len(others)]
        right[change] = False
    return Matches(keypoint, landmark, right)


def by_descriptors(queries: Queries, query: Query, landmark_of: Int[np.ndarray, " points"]) -> Matches:
    """Match by nearest descriptors: each the nearest of the other, with a ratio test (:data:`RATIO`).

    A landmark has the mean descriptor of its track without the query's own observations. A match is right if the model
    has it.
    """
    point = np.flatnonzero(landmark_of >= 0)
    none = np.zeros(0, dtype=np.int64)
    if len(point) < 2 or query.descriptor is None or not len(query):
        return Matches(none, none, none.astype(bool))
    likeness = unit(query.descriptor) @ queries.descriptors_without(query, point).T
    keypoint, second, first = _two_best(likeness)
    mutual = likeness.argmax(axis=0)[first] == keypoint
    # Of unit vectors, |a - b|^2 = 2 - 2 a . b.
    best, next_best = (2 - 2 * likeness[keypoint, each] for each in (first, second))
    kept = mutual & (best < RATIO**2 * next_best)
    keypoint, matched = keypoint[kept], point[first[kept]]
    return Matches(keypoint, landmark_of[matched], query.point[keypoint] == matched)


def _two_best(
    likeness: Float[np.ndarray, "keypoints landmarks"],
) -> tuple[Int[np.ndarray, " keypoints"], Int[np.ndarray, " keypoints"], Int[np.ndarray, " keypoints"]]:
    """Rows, and the columns of the second largest and the largest number of each."""
    row = np.arange(len(likeness))
    two = np.argpartition(likeness, -2, axis=1)[:, -2:]
    order = np.argsort(likeness[row[:, None], two], axis=1)
    two = two[row[:, None], order]
    return row, two[:, 0], two[:, 1]
