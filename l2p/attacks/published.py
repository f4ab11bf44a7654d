"""The attacks that the authors of two schemes published with them, from their descriptions: baselines.

*Ray clouds* (Moon et al., CVPR 2024): rays of one centre meet there only, so the rays of the *other* centre vote; the
quarter of them with the smallest angle to the line through both centres does not. The peak is that of Chelani et al.

*Lines through pairs of points* (Lee et al., CVPR 2023): the votes of the nearest lines have two peaks. Their density is
estimated by Gaussian kernels, and its two highest maxima are taken.

Both use the coarse stage of Chelani et al. only, the nearest lines by the distance of lines.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from l2p.attacks.attack import Attack, Elements, Estimate
from l2p.attacks.families import other_lines_near_lines
from l2p.attacks.peak import PeakConfig
from l2p.attacks.settings import PublishedSettings
from l2p.attacks.votes import equal_weights, vote
from l2p.errors import InputError
from l2p.geometry.nearest import nearest_lines_to_lines
from l2p.geometry.pairs import closest_points
from l2p.work.work import Work

#: Neighbours: a share of the lines, at most so many for rays and for pairs.
_SHARE, _MOST_RAYS, _MOST_PAIRS = 0.05, 500, 1000
#: Share of the rays, those nearest to the direction from centre to centre, that do not vote.
_GRAZING = 0.25
#: Numbers per block of densities.
_TILE = 1 << 22
#: Places of the density over one bandwidth, and its range over the distance in which the lines lie.
_FINE, _RANGE = 4, 2.0


@dataclass(frozen=True)
class PublishedConfig(PublishedSettings):
    """Settings.

    Attributes
    ----------
    bandwidth : float
        Standard deviation of the kernels, over the median distance of the lines from their centre. The authors' .07 is
        in metres of their scenes; this one was the best of .02 to .3 on three training maps.
    peak : PeakConfig
        Search of the peak of rays.
    """

    bandwidth: float = 0.2
    peak: PeakConfig = PeakConfig()


class Published(Attack):
    """Votes of the rays of the other centre, or the two peaks of the votes for a pair; O(lines^2)."""

    schemes = ("ppl", "rays")

    def __init__(self, config: PublishedConfig | None = None) -> None:
        self.config = config or PublishedConfig()

    def finish(self, state: Elements, work: Work) -> Estimate:
        """Place the points.

        Raises
        ------
        InputError
            If the lines are neither pairs nor rays, or several processes share the work.
        """
        if work.shards.processes > 1:
            raise InputError("got several processes for the method published; expected one")
        if state.structure.family is not None:
            return self._rays(state, state.structure.family, work)
        if state.structure.twin is not None:
            return self._pairs(state, state.structure.twin, work)
        raise InputError(
            "got lines that are neither rays of a few centres nor pairs for the method published; expected these, "
            "or the method heuristic, which was published for uniform lines"
        )

    def _rays(self, state: Elements, family: Int[Tensor, " lines"], work: Work) -> Estimate:
        center = state.structure.center
        assert center is not None
        # The angle to the direction to the nearest other centre; there are two in the paper.
        apart = torch.cdist(center, center).fill_diagonal_(torch.inf).argmin(dim=1)
        axis = torch.nn.functional.normalize(center[apart] - center, dim=1)[family]
        along = (state.lines.direction * axis).sum(dim=1).abs()
        voting = along <= along.quantile(1 - _GRAZING)
        count = min(_MOST_RAYS, max(1, round(_SHARE * len(state))))
        near = other_lines_near_lines(state.lines, count, family, voting)
        return vote(state.lines, near, peak=self.config.peak, work=work)

    def _pairs(self, state: Elements, twin: Int[Tensor, " lines"], work: Work) -> Estimate:
        row = torch.arange(len(state), device=twin.device)
        once = row[row < twin]
        lines = state.lines.rows(once)
        count = min(_MOST_PAIRS, max(1, round(_SHARE * len(once))))
        near = nearest_lines_to_lines(lines, count, work=work).index
        votes = closest_points(lines, lines, near)
        half = _RANGE * float(lines.moment.norm(dim=1).quantile(0.97)) or 1.0
        # The frame's unit is the median distance of the lines.
        places, density = two_peaks(votes.beta, votes.valid, self.config.bandwidth, half)
        beta, confidence = (row.new_zeros(len(row), dtype=places.dtype) for _ in range(2))
        for column, element in enumerate((once, twin[once])):
            beta[element], confidence[element] = places[:, column], density[:, column]
        neighbors = torch.empty(len(row), near.shape[1], dtype=near.dtype, device=near.device)
        neighbors[once] = neighbors[twin[once]] = (
            once[near.clamp_min(0).long()].to(near.dtype).masked_fill(near < 0, -1)
        )
        return Estimate(beta, confidence, neighbors, equal_weights(state.lines, neighbors))

    def settings(self) -> dict[str, Any]:
        """Return the configuration."""
        return asdict(self.config)


def two_peaks(
    beta: Float[Tensor, "lines k"], valid: Bool[Tensor, "lines k"], bandwidth: float, half: float
) -> tuple[Float[Tensor, "lines 2"], Float[Tensor, "lines 2"]]:
    """Find the two highest maxima of the Gaussian kernel density of votes between -half and half.

    Return their places, and the density there as a share of what all votes in one place would give. A line with one
    maximum has it twice; without a vote it has its foot.
    """
    step = bandwidth / _FINE
    bins = 2 * max(2, round(half / step)) + 1
    reach = 3 * _FINE
    offset = torch.arange(-reach, reach + 1, dtype=beta.dtype, device=beta.device) / _FINE
    kernel = torch.exp(-0.5 * offset.square())[None, None]
    places, heights = [], []
    for some, used in zip(beta.split(max(1, _TILE // bins)), valid.split(max(1, _TILE // bins)), strict=True):
        place = (some / step).round() + bins // 2
        inside = used & (place >= 0) & (place < bins)
        count = some.new_zeros(len(some), bins)
        count.scatter_add_(1, place.clamp(0, bins - 1).nan_to_num(0).long(), inside.to(some.dtype))
        density = torch.nn.functional.conv1d(count[:, None], kernel, padding=reach)[:, 0]
        density = density / used.sum(dim=1, keepdim=True).clamp_min(1)
        around = torch.nn.functional.pad(density, (1, 1))
        peak = (density > around[:, :-2]) & (density >= around[:, 2:])
        height, where = density.masked_fill(~peak, 0).topk(2, dim=1)
        where = torch.where(height > 0, where, where[:, :1])
        middle = (where - bins // 2) * step
        places.append(torch.where(height[:, :1] > 0, middle, torch.zeros_like(middle)))
        heights.append(height.clamp(0, 1))
    return torch.cat(places), torch.cat(heights)


def build(settings: PublishedSettings) -> Published:
    """Build the attack with these settings."""
    return Published(PublishedConfig(**asdict(settings)))
