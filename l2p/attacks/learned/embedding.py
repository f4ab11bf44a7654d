"""Likeness: how much more probable the appearance of two points is if they are neighbours.

Let u_i be what is published beside line i, its descriptor and colour. The log likelihood ratio

    s_ij = log p(u_i, u_j | neighbours) - log p(u_i) p(u_j)

is estimated by f(u_i) . f(u_j), where f is a network trained by InfoNCE (van den Oord et al., 2018): of many points of
one map, choose the neighbour of a point. That leaves a constant per point, which is removed by s_ij's own definition:
the mean of exp(s_ij) over the points j of the map is 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from l2p.errors import InputError
from l2p.geometry.elements import picked
from l2p.maps.appearance import ATTRIBUTES

#: Descriptors of a kind that the checkpoint does not know, and an embedding that the map itself has taught.
OTHER, TAUGHT = "other", "taught"
#: What a likeness can be computed from.
SOURCES = (*ATTRIBUTES, OTHER, TAUGHT)
#: Factors that bring a unit descriptor and a centred colour to numbers of about 1.
_DESCRIPTOR_GAIN, _COLOUR_GAIN = 10.0, 4.0
#: Points of the map over which exp(s_ij) is averaged.
_BACKGROUND = 2048
#: Rows per block, where they are embedded, and where they are compared, so that the products stay in the cache.
_BLOCK, _COMPARED = 4096, 256
#: Least mean of exponentials.
_TINY = 1e-30


class Embedding(nn.Module):
    """f: from colour and descriptor to a vector; either may be absent.

    Parameters
    ----------
    length : int
        Length of a descriptor.
    width : int
        Width of the two hidden layers.
    size : int
        Length of the vector.
    """

    def __init__(self, length: int, width: int, size: int) -> None:
        super().__init__()
        self.length = length
        self.layers = nn.Sequential(
            nn.Linear(length + 3 + len(ATTRIBUTES), width),
            nn.GELU(),
            nn.Linear(width, width),
            nn.GELU(),
            nn.Linear(width, size),
        )
        self.log_scale = nn.Parameter(torch.tensor(2.0))

    def forward(self, attributes: Mapping[str, Float[Tensor, "rows width"]]) -> Float[Tensor, "rows size"]:
        """Embed rows of ``rgb`` and ``descriptor``, those that are given; all vectors have one length."""
        some = next(iter(attributes.values()))
        rgb, descriptor = (attributes.get(name) for name in ATTRIBUTES)
        blank = some.new_zeros(len(some), 1)
        columns = [
            blank.expand(-1, 3) if rgb is None else (rgb - 0.5) * _COLOUR_GAIN,
            blank.expand(-1, self.length) if descriptor is None else unit(descriptor) * _DESCRIPTOR_GAIN,
            blank + (rgb is not None),
            blank + (descriptor is not None),
        ]
        vector = nn.functional.normalize(self.layers(torch.cat(columns, dim=1)), dim=1)
        return vector * (0.5 * self.log_scale).exp()


class Appearances(NamedTuple):
    """Vectors f(u) of all lines, and the logarithm of the mean of exp(f(u_i) . f(u_j)) over the lines j.

    ``of`` says what they were computed from, some of ``SOURCES``.
    """

    vector: Float[Tensor, "lines size"]
    background: Float[Tensor, " lines"]
    of: tuple[str, ...] = ()

    def likeness(self, rows: Int[Tensor, " rows"], others: Int[Tensor, "rows k"]) -> Float[Tensor, "rows k"]:
        """s_ij of lines with some others."""
        product = (picked(self.vector, others) @ self.vector.index_select(0, rows)[:, :, None])[..., 0]
        return product - 0.5 * (self.background.index_select(0, rows)[:, None] + picked(self.background, others))


def embedded(
    embedding: Embedding, attributes: Mapping[str, Float[Tensor, "lines width"]], of: tuple[str, ...]
) -> Appearances:
    """Embed all lines by their attributes, at least one."""
    return compared(vectors(embedding, attributes), of)


def vectors(
    embedding: Embedding, attributes: Mapping[str, Float[Tensor, "lines width"]]
) -> Float[Tensor, "lines size"]:
    """Compute f(u) of all lines."""
    count = len(next(iter(attributes.values())))
    return torch.cat(
        [
            embedding({name: value[begin : begin + _BLOCK] for name, value in attributes.items()})
            for begin in range(0, count, _BLOCK)
        ]
    )


def compared(vector: Float[Tensor, "lines size"], of: tuple[str, ...]) -> Appearances:
    """Compare the vectors of a map with each other."""
    # Lines are sorted by their coordinates, so every n-th is a fair sample.
    some = vector[:: max(1, len(vector) // _BACKGROUND)]
    # No product is larger than the largest square, so that no exponential overflows.
    most = vector.square().sum(dim=1).amax()
    mean = [(part @ some.T).sub_(most).exp_().mean(dim=1) for part in vector.split(_COMPARED)]
    return Appearances(vector, torch.cat(mean).clamp_min_(_TINY).log_() + most, of)


def averaged(one: Float[Tensor, "lines some"], other: Float[Tensor, "lines others"]) -> Float[Tensor, "lines both"]:
    """Vectors whose products are the means of the products f(u_i) . f(u_j) of two embeddings."""
    return torch.cat([one, other], dim=1) * 0.5**0.5


def unit(descriptor: Float[Tensor, "rows length"]) -> Float[Tensor, "rows length"]:
    """Descriptors of length 1: the length of a mean over a track tells how long the track is, not where it is."""
    return nn.functional.normalize(descriptor, dim=1)


def new_embedding(length: int, width: int, size: int) -> Embedding:
    """An embedding of descriptors of this length that knows nothing yet; always the same."""
    draw = torch.Generator().manual_seed(0)
    with torch.inference_mode(False):
        embedding = Embedding(length, width, size).requires_grad_(False)
        for layer in embedding.layers:
            if isinstance(layer, nn.Linear):
                bound = layer.in_features**-0.5
                layer.weight.uniform_(-bound, bound, generator=draw)
                layer.bias.uniform_(-bound, bound, generator=draw)
    return embedding


def check_length(attributes: Mapping[str, Tensor], length: int) -> None:
    """Refuse descriptors of another length than those of the checkpoint."""
    if "descriptor" in attributes and attributes["descriptor"].shape[1] != length:
        raise InputError(
            f"got descriptors of length {attributes['descriptor'].shape[1]}; expected {length}, as in the checkpoint, "
            "or leave them out (--ignore descriptor)"
        )
