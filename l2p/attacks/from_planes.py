"""Recovery of the points of a plane cloud, by what its normals are.

- *Random normals*: expectation maximisation of the density of the points on a grid (:mod:`l2p.attacks.density_grid`);
  a plane's point is where most of its mass is. ``nearest=k`` is the baseline instead: the point of the plane nearest to
  the planes of the k elements most alike, by reweighted least squares (in the manner of arXiv 2409.11536).
- *Parallel normals* (one server of Geppert et al., CVPR 2022): one coordinate is known, the others are not.
- *A few normals, equally often* (servers that pool): planes are joined on their descriptors; three of them meet in the
  point (:mod:`l2p.attacks.pooled`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from l2p.attacks.alike import Classes, appearances_of, classes_of, likeness_of, most_alike_of
from l2p.attacks.density_grid import finer, flat, maximised, share
from l2p.attacks.learned.embedding import Appearances
from l2p.attacks.plane_frame import PlaneFrame, plane_frame
from l2p.attacks.pooled import joined, servers
from l2p.errors import InputError
from l2p.maps.planes import PlaneCloud
from l2p.maps.recovery import Recovery
from l2p.work.progress import NO_PROGRESS, Progress

#: What the recovery of parallel planes says in ``info["sentence"]``.
ONE_COORDINATE = (
    "all planes are parallel: one coordinate of each point is known, and nothing tells the other two, so each point is "
    "put where its plane is nearest to the origin, with confidence 0"
)
#: Planes per block; the cells of a block take about 20 MB.
_BLOCK = 256
#: Largest sine of the angle between planes that count as parallel.
_PARALLEL = 1e-6
#: Width of the kernel around the estimates of other planes, in cells of the first grid, and power of their likeness.
_WIDTH, _LIKING = 1.5, 1.5
#: Steps of the mean shift.
_SHIFTS = 5
#: Steps of the least squares of the baseline.
_REFITS = 10


@dataclass(frozen=True)
class PlanesConfig:
    """Settings of the attack on planes.

    Attributes
    ----------
    side : int
        Cells along the cube at first; twice as many later.
    steps : int
        Steps of expectation maximisation at each resolution.
    inside : float
        Share of the planes whose distance from the centre is within the cube (:func:`plane_frame`).
    classes : int
        Classes of appearance.
    strength : float
        Power of the likelihood ratio of two appearances.
    window : int
        Side, in cells, of the window whose mass is maximised and is the confidence.
    alike : int
        Estimates whose nearness to the plane and likeness are greatest together, which place the point anew in the end;
        0: the density alone. Without appearances the density alone is used.
    nearest : int
        Neighbours by likeness of the least-squares baseline; 0: no baseline.
    """

    side: int = 24
    steps: int = 6
    inside: float = 0.97
    classes: int = 24
    strength: float = 2.5
    window: int = 3
    alike: int = 48
    nearest: int = 0

    def __post_init__(self) -> None:
        if min(self.side, self.steps, self.classes, self.window) < 1 or self.window % 2 == 0 or self.nearest < 0:
            raise InputError(f"got {self}; expected positive numbers and an odd window")
        if not 0 < self.inside <= 1:
            raise InputError(f"got inside {self.inside}; expected a share in (0, 1]")


def recover_planes(cloud: PlaneCloud, config: PlanesConfig | None = None, progress: Progress = NO_PROGRESS) -> Recovery:
    """Recover one point per plane.

    Parameters
    ----------
    cloud : PlaneCloud
    config : PlanesConfig, optional
    progress : Progress

    Returns
    -------
    Recovery
        Points in the planes, in their order; ``beta`` is 0. The confidence only ranks: the mass of the window around
        the point for random normals, 0 for parallel ones. ``info["sentence"]`` says what the map keeps secret.

    Raises
    ------
    InputError
        If there are fewer than three planes, their normals lie in one plane, or the baseline has no appearances.
    """
    config, began = config or PlanesConfig(), time.perf_counter()
    if len(cloud) == 0:
        raise InputError("got a plane cloud without planes; expected at least three planes")
    used: tuple[str, ...] = ()
    info: dict[str, object] = {}
    across = np.linalg.norm(np.cross(cloud.normal, cloud.normal[0]), axis=1)
    groups = servers(cloud.normal)
    if across.max() < _PARALLEL:
        method, xyz, confidence = "one coordinate", cloud.normal * cloud.offset[:, None], np.zeros(len(cloud))
        info["sentence"] = ONE_COORDINATE
    elif groups is not None and cloud.descriptor is not None:
        method, used = "planes joined on descriptors", ("descriptor",)
        xyz, confidence = joined(cloud, groups)
    else:
        if len(cloud) < 3 or np.linalg.matrix_rank(cloud.normal, tol=_PARALLEL) < 3:
            raise InputError(
                f"got {len(cloud)} plane(s) whose normals do not span the space; expected three planes or more that "
                "meet in points"
            )
        if groups is not None:
            info["sentence"] = (
                "the planes of a few servers can be joined on equal descriptors only, and the map has none: the points "
                "are guesses"
            )
        frame = plane_frame(cloud.normal, cloud.offset, config.inside)
        appearances = appearances_of(cloud.appearance)
        used = () if appearances is None else appearances.of
        normal, offset = _entered(cloud, frame)
        with torch.inference_mode():
            if config.nearest:
                if appearances is None:
                    raise InputError("got the baseline for a map without appearances; expected colours or descriptors")
                method = "least squares to the planes most alike"
                found = least_squares(normal, offset, most_alike_of(appearances, config.nearest))
                sure = torch.zeros(len(found))
            else:
                method = "density of planes"
                classes = classes_of(appearances, len(cloud), config.classes, config.strength)
                found, sure = _densest(normal, offset, classes, config, progress)
                if appearances is not None and config.alike and len(cloud) > 1:
                    width = _WIDTH / config.side
                    found, sure = placed_by_alike(normal, offset, found, sure, appearances, config.alike, width)
        xyz = frame.leave(found.double().numpy())
        xyz -= cloud.distance(xyz)[:, None] * cloud.normal
        confidence = sure.numpy()
    info |= {
        "method": method,
        "settings": asdict(config),
        "used": list(used),
        "device": "cpu",
        "seconds": time.perf_counter() - began,
    }
    beta = np.zeros(len(cloud))
    return Recovery(xyz, np.asarray(confidence, dtype=np.float32), beta, rgb=cloud.rgb, info=info)


def least_squares(
    normal: Float[Tensor, "planes 3"], offset: Float[Tensor, " planes"], others: Int[Tensor, "planes k"]
) -> Float[Tensor, "planes 3"]:
    """The point of each plane with the least robust squared distance to some other planes.

    Weights 1 / (1 + (d / s)^2), where s is the median distance, make far planes count little; crossings at a small
    angle count little by themselves, since their distance grows with sin^2 of the angle.
    """
    found = torch.empty_like(normal)
    for begin in range(0, len(normal), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        own, near, reach = normal[rows].double(), normal[others[rows]].double(), offset[others[rows]].double()
        foot = own * offset[rows, None].double()
        across = torch.eye(3, dtype=torch.float64) - own[:, :, None] * own[:, None]
        lever = near @ across
        rest = reach - (near * foot[:, None]).sum(-1)
        weight, step = torch.ones_like(rest), torch.zeros_like(foot)
        for _ in range(_REFITS):
            weighted = lever * weight[..., None]
            system = weighted.mT @ lever + own[:, :, None] * own[:, None] + 1e-9 * torch.eye(3, dtype=torch.float64)
            step = torch.linalg.solve(system, (weighted * rest[..., None]).sum(1)[..., None])[..., 0]
            distance = (rest - (lever * step[:, None]).sum(-1)).abs()
            scale = distance.median(dim=1, keepdim=True).values.clamp_min(1e-9)
            weight = 1 / (1 + (distance / scale).square())
        found[rows] = (foot + step).float()
    return found


def placed_by_alike(
    normal: Float[Tensor, "planes 3"],
    offset: Float[Tensor, " planes"],
    point: Float[Tensor, "planes 3"],
    sure: Float[Tensor, " planes"],
    appearances: Appearances,
    count: int,
    width: float,
) -> tuple[Float[Tensor, "planes 3"], Float[Tensor, " planes"]]:
    """The mode, in each plane, of the estimates of the others; each weighs its confidence times exp(1.5 s_ij).

    The ``count`` estimates of greatest weight times nearness to the plane count; mean shift starts at the densest of
    them. O(planes^2), in blocks. The second result is the share of the weight that lies around the mode.
    """
    found, share_there = torch.empty_like(point), torch.empty_like(sure)
    count = min(count, len(point) - 1)
    for begin in range(0, len(point), _BLOCK):
        rows = slice(begin, min(begin + _BLOCK, len(point)))
        distance = normal[rows] @ point.T - offset[rows, None]
        weight = _LIKING * likeness_of(appearances, rows) - 0.5 * (distance / width).square()
        top, other = (weight + sure.clamp_min(1e-6).log()).topk(count, dim=1)
        foot = point[other] - distance.gather(1, other)[..., None] * normal[rows, None]
        part = (top - top[:, :1]).exp()
        near = torch.exp(-0.5 * (foot[:, :, None] - foot[:, None]).square().sum(-1) / width**2)
        density = (near * part[:, None]).sum(-1)
        best = density.argmax(dim=1)
        place = foot[torch.arange(len(best)), best]
        for _ in range(_SHIFTS):
            kernel = part * torch.exp(-0.5 * (foot - place[:, None]).square().sum(-1) / width**2)
            place = (kernel[..., None] * foot).sum(1) / kernel.sum(1, keepdim=True).clamp_min(1e-30)
        found[rows] = place
        share_there[rows] = (density.amax(dim=1) / part.sum(dim=1).clamp_min(1e-30)).clamp(0, 1)
    return found, share_there


def plane_cells(
    normal: Float[Tensor, "rows 3"], offset: Float[Tensor, " rows"], side: int
) -> tuple[Int[Tensor, "rows cells"], Float[Tensor, "rows cells"]]:
    """Cells of the cube [-1, 1]^3 that hold a plane's points above (or beside) the centres of side x side columns.

    The columns are along the largest component of the normal, so that each has one point, and all stand for the same
    area. Cells are side^2 x + side y + z; the weight is 1 inside of the cube, 0 outside.
    """
    center = (torch.arange(side) + 0.5) * (2 / side) - 1
    axis = normal.abs().argmax(dim=1, keepdim=True)
    one, two = torch.tensor([[1, 2], [0, 2], [0, 1]])[axis[:, 0]].split(1, dim=1)
    first, second = normal.gather(1, one) * center, normal.gather(1, two) * center
    height = ((offset[:, None] - first)[:, :, None] - second[:, None]) / normal.gather(1, axis)[:, :, None]
    level = (height + 1) * (side / 2)
    inside = (level >= 0) & (level < side)
    stride, place = torch.tensor([side * side, side, 1]), torch.arange(side)
    cell = (stride[one] * place)[:, :, None] + (stride[two] * place)[:, None]
    cell = cell + stride[axis][:, :, None] * level.long().clamp_(0, side - 1)
    return cell.flatten(1), inside.flatten(1).to(normal.dtype)


def _densest(
    normal: Float[Tensor, "planes 3"],
    offset: Float[Tensor, " planes"],
    classes: Classes,
    config: PlanesConfig,
    progress: Progress,
) -> tuple[Float[Tensor, "planes 3"], Float[Tensor, " planes"]]:
    """The centre of the window of most mass in each plane, in the frame, and that mass."""
    side, count = config.side, len(normal)
    density = flat(classes, side)
    with progress.task("density of planes", 2 * config.steps * count) as advance:
        for level in range(2):
            if level:
                density, side = finer(density, side, 2), 2 * side

            spread = partial(_spread, normal, offset, side, advance)
            for _ in range(config.steps):
                density = maximised(density, classes, side, spread)
    found, confidence = torch.zeros(count, 3), torch.zeros(count)
    for begin in range(0, count, _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        cell, weight = plane_cells(normal[rows], offset[rows], side)
        mass = share(density, classes.label[rows], cell, weight)[1].view(-1, 1, side, side)
        window = torch.nn.functional.avg_pool2d(mass, config.window, 1, config.window // 2) * config.window**2
        most, place = window.flatten(1).max(dim=1)
        best = cell.gather(1, place[:, None])[:, 0]
        index = torch.stack([best // side**2, best // side % side, best % side], dim=1)
        # A plane that misses the cube has no mass anywhere: its point is the nearest to the centre.
        inside = (most > 0)[:, None]
        found[rows] = torch.where(inside, (index + 0.5) * (2 / side) - 1, torch.zeros(()))
        confidence[rows] = most.clamp(0, 1)
    return found, confidence


def _spread(
    normal: Float[Tensor, "planes 3"], offset: Float[Tensor, " planes"], side: int, advance: Callable[[int], None]
) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """The cells of all planes, in blocks."""
    for begin in range(0, len(normal), _BLOCK):
        rows = slice(begin, min(begin + _BLOCK, len(normal)))
        yield rows, *plane_cells(normal[rows], offset[rows], side)
        advance(rows.stop - rows.start)


def _entered(cloud: PlaneCloud, frame: PlaneFrame) -> tuple[Float[Tensor, "planes 3"], Float[Tensor, " planes"]]:
    """Planes in the frame, each with the sign that makes its largest component positive."""
    normal = cloud.normal @ frame.axes
    offset = (cloud.offset - cloud.normal @ frame.center) / frame.half
    largest = np.take_along_axis(normal, np.abs(normal).argmax(axis=1)[:, None], axis=1)
    sign = np.where(largest < 0, -1.0, 1.0)
    return torch.as_tensor(normal * sign).float(), torch.as_tensor(offset * sign[:, 0]).float()
