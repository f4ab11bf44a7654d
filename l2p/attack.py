"""From a line cloud to points: choose a method, run it in the working frame, come back to scene units."""

from __future__ import annotations

import time
from os import PathLike
from typing import Any

import numpy as np
import torch

from l2p.checkpoint import load, shipped
from l2p.errors import InputError
from l2p.frame import Frame
from l2p.lines import LineCloud
from l2p.memory import allotted, room
from l2p.methods import DEFAULT_METHOD, METHODS, SETTINGS
from l2p.neighborhoods import Heuristic, HeuristicConfig, Method, TomographicConfig, Tomography
from l2p.progress import NO_PROGRESS, Progress
from l2p.recovery import Recovery


def recover(
    lines: LineCloud,
    method: str = DEFAULT_METHOD,
    *,
    checkpoint: str | PathLike[str] | None = None,
    rounds: int | None = None,
    scene_kind: str | None = None,
    density: float | None = None,
    device: str = "cpu",
    memory: float | None = None,
    progress: Progress = NO_PROGRESS,
) -> Recovery:
    """Recover the points behind a line cloud.

    Parameters
    ----------
    lines : LineCloud
    method : str
        ``learned``: tomography, then rounds of a network that weighs the votes (:mod:`l2p.learned`).
        ``tomography``: expectation maximisation on a sparse grid, then the votes around its modes
        (:mod:`l2p.tomography`). ``heuristic``: the attack of Chelani et al. (CVPR 2021).
    checkpoint : path, optional
        Weights for ``learned``, as ``python -m train`` writes them; those installed with the package when left out.
    rounds : int, optional
        Rounds of refinement; the method's own number when left out. ``learned`` knows as many as its checkpoint was
        trained for, and 0: the modes of the tomography alone.
    scene_kind : str, optional
        ``indoor`` or ``outdoor``, for the paper's table of neighbours; with ``heuristic`` only.
    density : float, optional
        Share of the map's points that the lines hold, in (0, 1]; 1 when left out. ``heuristic`` chooses its numbers
        of neighbours by it; the confidence of ``learned`` is that of lying within 1 spacing of the map, which is less
        than a spacing of the points behind the lines. ``tomography`` has no use for it.
    device : str
        A torch device.
    memory : float, optional
        GiB that the attack may take beyond what the process holds already; four fifths of what is free when left out.
        Work is done in blocks that fit; the answer does not depend on it. Of a device that is not the CPU, nothing is
        known when it is left out.
    progress : Progress
        Shows how far the work is.

    Returns
    -------
    Recovery
        Points in the order of the lines.

    Raises
    ------
    FileNotFoundError
        If there is no such checkpoint.
    InputError
        If the line cloud is empty, the method or the device is unknown, the method has no such setting or it is out of
        range, the checkpoint cannot be used, or the lines do not fit into the memory.

    Examples
    --------
    >>> import numpy as np, l2p
    >>> points = np.random.default_rng(1).normal(size=(200, 3))
    >>> l2p.recover(l2p.lift(points, seed=0), method="tomography").confidence.shape
    (200,)
    """
    chosen = named_method(method, checkpoint=checkpoint, rounds=rounds, scene_kind=scene_kind, density=density)
    return run(lines, chosen, device=device, memory=memory, progress=progress, name=method)


def named_method(
    name: str,
    *,
    checkpoint: str | PathLike[str] | None = None,
    rounds: int | None = None,
    scene_kind: str | None = None,
    density: float | None = None,
) -> Method:
    """The attack of that name, ready to run; what is None is left to its configuration."""
    if name not in METHODS:
        raise InputError(f"got method {name!r}; expected one of {', '.join(METHODS)}")
    given = {"checkpoint": checkpoint, "rounds": rounds, "scene_kind": scene_kind, "density": density}
    chosen: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    for key in chosen:
        owners = SETTINGS.get(key, METHODS)
        if name not in owners:
            which = " or ".join(repr(owner) for owner in owners)
            raise InputError(f"got a {key.replace('_', ' ')} for method {name!r}; expected it with method {which} only")
    if name == "heuristic":
        return Heuristic(HeuristicConfig(**chosen))
    if name == "tomography":
        return Tomography(TomographicConfig(**chosen))
    file = chosen.pop("checkpoint", None)
    return load(shipped() if file is None else file, **chosen)


def run(
    lines: LineCloud,
    method: Method,
    *,
    device: str = "cpu",
    memory: float | None = None,
    progress: Progress = NO_PROGRESS,
    name: str = "",
) -> Recovery:
    """Run any method, an attack, a bound or a user's own, on a line cloud.

    ``memory`` (GiB) bounds methods that say how many bytes they hold of each line, in an attribute ``line_bytes``.
    """
    if len(lines) == 0:
        raise InputError("got a line cloud without lines; expected at least one line")
    where = usable_device(device)
    size, line_bytes = None, getattr(method, "line_bytes", None)
    if line_bytes is not None and (memory is not None or where.type == "cpu"):
        size = allotted(memory, len(lines), line_bytes)
    began = time.perf_counter()
    frame = Frame.of(lines)
    with torch.inference_mode(), room(size):
        inside = frame.enter(lines, where)
        estimate = method.locate(inside, frame, progress)
    beta = frame.leave(lines, estimate.beta)
    info = {
        "method": name or type(method).__name__,
        "settings": method.settings(),
        "device": str(where),
        "seconds": time.perf_counter() - began,
    }
    return Recovery(
        xyz=lines.at(beta),
        confidence=estimate.confidence.float().cpu().numpy(),
        beta=beta,
        rgb=lines.rgb,
        neighbors=estimate.neighbors.cpu().numpy().astype(np.int64),
        affinity=estimate.affinity.float().cpu().numpy(),
        info=info,
    )


def usable_device(name: str) -> torch.device:
    """The torch device of that name, if this machine has it."""
    available = ["cpu"]
    if torch.cuda.is_available():
        available += ["cuda", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if torch.backends.mps.is_available():
        available.append("mps")
    if name not in available:
        raise InputError(f"got device {name!r}; expected one of {', '.join(available)}")
    return torch.device(name)
