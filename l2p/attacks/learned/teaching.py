"""Self-taught appearance: the attack learns from the map that it attacks which appearances are neighbours there.

After a round, the lines whose estimates are most confident have mostly right neighbours. These pairs train the
embedding further, from that of the checkpoint, or from nothing if the checkpoint does not know this kind of descriptor.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torch.optim.adamw import adamw

from l2p.attacks.learned.embedding import Embedding
from l2p.errors import InputError
from l2p.work.work import ALONE, Work

#: Share of the steps of a lesson in which the learning rate rises.
_RISING = 0.1
#: Learning rate of the first step, over the largest.
_FIRST = 0.04
#: AdamW's decay of the means of slopes and of their squares, and its epsilon.
_BETAS, _EPSILON = (0.9, 0.999), 1e-8


@dataclass(frozen=True)
class TeachingConfig:
    """Settings of the lessons.

    Attributes
    ----------
    share : float
        Share of the lines, the most confident, that are learned from.
    neighbors : int
        Nearest of these that count as neighbours.
    least : int
        Fewest lines to learn from; smaller maps keep the embedding that they have.
    batch : int
        Lines in a step.
    steps, fresh_steps : int
        Steps of a lesson, for an embedding that knows this kind of appearance, and for a new one.
    passes : float
        Most steps, as a number of times that each line is drawn.
    rate, decay : float
        Learning rate and weight decay of AdamW.
    """

    share: float = 0.75
    neighbors: int = 16
    least: int = 256
    batch: int = 512
    steps: int = 50
    fresh_steps: int = 300
    passes: float = 20.0
    rate: float = 1e-3
    decay: float = 0.3

    def __post_init__(self) -> None:
        for name, least in (("neighbors", 1), ("least", 2), ("batch", 2), ("steps", 0), ("fresh_steps", 0)):
            if getattr(self, name) < least:
                raise InputError(f"got teaching.{name} {getattr(self, name)}; expected at least {least}")

    def steps_of(self, lines: int, fresh: bool) -> int:
        """Steps of a lesson on so many lines; 0 if they are too few to learn from."""
        count = int(self.share * lines)
        if count < self.least:
            return 0
        return min(self.fresh_steps if fresh else self.steps, int(self.passes * count / self.batch))


def taught(
    embedding: Embedding,
    attributes: Mapping[str, Float[Tensor, "lines width"]],
    point: Float[Tensor, "lines 3"],
    confidence: Float[Tensor, " lines"],
    config: TeachingConfig,
    fresh: bool = False,
    work: Work = ALONE,
) -> Embedding:
    """Train a copy of the embedding on the neighbours among the most confident estimates.

    Parameters
    ----------
    embedding : Embedding
        It is not changed.
    attributes : mapping
        Published attributes to embed.
    point, confidence
        Estimates of all lines.
    fresh : bool
        The embedding knows nothing yet.
    """
    from scipy.spatial import KDTree

    count = int(config.share * len(point))
    sure = confidence.argsort(descending=True, stable=True)[:count]
    place = point[sure].cpu().double().numpy()
    _, found = KDTree(place).query(place, min(config.neighbors + 1, count), workers=torch.get_num_threads())
    near = torch.as_tensor(found)[:, 1:]
    known = {name: value[sure] for name, value in attributes.items()}
    with torch.inference_mode(False), torch.enable_grad():
        # Tensors of inference mode cannot be trained on.
        known = {name: value.clone() for name, value in known.items()}
        with work.task("likeness", steps := config.steps_of(len(point), fresh)) as advance:
            return _trained(embedding, known, near.clone(), steps, config, fresh, advance)


def _trained(
    embedding: Embedding,
    attributes: Mapping[str, Float[Tensor, "sure width"]],
    near: Tensor,
    steps: int,
    config: TeachingConfig,
    fresh: bool,
    advance: Callable[[int], None],
) -> Embedding:
    count, neighbors = near.shape
    device = next(iter(attributes.values())).device
    learning = copy.deepcopy(embedding).requires_grad_(True)
    # The same lesson for the same lines.
    draw = torch.Generator().manual_seed(0)

    def lesson() -> Tensor:
        first = torch.randint(count, (min(config.batch, count),), generator=draw)
        second = near[first, torch.randint(neighbors, (len(first),), generator=draw)]
        rows = torch.cat([first, second]).to(device)
        here, there = learning({name: value[rows] for name, value in attributes.items()}).split(len(first))
        return contrast(here, there)

    return descended(learning, lesson, steps, config.rate * (1 + fresh), config.decay, _RISING, advance)


def descended(
    embedding: Embedding,
    lesson: Callable[[], Tensor],
    steps: int,
    rate: float,
    decay: float,
    rising: float,
    advance: Callable[[int], None],
) -> Embedding:
    """Minimise the loss that ``lesson`` returns, by AdamW with one cycle of the learning rate; return it frozen.

    ``rate`` is the largest learning rate, ``decay`` the weight decay, ``rising`` the share of steps to the largest.

    Notes
    -----
    The steps are those of ``torch.optim.AdamW``, whose class would load torch's compiler, which takes 3 seconds.
    """
    weights: list[Tensor] = list(embedding.parameters())
    means, squares = ([torch.zeros_like(weight) for weight in weights] for _ in range(2))
    counts = [torch.zeros(()) for _ in weights]
    for step in range(steps):
        slopes = torch.autograd.grad(lesson(), weights)
        with torch.no_grad():
            adamw(
                weights,
                list(slopes),
                means,
                squares,
                [],
                counts,
                foreach=False,
                amsgrad=False,
                beta1=_BETAS[0],
                beta2=_BETAS[1],
                lr=rate * _cycle(step / steps, rising),
                weight_decay=decay,
                eps=_EPSILON,
                maximize=False,
            )
        advance(1)
    return embedding.requires_grad_(False).eval()


def _cycle(done: float, rising: float) -> float:
    """Learning rate at a share of the steps, over the largest: up, then down, by cosines (Smith and Topin, 2018)."""
    if done < rising:
        return _FIRST + (1 - _FIRST) * 0.5 * (1 - math.cos(math.pi * done / rising))
    return 0.5 * (1 + math.cos(math.pi * (done - rising) / (1 - rising)))


def contrast(here: Float[Tensor, "batch size"], there: Float[Tensor, "batch size"]) -> Float[Tensor, ""]:
    """InfoNCE: which of the others is the neighbour of this one?"""
    likeness = here @ there.T
    answer = torch.arange(len(here), device=here.device)
    return 0.5 * (functional.cross_entropy(likeness, answer) + functional.cross_entropy(likeness.T, answer))
