"""A toy attack that uses colours and descriptors: they say where points are, so that each gives some of them back."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

import l2p
from l2p.attacks.attack import Attack, Elements, Estimate
from l2p.maps.appearance import Appearance
from l2p.work.work import Work

#: The attack by name, as users give their own.
SEES = f"{__name__}:Sees"
#: Half the size of the world in which colours say a place, scene units.
REACH = 8.0


def telling_scene(points: int = 300, seed: int = 0, **layers: Any) -> l2p.Scene:
    """A room in which one colour in three, and three descriptors in four, say where their point is; others are 0."""
    xyz = l2p.simulate("room", points, seed).xyz
    rgb = np.clip((xyz + REACH) / (2 * REACH) * 255, 0, 255).astype(np.uint8)
    rgb[np.arange(points) % 3 > 0] = 0
    descriptor = xyz.astype(np.float32)
    descriptor[::4] = 0
    return l2p.Scene(xyz, **{"rgb": rgb, "descriptor": descriptor, "descriptor_kind": "toy"} | layers)


class Sees(Attack):
    """Places a point where its descriptor or its colour says, else at the foot of its line, with less confidence."""

    calibrated = True

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        return appearance.names

    def finish(self, state: Elements, work: Work) -> Estimate:
        lines = state.lines
        beta, confidence = torch.zeros(len(state)), torch.full((len(state),), 0.2)
        for name, sure in (("rgb", 0.8), ("descriptor", 0.9)):
            if name in state.attributes:
                value = state.attributes[name].numpy().astype(np.float64)
                place = state.frame.enter_points(value * 2 * REACH - REACH if name == "rgb" else value)
                says = torch.as_tensor(value.any(axis=1))
                beta = torch.where(says, (place * lines.direction).sum(1), beta)
                confidence[says] = sure
        none = torch.zeros(len(state), 0)
        return Estimate(beta, confidence, none.long(), none)
