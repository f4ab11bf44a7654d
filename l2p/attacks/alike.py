"""Likeness of the published appearances of a map of any scheme, and classes of like appearances.

The log likelihood ratio s_ij of two appearances (:mod:`l2p.attacks.learned.embedding`) does not depend on how the
points were hidden, so attacks on planes, permuted points and spheres take it from the shipped checkpoint, too.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.attack import attributes_of
from l2p.attacks.learned.checkpoint import read, shipped
from l2p.attacks.learned.embedding import Appearances, check_length, embedded
from l2p.maps.appearance import Appearance

#: Rows per block of comparisons of all elements with all.
_BLOCK = 512
#: Steps of Lloyd's algorithm.
_STEPS = 8


class Classes(NamedTuple):
    """Classes of like appearances: the class of each element, and the likelihood ratio of each two classes."""

    label: Int[Tensor, " elements"]
    ratio: Float[Tensor, "classes classes"]


def appearances_of(appearance: Appearance) -> Appearances | None:
    """Embed colours and descriptors by the shipped checkpoint; None without any that it knows.

    Descriptors of a kind that the checkpoint was not trained for are not used.

    Raises
    ------
    InputError
        If descriptors of the known kind have another length.
    """
    network = read(shipped()).network.eval()
    attributes = attributes_of(appearance, torch.device("cpu"))
    if appearance.descriptor_kind != network.config.kind:
        attributes.pop("descriptor", None)
    if not attributes:
        return None
    check_length(attributes, network.config.length)
    with torch.inference_mode():
        return embedded(network.embedding, attributes, tuple(attributes))


def likeness_of(appearances: Appearances, rows: slice) -> Float[Tensor, "rows elements"]:
    """s_ij of a block of elements with all, minus infinity with themselves."""
    some, background = appearances.vector[rows], appearances.background
    found = some @ appearances.vector.T - 0.5 * (background[rows, None] + background)
    own = torch.arange(len(some))
    found[own, own + rows.start] = -torch.inf
    return found


def most_alike_of(appearances: Appearances, count: int) -> Int[Tensor, "elements count"]:
    """The ``count`` other elements that are most alike to each; O(elements^2), in blocks."""
    elements = len(appearances.vector)
    count = min(count, elements - 1)
    found = torch.empty(elements, count, dtype=torch.int64)
    for begin in range(0, elements, _BLOCK):
        rows = slice(begin, min(begin + _BLOCK, elements))
        found[rows] = likeness_of(appearances, rows).topk(count, dim=1).indices
    return found


def classes_of(appearances: Appearances | None, elements: int, count: int, strength: float) -> Classes:
    """Divide elements into at most ``count`` classes of like appearance (k-means of their vectors).

    ``ratio`` of two classes is exp(strength * s) of their means; without appearances there is one class. The classes
    depend neither on the order of the elements nor on their geometry.
    """
    if appearances is None:
        return Classes(torch.zeros(elements, dtype=torch.int64), torch.ones(1, 1))
    vector = appearances.vector
    order = vector[:, 0].argsort(stable=True)
    first = torch.linspace(0, elements - 1, min(count, elements)).round().long()
    mean = vector[order[first]]
    label = order
    for _ in range(_STEPS):
        label = (vector @ mean.T - 0.5 * mean.square().sum(dim=1)).argmax(dim=1)
        size = torch.bincount(label, minlength=len(mean)).clamp_min(1)
        mean = torch.zeros_like(mean).index_add_(0, label, vector) / size[:, None]
    size = torch.bincount(label, minlength=len(mean)).clamp_min(1)
    background = mean.new_zeros(len(mean)).index_add_(0, label, appearances.background) / size
    likeness = mean @ mean.T - 0.5 * (background[:, None] + background)
    return Classes(label, (strength * likeness).exp())
