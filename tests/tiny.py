"""Small things that several test files build."""

from __future__ import annotations

import torch

from l2p.attacks.attack import Elements
from l2p.attacks.learned.embedding import TAUGHT
from l2p.attacks.learned.inputs import GEOMETRY
from l2p.attacks.learned.learned import Learned
from l2p.attacks.learned.learned_config import LearnedConfig
from l2p.attacks.learned.network import LineTransformer, NetworkConfig

Calibration = dict[str, list[list[tuple[float, float]]]]


def learned(rounds: int = 2, calibration: Calibration | None = None, fraction: float = 1.0) -> Learned:
    """A learned attack with random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = LineTransformer(NetworkConfig(width=8, layers=1, heads=2))
    return Learned(network, LearnedConfig(rounds=rounds, candidates=24), calibration, fraction)


def seeing(kind: str = "sift", length: int = 128) -> Learned:
    """A learned attack with random weights whose network uses appearance."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        size = NetworkConfig(width=8, layers=1, heads=2, inputs=(*GEOMETRY, "likeness"), kind=kind, length=length)
        network = LineTransformer(size)
    return Learned(network, LearnedConfig(rounds=2, candidates=16))


def knowledge(elements: Elements) -> str:
    """What the present likeness was computed from."""
    appearance = elements.attributes.get("appearance")
    return "lines" if appearance is None else "+".join(name for name in appearance.of if name != TAUGHT)
