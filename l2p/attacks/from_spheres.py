"""Recovery from a sphere cloud: which rays are real; the distances are not in the map.

All lines meet in one centre. A camera there would see the same picture whatever the distances are, so no attack on the
geometry finds them, and the recovered points are the picture: one unit from the centre, on the signed rays. Fakes
carry the appearance of points that were left out, so an appearance that does not fit its neighbours on the sphere is a
sign of a fake; without appearances, only the looser spread of fakes is.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from l2p.attacks.alike import appearances_of
from l2p.attacks.attack import attributes_of
from l2p.attacks.learned.embedding import Appearances, unit
from l2p.errors import InputError
from l2p.geometry import frame
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.work.progress import NO_PROGRESS, Progress

#: What the recovery says in ``info["sentence"]``.
NO_DEPTH = (
    "all lines meet in one point, so nothing tells how far the points are: they are put at 1 scene unit from it, and "
    "the confidence is that of a ray being real"
)
#: Share of real rays by scheme.
REAL = {"sphere": 1.0, "sphere-50": 1 / 2, "sphere-33": 1 / 3, "sphere-25": 1 / 4}
#: Rank of the neighbour whose angle is the width of the kernel, and that of the wide surroundings.
_NEAR, _AROUND = 8, 48
#: Weight of the prior likelihood ratio of 1 among the neighbours.
_PRIOR = 0.5
#: Rays per block.
_BLOCK = 1024


@dataclass(frozen=True)
class SpheresConfig:
    """Settings of the attack on sphere clouds.

    Attributes
    ----------
    neighbors : int
        Nearest rays, by angle, that are compared with each ray.
    strength : float
        Power of the likelihood ratio of two appearances.
    spread : float
        Power of the angles' own evidence: fakes have more room around them.
    steps : int
        Steps of expectation maximisation of the probabilities of being real.
    cosine : bool
        The baseline instead: the mean cosine of the descriptors of a ray and its neighbours.
    """

    neighbors: int = 64
    strength: float = 1.25
    spread: float = 0.5
    steps: int = 6
    cosine: bool = False

    def __post_init__(self) -> None:
        if self.neighbors < 1 or self.steps < 1:
            raise InputError(f"got {self}; expected at least one neighbour and one step")


def recover_spheres(
    lines: LineCloud, config: SpheresConfig | None = None, progress: Progress = NO_PROGRESS
) -> Recovery:
    """Recover the picture on the sphere, and the probability that each ray is real.

    Parameters
    ----------
    lines : LineCloud
        All through one centre, directions pointing to the points; its scheme tells the share of fakes (unknown schemes:
        half of the rays).
    config : SpheresConfig, optional
    progress : Progress

    Returns
    -------
    Recovery
        Points at 1 scene unit from the centre. The confidence, which only ranks, is the probability of being real.

    Raises
    ------
    InputError
        If there are no lines, or the baseline has no descriptors.
    """
    config, began = config or SpheresConfig(), time.perf_counter()
    if len(lines) == 0:
        raise InputError("got a line cloud without lines; expected at least one line")
    center = meeting_point(lines)
    beta = lines.direction @ center + 1.0
    prior, used = REAL.get(lines.scheme, 0.5), ()
    if prior == 1 or len(lines) < 2:
        confidence = np.full(len(lines), prior)
    else:
        with progress.task("rays", 2 * len(lines)) as advance, torch.inference_mode():
            angle, near = _nearest(lines.direction, config.neighbors)
            advance(len(lines))
            if config.cosine:
                if lines.descriptor is None:
                    raise InputError("got the baseline for a map without descriptors; expected descriptors")
                confidence, used = mean_cosine(lines, near), ("descriptor",)
            else:
                appearances = appearances_of(lines.appearance)
                used = () if appearances is None else appearances.of
                confidence = real(angle, near, appearances, prior, config)
            advance(len(lines))
    info = {
        "method": "mean cosine of the neighbours" if config.cosine else "likeness of the neighbours on the sphere",
        "settings": asdict(config),
        "used": list(used),
        "device": "cpu",
        "seconds": time.perf_counter() - began,
        "sentence": NO_DEPTH,
    }
    return Recovery(lines.at(beta), confidence.astype(np.float32), beta, rgb=lines.rgb, info=info)


def meeting_point(lines: LineCloud) -> Float[np.ndarray, "3"]:
    """The point of least squared distance to the lines, scene units."""
    return frame.meeting_point(lines.direction, lines.origin, np.ones(len(lines)))


def real(
    angle: Float[np.ndarray, "rays k"],
    near: Int[np.ndarray, "rays k"],
    appearances: Appearances | None,
    prior: float,
    config: SpheresConfig,
) -> Float[np.ndarray, " rays"]:
    """Probability that each ray is real, by its neighbours on the sphere.

    Notes
    -----
    r_i / (1 - r_i) = prior odds * g_i * L_i, where L_i is the mean of exp(strength * s_ij) over the neighbours j,
    weighted by r_j and a Gaussian of the angle whose width is the angle of the 8th, with a weight of 1/2 for L = 1; and
    g_i compares that angle with the one of the 48th and with the median over the map. The equations are iterated from
    r = prior.
    """
    inner, outer = (angle[:, min(rank, angle.shape[1]) - 1] for rank in (_NEAR, _AROUND))
    floor = 1e-6 + 1e-3 * float(np.median(inner))
    inner = np.maximum(inner, floor)
    evidence = config.spread * (np.log(np.maximum(outer, floor)) - np.log(inner) - 0.5 * np.log(inner))
    odds = prior / (1 - prior) * np.exp(evidence - np.median(evidence))
    weight = np.exp(-0.5 * (angle / inner[:, None]) ** 2)
    ratio = np.ones_like(weight)
    if appearances is not None:
        for begin in range(0, len(near), _BLOCK):
            rows = np.arange(begin, min(begin + _BLOCK, len(near)))
            likeness = appearances.likeness(torch.as_tensor(rows), torch.as_tensor(near[rows]))
            ratio[rows] = np.exp(config.strength * likeness.double().numpy())
    found = np.full(len(near), prior)
    for _ in range(config.steps):
        part = weight * found[near]
        mean = ((part * ratio).sum(axis=1) + _PRIOR) / (part.sum(axis=1) + _PRIOR)
        found = odds * mean / (1 + odds * mean)
    return found


def mean_cosine(lines: LineCloud, near: Int[np.ndarray, "rays k"]) -> Float[np.ndarray, " rays"]:
    """The baseline: mean cosine of the descriptors of each ray and its 16 nearest neighbours, as (1 + cosine) / 2."""
    vector = unit(attributes_of(lines.appearance, torch.device("cpu"))["descriptor"]).numpy()
    near = near[:, :16]
    found = np.empty(len(near))
    for begin in range(0, len(near), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        found[rows] = np.einsum("rd,rkd->rk", vector[rows], vector[near[rows]]).mean(axis=1)
    return np.clip((1 + found) / 2, 0, 1)


def _nearest(
    direction: Float[np.ndarray, "rays 3"], count: int
) -> tuple[Float[np.ndarray, "rays k"], Int[np.ndarray, "rays k"]]:
    """Chord to each of the nearest other rays (the angle, where it is small), and their rows."""
    from l2p.geometry.points import nearest_neighbors

    found = nearest_neighbors(np.asarray(direction), count, workers=1)
    return found.distance, found.index
