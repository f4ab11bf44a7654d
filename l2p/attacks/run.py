"""Recovery of points from a line cloud: choose a method, run it in the working frame, convert to scene units."""

from __future__ import annotations

import hashlib
import json
import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from l2p.attacks.apart import Attacked, described, parts_for, together
from l2p.attacks.attack import Attack, Elements, Estimate, locate
from l2p.attacks.by_scheme import by_own_attack, recover_own
from l2p.attacks.named import named_attack
from l2p.attacks.settings import DEFAULT_METHOD, MethodName
from l2p.attacks.structure import Structure
from l2p.attacks.structured import expanded, frame_of, likelier_places, structure_of
from l2p.errors import InputError
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.io.given_map import GivenMap, given_map
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.schemes.recognition import FALSE_PLACES, UNIFORM, Recognition, recognise
from l2p.version import __version__
from l2p.work.memory import allotted
from l2p.work.progress import NO_PROGRESS, Progress
from l2p.work.shards import Shards
from l2p.work.work import ALONE, Work

#: Bytes that each number published beside a line takes at most, by counting copies in single precision: in the order of
#: the map, sorted, normalised, and two of those that a lesson learns from.
_NUMBER_BYTES = 20


def recover(
    lines: GivenMap,
    method: MethodName | str | Attack = DEFAULT_METHOD,
    *,
    device: str = "cpu",
    memory: float | None = None,
    progress: Progress = NO_PROGRESS,
    **settings: Any,
) -> Recovery:
    """Recover the points behind a line cloud, or of a map of planes or permuted points.

    Parameters
    ----------
    lines : LineCloud, PlaneCloud, PermutedCloud or path
        The map, or the path of its file. Planes, permuted points and sphere clouds (lines of scheme ``sphere``,
        ``sphere-50``, ...) have attacks of their own (:mod:`l2p.attacks.by_scheme`), which are used if no method is
        named; they have no settings here.
    method : str or Attack
        ``learned``: tomography, then rounds of a network that weighs the votes (:mod:`l2p.attacks.learned.learned`).
        ``tomography``: expectation maximisation on a sparse grid, then the votes around its modes
        (:mod:`l2p.attacks.tomography.reconstruct`). ``heuristic``: the attack of Chelani et al. (CVPR 2021). A user's
        own method: ``package.module:Attack``, or an :class:`l2p.attacks.attack.Attack`.
    device : str
        A torch device.
    memory : float, optional
        GiB that the attack may use beyond the present memory of the process; default: four fifths of the free memory.
        Work is done in blocks that fit; the result does not depend on it. On a GPU, memory is unlimited unless given.
    progress : Progress
        Display of the progress.
    **settings
        Settings of the method; omitted ones, or None, have their defaults (:mod:`l2p.attacks.settings`):

        - ``checkpoint`` (path): weights for ``learned``, as ``python -m train`` writes them.
        - ``rounds`` (int): rounds of refinement. ``learned`` has as many as its checkpoint was trained for; 0 returns
          the modes of the tomography, or the coarse stage of the heuristic.
        - ``fraction`` (float): fraction of the map's points in the line cloud, in (0, 1]. ``heuristic`` chooses its
          neighbour counts by it; the confidence of ``learned`` is that of lying within 1 spacing of the map, which is
          smaller than the spacing of the points behind the lines.
        - ``scene_kind`` (str): ``indoor`` or ``outdoor``, for the heuristic's table of neighbours.

    Returns
    -------
    Recovery
        Points in the order of the lines. Its confidence is a probability (``calibrated``) only for uniform lines, as
        far as the lines can tell; ``info["recognised"]`` says what they were recognised as
        (:mod:`l2p.schemes.recognition`).

    Raises
    ------
    FileNotFoundError
        If there is no such file or checkpoint.
    InputError
        If it is no hidden map, the line cloud is empty, the method or the device is unknown, the method has no such
        setting or it is out of range, the checkpoint cannot be used, or the lines do not fit into the memory.

    Examples
    --------
    >>> import numpy as np, l2p
    >>> points = np.random.default_rng(1).normal(size=(200, 3))
    >>> l2p.recover(l2p.lift(points, seed=0), method="tomography").confidence.shape
    (200,)
    """
    work, lines = Work(progress=progress), given_map(lines)
    if by_own_attack(lines, method, settings):
        return recover_own(lines, progress)
    lines = lines_of(lines)
    if isinstance(method, Attack):
        if settings:
            raise InputError(f"got {', '.join(settings)} beside an attack; expected its settings in the attack itself")
        return run(lines, method, device=device, memory=memory, work=work)
    return run(lines, named_attack(method, **settings), device=device, memory=memory, work=work, name=method)


def lines_of(hidden: object) -> LineCloud:
    """Return a map of lines, and refuse a map that is not of lines for an attack on lines."""
    if not isinstance(hidden, LineCloud):
        raise InputError(
            f"got a {type(hidden).__name__} for an attack on lines; expected a LineCloud, or leave out the method and "
            "its settings to use the attack on such maps"
        )
    return hidden


def run(
    lines: LineCloud,
    attack: Attack,
    *,
    device: str = "cpu",
    memory: float | None = None,
    work: Work = ALONE,
    name: str = "",
) -> Recovery:
    """Run any attack, also a bound or a user's own, on a line cloud.

    With several processes in ``work.shards``, rank 0 calls this function and the other ranks :func:`assist`. The run
    continues from the last round in ``work.journal``. ``memory`` (GiB per process) limits attacks that declare their
    ``line_bytes``.
    """
    if len(lines) == 0:
        raise InputError("got a line cloud without lines; expected at least one line")
    where, began = usable_device(device), time.perf_counter()
    # Told early, before lines are looked at, if they cannot fit.
    _room(attack, where, memory, len(lines), lines.appearance.width, work)
    recognised = recognise(lines)
    known = recognised.scheme if recognised.scheme in attack.schemes else UNIFORM
    # A line with a false place is a pair of points, of which one is not wanted.
    one_of_two, known = known == FALSE_PLACES, "ppl" if known == FALSE_PLACES else known
    parts = None if one_of_two else parts_for(lines, attack, known, recognised)
    if parts is None:
        found = _attacked(lines, attack, known, recognised, where, memory, work, name)
    else:
        # Other processes and the journal serve the largest part, the others are small or few.
        works = [work, *(Work(progress=work.progress) for _ in parts[1:])]
        each = [
            _attacked(lines.rows(part), attack, known, recognised, where, memory, own, name)
            for part, own in zip(parts, works, strict=True)
        ]
        found = together(each, parts, attack.for_scheme(known))
    attack, estimate = attack.for_scheme(known), found.estimate
    info = {
        "method": name or type(attack).__name__,
        "settings": attack.settings(),
        "used": list(attack.uses(lines.appearance)),
        "recognised": recognised.as_dict(),
        "device": str(where),
        "seconds": time.perf_counter() - began,
        **({} if parts is None else {"parts": described(lines, parts)}),
    }
    recovery = Recovery(
        xyz=found.xyz,
        confidence=estimate.confidence.float().cpu().numpy(),
        beta=found.beta,
        rgb=found.rgb,
        neighbors=estimate.neighbors.cpu().numpy().astype(np.int64),
        affinity=estimate.affinity.float().cpu().numpy(),
        info=info,
        # The calibration on uniform lines says nothing about others; those on pairs and rays are off by more than 0.05
        # on some maps (docs/results-schemes.md), so that their confidence only ranks.
        calibrated=attack.calibrated and recognised.expected and attack.scheme == UNIFORM,
        element=found.line,
    )
    return likelier_places(recovery) if one_of_two else recovery


def _attacked(
    lines: LineCloud,
    attack: Attack,
    known: str,
    recognised: Recognition,
    where: torch.device,
    memory: float | None,
    work: Work,
    name: str,
) -> Attacked:
    """Attack lines, all of a map or those of a part, as lines of the scheme ``known``."""
    single, line = expanded(lines, known)
    work = replace(work, room=_room(attack, where, memory, len(single), single.appearance.width, work))
    work.shards.check(len(single))
    work.journal.begin(_about(single, attack, name))
    frame = frame_of(lines, known, recognised)
    with torch.inference_mode():
        structure = structure_of(single, known, recognised, frame, where)
        elements = Elements.sorted(frame.enter(single, where), frame, single.appearance, structure)
        _check_same(work.shards, attack, where)
        attack = attack.for_scheme(known)
        _send(elements, known, work.shards)
        estimate = _in_map_order(_collected(locate(attack, elements, work), len(elements), work), elements.row)
    own = np.arange(len(single)) if estimate.element is None else estimate.element.cpu().numpy()
    placed = single if estimate.element is None else single.rows(own)
    beta = frame.leave(placed, estimate.beta)
    return Attacked(placed.at(beta), beta, line[own], placed.rgb, estimate)


def assist(attack: Attack, shards: Shards, *, device: str = "cpu", memory: float | None = None) -> None:
    """Do the part of this rank, other than 0, in the :func:`run` of rank 0.

    Raises
    ------
    InputError
        If this rank has another attack, other settings, another checkpoint or another version of l2p than rank 0.
    """
    where, work = usable_device(device), Work(shards)
    with torch.inference_mode():
        _check_same(shards, attack, where)
        elements, known = _received(shards, where)
        attack = attack.for_scheme(known)
        numbers = sum(value.shape[1] for value in elements.attributes.values() if isinstance(value, Tensor))
        work = replace(work, room=_room(attack, where, memory, len(elements), numbers, work))
        _collected(locate(attack, elements, work), len(elements), work)


def _collected(estimate: Estimate, count: int, work: Work) -> Estimate:
    """Collect the estimates of all ranks on rank 0; ``element`` counts all lines."""
    if estimate.element is None:
        logits = None if estimate.logits is None else work.shards.collect(estimate.logits, count)
        return Estimate(*(work.shards.collect(column, count) for column in estimate[:4]), logits=logits)
    if work.shards.processes > 1:
        raise InputError(
            "got an attack that places several points on a line, or none; expected one process for it, so leave out "
            "--processes"
        )
    return estimate


def _in_map_order(estimate: Estimate, row: Int[Tensor, " lines"]) -> Estimate:
    """Sort estimates into the order of the map; ``row`` is the row of each line in it."""
    line = row if estimate.element is None else row[estimate.element]
    order = line.argsort(stable=True)
    near = estimate.neighbors[order]
    named = row[near.clamp_min(0).long()].to(near.dtype).masked_fill(near < 0, -1)
    element = None if estimate.element is None else line[order]
    logits = None if estimate.logits is None else estimate.logits[order]
    return Estimate(estimate.beta[order], estimate.confidence[order], named, estimate.affinity[order], element, logits)


def line_bytes_of(attack: Attack, numbers: int, processes: int = 1) -> float | None:
    """Bytes that a process holds per line of its own, with ``numbers`` published beside each; None: not bounded.

    Each process has the numbers of every line.
    """
    return None if attack.line_bytes is None else attack.line_bytes + processes * _NUMBER_BYTES * numbers


def _room(
    attack: Attack, where: torch.device, memory: float | None, lines: int, numbers: int, work: Work
) -> int | None:
    """Bytes for the blocks of this process; None for no limit."""
    line_bytes, processes = line_bytes_of(attack, numbers, work.shards.processes), work.shards.processes
    if line_bytes is None or (memory is None and where.type != "cpu"):
        return None
    return allotted(memory, math.ceil(lines / processes), line_bytes)


def _about(lines: LineCloud, attack: Attack, name: str) -> dict[str, Any]:
    """Identity of a run, for its journal: the same for the same lines, method, settings and version."""
    digest = hashlib.sha256(lines.direction.tobytes() + lines.moment.tobytes())
    for attribute in lines.appearance.names:
        digest.update(attribute.encode() + getattr(lines, attribute).tobytes())
    return {
        "lines": digest.hexdigest(),
        "method": name or type(attack).__name__,
        "settings": attack.settings(),
        "l2p": __version__,
    }


def _check_same(shards: Shards, attack: Attack, where: torch.device) -> None:
    """Refuse a rank whose attack, settings or version differ from those of rank 0."""
    same = json.dumps([__version__, type(attack).__name__, attack.settings()], sort_keys=True)
    own = torch.frombuffer(bytearray(hashlib.sha256(same.encode()).digest()), dtype=torch.uint8).to(where)
    if not torch.equal(shards.first(own.clone()), own):
        raise InputError(
            f"process {shards.rank} has another method, other settings, another checkpoint or another version of l2p "
            "than the first; start all with the same words"
        )


def _send(elements: Elements, scheme: str, shards: Shards) -> None:
    """Send the lines of rank 0 to the other ranks, equal to the bit, and the scheme that they are attacked as."""
    if shards.processes == 1:
        return
    shapes = {name: list(value.shape[1:]) for name, value in elements.attributes.items()}
    relations = {name: value for name, value in elements.structure._asdict().items() if value is not None}
    header = {
        "lines": len(elements),
        "frame": elements.frame.as_dict(),
        "attributes": shapes,
        "kind": elements.descriptor_kind,
        "scheme": scheme,
        "structure": {name: list(value.shape) for name, value in relations.items()},
    }
    shards.first_json(header, elements.row.device)
    for tensor in (*elements.lines, elements.row, *elements.attributes.values(), *relations.values()):
        shards.first(tensor)


def _received(shards: Shards, where: torch.device) -> tuple[Elements, str]:
    """Receive the lines of rank 0, and their scheme."""
    header = shards.first_json(None, where)
    count = header["lines"]
    direction, moment = (shards.first(torch.empty(count, 3, device=where)) for _ in range(2))
    row = shards.first(torch.empty(count, dtype=torch.int64, device=where))
    attributes = {
        name: shards.first(torch.empty(count, *shape, device=where)) for name, shape in header["attributes"].items()
    }
    relations = {
        name: torch.empty(shape, device=where, dtype=torch.float32 if name == "center" else torch.int64)
        for name, shape in header["structure"].items()
    }
    structure = Structure(**{name: shards.first(value) for name, value in relations.items()})
    frame = Frame.from_dict(header["frame"])
    return Elements(Lines(direction, moment), row, frame, attributes, header["kind"], structure), header["scheme"]


def usable_device(name: str | torch.device) -> torch.device:
    """Return the torch device of this name; InputError if this machine does not have it."""
    name = str(name)
    available = ["cpu"]
    if torch.cuda.is_available():
        available += ["cuda", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if torch.backends.mps.is_available():
        available.append("mps")
    if name not in available:
        raise InputError(f"got device {name!r}; expected one of {', '.join(available)}")
    return torch.device(name)
