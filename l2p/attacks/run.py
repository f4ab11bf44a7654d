"""From a line cloud to points: choose a method, run it in the working frame, come back to scene units."""

from __future__ import annotations

import hashlib
import json
import math
import time
from os import PathLike
from typing import Any

import numpy as np
import torch

from l2p.attacks.attack import Method, MethodInRounds
from l2p.attacks.heuristic import Heuristic, HeuristicConfig
from l2p.attacks.learned.checkpoint import load, shipped
from l2p.attacks.settings import DEFAULT_METHOD, METHODS, SETTINGS
from l2p.attacks.tomographic import TomographicConfig, Tomography
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.version import __version__
from l2p.work.journal import Rounds
from l2p.work.memory import allotted, room
from l2p.work.progress import NO_PROGRESS, Progress
from l2p.work.shards import Shards


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
        ``learned``: tomography, then rounds of a network that weighs the votes (:mod:`l2p.attacks.learned.learned`).
        ``tomography``: expectation maximisation on a sparse grid, then the votes around its modes
        (:mod:`l2p.attacks.tomography.reconstruct`). ``heuristic``: the attack of Chelani et al. (CVPR 2021).
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
    rounds: Rounds | None = None,
) -> Recovery:
    """Run any method, an attack, a bound or a user's own, on a line cloud.

    A method with an attribute ``calibrated`` that is true claims that its confidence is the probability of lying within
    1 spacing. ``memory`` (GiB a process) bounds methods that say how many bytes they hold of each line, in an attribute
    ``line_bytes``. With ``rounds``, several processes share the lines of this one, the first, while :func:`assist` runs
    in the others; and the run goes on from the last round in the journal.
    """
    if len(lines) == 0:
        raise InputError("got a line cloud without lines; expected at least one line")
    where = usable_device(device)
    size = _room(method, where, memory, len(lines), 1 if rounds is None else rounds.shards.processes)
    began = time.perf_counter()
    if rounds is not None:
        rounds.shards.check(len(lines))
        rounds.journal.begin(_about(lines, method, name))
    frame = Frame.of(lines)
    with torch.inference_mode(), room(size):
        inside = frame.enter(lines, where)
        if rounds is None:
            estimate = method.locate(inside, frame, progress)
        else:
            sharing = _in_rounds(method)
            if rounds.shards.processes > 1:
                inside, frame = _told(rounds.shards, method, where, inside, frame)
            estimate = sharing.locate_in_rounds(inside, frame, progress, rounds)
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
        calibrated=bool(getattr(method, "calibrated", False)),
    )


def assist(method: Method, shards: Shards, *, device: str = "cpu", memory: float | None = None) -> None:
    """Do the share of this process, another than the first, of what :func:`run` does in the first one.

    Raises
    ------
    InputError
        If this process has another method, other settings, another checkpoint or another version of l2p than the first.
    """
    where, sharing = usable_device(device), _in_rounds(method)
    with torch.inference_mode():
        lines, frame = _told(shards, method, where)
        with room(_room(method, where, memory, len(lines.direction), shards.processes)):
            sharing.locate_in_rounds(lines, frame, NO_PROGRESS, Rounds(shards))


def _room(method: Method, where: torch.device, memory: float | None, lines: int, processes: int) -> int | None:
    """Bytes that blocks have in this process; None where nothing bounds them."""
    line_bytes = getattr(method, "line_bytes", None)
    if line_bytes is None or (memory is None and where.type != "cpu"):
        return None
    return allotted(memory, math.ceil(lines / processes), line_bytes)


def _in_rounds(method: Method) -> MethodInRounds:
    if not isinstance(method, MethodInRounds):
        raise InputError(
            f"got {type(method).__name__} to share out or to go on with; expected a method with locate_in_rounds"
        )
    return method


def _about(lines: LineCloud, method: Method, name: str) -> dict[str, Any]:
    """What makes a run the same as another, for its journal."""
    digest = hashlib.sha256()
    for part in (lines.direction, lines.moment):
        digest.update(part.tobytes())
    return {
        "lines": digest.hexdigest(),
        "method": name or type(method).__name__,
        "settings": method.settings(),
        "l2p": __version__,
    }


def _told(
    shards: Shards, method: Method, where: torch.device, lines: Lines | None = None, frame: Frame | None = None
) -> tuple[Lines, Frame]:
    """The lines and the frame of the first process, the same bits at all of them."""
    same = json.dumps([__version__, type(method).__name__, method.settings()], sort_keys=True)
    own = torch.frombuffer(bytearray(hashlib.sha256(same.encode()).digest()), dtype=torch.uint8).to(where)
    if not torch.equal(shards.first(own.clone()), own):
        raise InputError(
            f"process {shards.rank} has another method, other settings, another checkpoint or another version of l2p "
            "than the first; start all with the same words"
        )
    if lines is not None and frame is not None:
        facts = torch.tensor([len(lines.direction), *frame.center, frame.unit, *frame.axes.flat], dtype=torch.float64)
        shards.first(facts.to(where))
        return Lines(*(shards.first(part) for part in lines)), frame
    facts = shards.first(torch.empty(14, dtype=torch.float64, device=where)).cpu().numpy()
    frame = Frame(facts[1:4], float(facts[4]), facts[5:].reshape(3, 3))
    return Lines(*(shards.first(torch.empty(int(facts[0]), 3, device=where)) for _ in range(2))), frame


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
