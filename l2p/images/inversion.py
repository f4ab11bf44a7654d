"""The inversion network: from sparse points of a view to a picture.

Pittaluga et al. ("Revealing scenes by inverting structure from motion reconstructions", CVPR 2019) turn projected
points into a photograph by a cascade of three U-Nets of 1.2 GB. This one is a single U-Net of under two million
parameters whose input is sparse at every scale: the points are averaged into a pyramid, each level of the encoder
reads its own level of it, and what the network predicts is the difference to filling between the colours of the points
(push and pull: Gortler et al., "The lumigraph", SIGGRAPH 1996, section 3.4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from l2p.images.projection import DESCRIPTOR, Marks

#: Bounds of the weight of a point, and of its nearness as an input.
_LIGHTEST, _NEAREST = 0.02, 4.0


@dataclass(frozen=True)
class InversionConfig:
    """Sizes of the network.

    Attributes
    ----------
    features : int
        Features of a point, its colour included.
    widths : tuple of int
        Channels of each level of the U-Net; each level has half the resolution of the one before.
    """

    features: int = 24
    widths: tuple[int, ...] = (16, 32, 64, 96, 128, 128)

    @property
    def multiple(self) -> int:
        """Width and height of an input are multiples of this."""
        return 2 ** (len(self.widths) - 1)


class Level(NamedTuple):
    """The points at one resolution: mean features of the points in each pixel, and the sum of their weights."""

    mean: Float[Tensor, "pictures features height width"]
    weight: Float[Tensor, "pictures 1 height width"]


class PointEncoder(nn.Module):
    """Features and a weight of each point; the first three features are its colour, estimated where it is unknown."""

    def __init__(self, features: int, hidden: int = 48) -> None:
        super().__init__()
        self.describe = nn.Linear(DESCRIPTOR, hidden)
        self.mix = nn.Sequential(nn.Linear(hidden + 7, hidden), nn.ReLU(), nn.Linear(hidden, features + 1))

    def forward(self, marks: Marks) -> tuple[Float[Tensor, "points features"], Float[Tensor, " points"]]:
        """Return features and weights."""
        described = functional.relu(self.describe(marks.descriptor)) * marks.described[:, None]
        flags = [marks.colored.float(), marks.described.float(), marks.confidence, marks.nearness.clamp_max(_NEAREST)]
        found = self.mix(torch.cat([described, marks.color * 2 - 1, torch.stack(flags, dim=1)], dim=1))
        color = torch.where(marks.colored[:, None], marks.color, torch.sigmoid(found[:, :3]))
        # Its own confidence is the start; what the network adds can at most halve or double it, over and over.
        weight = marks.confidence.clamp_min(_LIGHTEST) * torch.exp(found[:, -1].clamp(-3, 3))
        return torch.cat([color, found[:, 3:-1]], dim=1), weight


def pyramid(
    feature: Float[Tensor, "points features"],
    weight: Float[Tensor, " points"],
    marks: Marks,
    size: tuple[int, int, int],
    levels: int,
) -> list[Level]:
    """Average points into the pixels of pictures of ``size`` (pictures, height, width), at full resolution and at
    ``levels - 1`` halvings of it."""
    pictures, height, width = size
    sums = torch.zeros(pictures * height * width, feature.shape[1] + 1, dtype=feature.dtype, device=feature.device)
    sums = sums.index_add(0, marks.place, torch.cat([feature * weight[:, None], weight[:, None]], dim=1))
    sums = sums.view(pictures, height, width, -1).permute(0, 3, 1, 2)
    found = []
    for level in range(levels):
        if level:
            sums = functional.avg_pool2d(sums, 2) * 4
        mass = sums[:, -1:]
        found.append(Level(sums[:, :-1] / mass.clamp_min(1e-6), mass))
    return found


def filled(levels: list[Level], channels: int = 3) -> Float[Tensor, "pictures channels height width"]:
    """Fill between the points, by push and pull: a pixel without points has the colour of the next coarser level."""
    coarsest = levels[-1]
    whole = (coarsest.mean[:, :channels] * coarsest.weight).mean(dim=(2, 3), keepdim=True)
    whole = whole / coarsest.weight.mean(dim=(2, 3), keepdim=True).clamp_min(1e-6)
    value = whole.expand(-1, -1, *coarsest.mean.shape[2:])
    for level in reversed(levels):
        if value.shape[2:] != level.mean.shape[2:]:
            value = functional.interpolate(value, size=level.mean.shape[2:], mode="bilinear", align_corners=False)
        share = level.weight.clamp_max(1)
        value = share * level.mean[:, :channels] + (1 - share) * value
    return value


def _pair(inward: int, outward: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inward, outward, 3, padding=1), nn.ReLU(), nn.Conv2d(outward, outward, 3, padding=1), nn.ReLU()
    )


class Inversion(nn.Module):
    """The network: points of some pictures in, pictures out."""

    def __init__(self, config: InversionConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or InversionConfig()
        widths, sparse = config.widths, config.features + 1
        self.points = PointEncoder(config.features)
        self.down = nn.ModuleList(
            _pair(sparse + (widths[level - 1] if level else 3), width) for level, width in enumerate(widths)
        )
        self.up = nn.ModuleList(
            _pair(widths[level] + widths[level + 1], widths[level]) for level in range(len(widths) - 1)
        )
        self.last = nn.Conv2d(widths[0] + 3, 3, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(cast(Tensor, self.last.bias))

    def forward(self, marks: Marks, size: tuple[int, int, int]) -> Float[Tensor, "pictures 3 height width"]:
        """Compute pictures of ``size`` (pictures, height, width), whose sides are multiples of ``config.multiple``;
        colours are in [0, 1] but for some overshoot."""
        feature, weight = self.points(marks)
        levels = pyramid(feature, weight, marks, size, len(self.down))
        fill = filled(levels)
        below: list[Tensor] = []
        value = fill
        for number, (level, block) in enumerate(zip(levels, self.down, strict=True)):
            if number:
                value = functional.max_pool2d(value, 2)
            value = block(torch.cat([value, level.mean, torch.log1p(level.weight)], dim=1))
            below.append(value)
        for number in reversed(range(len(self.up))):
            value = functional.interpolate(value, scale_factor=2, mode="nearest")
            value = self.up[number](torch.cat([below[number], value], dim=1))
        return fill + self.last(torch.cat([value, fill], dim=1))
