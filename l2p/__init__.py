"""l2p: recover the points behind a line cloud, and tell how much an attacker would get back.

>>> import l2p
>>> scene = l2p.simulate("room", points=300, seed=0)
>>> lines = l2p.lift(scene.xyz, seed=0)
>>> result = l2p.recover(lines)
>>> result.xyz.shape
(300, 3)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from l2p.attack import recover
    from l2p.auditing import Audit, audit
    from l2p.errors import InputError
    from l2p.lifting import lift, lift_indexed
    from l2p.lines import LineCloud
    from l2p.metrics import evaluate
    from l2p.recovery import Recovery
    from l2p.scene import Scene, Truth
    from l2p.simulator import simulate

__version__ = "0.1.0"

# Public names are loaded on first use (PEP 562), so that `import l2p` and `l2p --help` do not wait for torch.
_HOME = {
    "Audit": "l2p.auditing",
    "InputError": "l2p.errors",
    "LineCloud": "l2p.lines",
    "Recovery": "l2p.recovery",
    "Scene": "l2p.scene",
    "Truth": "l2p.scene",
    "audit": "l2p.auditing",
    "evaluate": "l2p.metrics",
    "lift": "l2p.lifting",
    "lift_indexed": "l2p.lifting",
    "recover": "l2p.attack",
    "simulate": "l2p.simulator",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'l2p' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
