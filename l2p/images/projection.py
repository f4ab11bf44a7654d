"""Projection of points into a view: which of them it shows, where, and what is known of each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l2p.images.views import View
from l2p.maps.appearance import SIFT, Appearance

#: Side of the cells in which points behind others are left out, pixels, and the ratio to the nearest distance in a
#: cell from which on a point counts as behind.
CELL, BEHIND = 8, 1.6
#: Length of the descriptors that the network knows (kind ``sift``), and of one of them as COLMAP stores it.
DESCRIPTOR, NORM = 128, 512.0


class Sighted(NamedTuple):
    """The points that a view shows.

    Attributes
    ----------
    row : (points,) int64
        Row of each in the cloud.
    place : (points,) int64
        Its pixel, counted along the rows of the picture.
    nearness : (points,) float32
        Median distance of the points over its own distance: 1 is ordinary, 2 is half as far.
    """

    row: Int[np.ndarray, " points"]
    place: Int[np.ndarray, " points"]
    nearness: Float[np.ndarray, " points"]


def sighted(xyz: Float[np.ndarray, "points 3"], confidence: Float[np.ndarray, " points"], view: View) -> Sighted:
    """Find the points in a view that no other points hide.

    A point is hidden if it is 1.6 times as far as the nearest point of its cell of 8 pixels. Wrong points in front of a
    camera would hide what is true, so that only the more confident half hides others.
    """
    pixel, distance = view.seen(xyz)
    row = np.flatnonzero(np.isfinite(pixel[:, 0]))
    if not len(row):
        return Sighted(row, row, np.zeros(0, dtype=np.float32))
    pixel, distance, confidence = pixel[row].astype(np.int64), distance[row], confidence[row]
    across = -(-view.width // CELL)
    cell = (pixel[:, 1] // CELL) * across + pixel[:, 0] // CELL
    nearest = np.full(across * -(-view.height // CELL), np.inf)
    hides = confidence >= np.median(confidence)
    np.minimum.at(nearest, cell[hides], distance[hides])
    shown = distance <= BEHIND * nearest[cell]
    place = pixel[:, 1] * view.width + pixel[:, 0]
    median = np.median(distance[shown]) if shown.any() else 1.0
    return Sighted(row[shown], place[shown], (median / distance[shown]).astype(np.float32))


class Marks(NamedTuple):
    """What the network is told of each point in a picture.

    Attributes
    ----------
    place : (points,) int64
        Its pixel, counted through the whole batch of pictures.
    color : (points, 3) float32
        Colour in [0, 1]; 0 where unknown.
    colored, described : (points,) bool
        Whether its colour, or its descriptor, is known.
    descriptor : (points, 128) float32
        SIFT, of length about 1; 0 where unknown.
    confidence, nearness : (points,) float32
    """

    place: Int[Tensor, " points"]
    color: Float[Tensor, "points 3"]
    colored: Bool[Tensor, " points"]
    descriptor: Float[Tensor, "points 128"]
    described: Bool[Tensor, " points"]
    confidence: Float[Tensor, " points"]
    nearness: Float[Tensor, " points"]


def knows(appearance: Appearance) -> bool:
    """Whether the network can read the descriptors: SIFT only."""
    return appearance.descriptor_kind == SIFT and appearance.descriptor is not None


def marks(found: Sighted, appearance: Appearance, confidence: Float[np.ndarray, " points"]) -> Marks:
    """Gather what is known of the points in a view."""
    count, row = len(found.row), found.row
    colored, described = appearance.rgb is not None, knows(appearance)
    color = torch.zeros(count, 3)
    if appearance.rgb is not None:
        color = torch.from_numpy(appearance.rgb[row].astype(np.float32) / 255)
    descriptor = torch.zeros(count, DESCRIPTOR)
    if described:
        assert appearance.descriptor is not None
        descriptor = torch.from_numpy(appearance.descriptor[row].astype(np.float32) / NORM)
    return Marks(
        torch.from_numpy(found.place),
        color,
        torch.full((count,), colored),
        descriptor,
        torch.full((count,), described),
        torch.from_numpy(confidence[row].astype(np.float32)),
        torch.from_numpy(found.nearness),
    )
