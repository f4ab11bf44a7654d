"""The attacks on hidden maps that no attack on lines of random direction can recover, chosen by the map."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from l2p.attacks.from_permuted import recover_permuted
from l2p.attacks.from_planes import recover_planes
from l2p.attacks.from_spheres import recover_spheres
from l2p.attacks.settings import DEFAULT_METHOD
from l2p.maps.lines import LineCloud
from l2p.maps.permuted import PermutedCloud
from l2p.maps.planes import PlaneCloud
from l2p.maps.recovery import Recovery
from l2p.schemes.recognition import recognise
from l2p.work.progress import NO_PROGRESS, Progress


def has_own_attack(hidden: LineCloud | PlaneCloud | PermutedCloud) -> bool:
    """Whether the map is of planes, permuted points, or lines through one centre."""
    return not isinstance(hidden, LineCloud) or (len(hidden) > 0 and recognise(hidden).scheme == "sphere")


def by_own_attack(hidden: LineCloud | PlaneCloud | PermutedCloud, method: object, settings: Collection[str]) -> bool:
    """Whether a map is recovered by an attack of its own: no other method and none of its settings was asked for."""
    return method == DEFAULT_METHOD and not {*settings} - {"fraction"} and has_own_attack(hidden)


def recover_own(hidden: LineCloud | PlaneCloud | PermutedCloud, progress: Progress = NO_PROGRESS) -> Recovery:
    """Recover a map of planes, permuted points or lines through one centre; all compute on the CPU."""
    if isinstance(hidden, PlaneCloud):
        return recover_planes(hidden, progress=progress)
    if isinstance(hidden, PermutedCloud):
        return recover_permuted(hidden, progress=progress)
    found = recover_spheres(hidden, progress=progress)
    return replace(found, info={**found.info, "recognised": recognise(hidden).as_dict()})
