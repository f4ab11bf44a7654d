"""Small things that several test files build."""

from __future__ import annotations

import torch

from l2p.attacks.learned.learned import Learned, LearnedConfig
from l2p.attacks.learned.network import LineTransformer, NetworkConfig

Calibration = list[list[tuple[float, float]]]


def learned(rounds: int = 2, calibration: Calibration | None = None, fraction: float = 1.0) -> Learned:
    """A learned attack with random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = LineTransformer(NetworkConfig(width=8, layers=1, heads=2))
    return Learned(network, LearnedConfig(rounds=rounds, candidates=24), calibration, fraction)
