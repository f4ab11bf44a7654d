"""Inputs of the network, one file per family; a new one is a file and a row of :data:`INPUTS`."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from l2p.attacks.learned.inputs.family import Inputs
from l2p.errors import InputError

#: Module and class of each family. Checkpoints name their families, so a name must not change its meaning.
INPUTS: dict[str, str] = {
    "position": "l2p.attacks.learned.inputs.position:Position",
    "scale": "l2p.attacks.learned.inputs.scale:Scale",
    "distance": "l2p.attacks.learned.inputs.distance:Distance",
    "angle": "l2p.attacks.learned.inputs.angle:Angle",
    "tomography": "l2p.attacks.learned.inputs.tomography:TomographicMass",
    "confidence": "l2p.attacks.learned.inputs.confidence:Confidence",
    "surface": "l2p.attacks.learned.inputs.surface:NearSurface",
    "wide_surface": "l2p.attacks.learned.inputs.surface:WideSurface",
    "likeness": "l2p.attacks.learned.inputs.likeness:Likeness",
}
#: Families of a network that sees lines alone.
GEOMETRY = ("position", "scale", "distance", "angle", "tomography", "confidence", "surface", "wide_surface")


def inputs_of(names: Sequence[str], constants: Mapping[str, Mapping[str, Any]] | None = None) -> tuple[Inputs, ...]:
    """Build families by their names, with their default constants or those of a checkpoint.

    Raises
    ------
    InputError
        If a name is unknown or given twice, the constants are not those of the family, or no family votes.
    """
    built = tuple(_built(name, None if constants is None else constants[name]) for name in names)
    if len(set(names)) < len(names):
        raise InputError(f"got inputs {', '.join(names)}; expected each of them once")
    if not any(family.votes for family in built):
        raise InputError(f"got inputs {', '.join(names)}, none of which votes; expected position or a surface, too")
    return built


def _built(name: str, constants: Mapping[str, Any] | None) -> Inputs:
    if name not in INPUTS:
        raise InputError(f"got input {name!r} of a network; expected some of {', '.join(INPUTS)}")
    family = pkgutil.resolve_name(INPUTS[name])
    if constants is None:
        return family()
    known = {entry.name for entry in fields(family)}
    if set(constants) != known or not all(type(value) in (int, float) for value in constants.values()):
        raise InputError(f"got constants {dict(constants)} of input {name}; expected numbers for {sorted(known)}")
    return family(**constants)
