"""l2p: recover the points behind a line cloud, and measure how much an attacker would recover.

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
    from l2p.attacks.run import recover
    from l2p.attacks.several import recover_releases
    from l2p.auditing.audit import Audit, audit
    from l2p.auditing.report import save_report
    from l2p.errors import InputError
    from l2p.images.picture import picture
    from l2p.images.views import View
    from l2p.io.files import load, save
    from l2p.judging.scores import evaluate
    from l2p.maps.lines import LineCloud
    from l2p.maps.permuted import PermutedCloud
    from l2p.maps.planes import PlaneCloud
    from l2p.maps.recovery import Recovery
    from l2p.maps.scene import Scene
    from l2p.maps.truth import Hiding, Truth
    from l2p.schemes.hide import hide, lift
    from l2p.simulator import simulate
    from l2p.utility.localization import Localization
    from l2p.utility.releases import localize
    from l2p.version import __version__

# Public names are loaded on first use (PEP 562), so that `import l2p` and `l2p --help` do not wait for torch.
_HOME = {
    "Audit": "l2p.auditing.audit",
    "Hiding": "l2p.maps.truth",
    "InputError": "l2p.errors",
    "LineCloud": "l2p.maps.lines",
    "Localization": "l2p.utility.localization",
    "PermutedCloud": "l2p.maps.permuted",
    "PlaneCloud": "l2p.maps.planes",
    "Recovery": "l2p.maps.recovery",
    "Scene": "l2p.maps.scene",
    "Truth": "l2p.maps.truth",
    "View": "l2p.images.views",
    "__version__": "l2p.version",
    "audit": "l2p.auditing.audit",
    "evaluate": "l2p.judging.scores",
    "hide": "l2p.schemes.hide",
    "lift": "l2p.schemes.hide",
    "load": "l2p.io.files",
    "localize": "l2p.utility.releases",
    "picture": "l2p.images.picture",
    "recover": "l2p.attacks.run",
    "recover_releases": "l2p.attacks.several",
    "save": "l2p.io.files",
    "save_report": "l2p.auditing.report",
    "simulate": "l2p.simulator",
}

__all__ = sorted(name for name in _HOME if name != "__version__")


if not TYPE_CHECKING:  # a checker of types would take any name for a public one

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module 'l2p' has no attribute {name!r}")
        value = getattr(importlib.import_module(_HOME[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
