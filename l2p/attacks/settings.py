"""Settings of the attacks, each declared once: it becomes a flag of ``l2p recover``, a keyword of ``l2p.recover``, a
key of ``python -m eval`` and an entry of the record. Nothing here loads torch, so that ``l2p --help`` is fast.
"""

from __future__ import annotations

import numbers
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, NamedTuple, TypeAlias

from l2p.errors import InputError

#: Kinds of scenes in the heuristic's table of neighbours.
SCENE_KINDS = ("indoor", "outdoor")


def setting(default: Any, help: str, shown: str = "", **flag: Any) -> Any:
    """Declare a field with its help; ``shown`` describes a default of None, ``flag`` goes to the argument parser."""
    return field(default=default, metadata={"help": help, "shown": shown or str(default), "flag": flag})


@dataclass(frozen=True)
class LearnedSettings:
    """Settings of ``learned``."""

    checkpoint: str | None = setting(
        None, "weights that python -m train wrote", shown="those installed with l2p", metavar="FILE"
    )
    rounds: int | None = setting(
        None, "times that the network judges all lines, at most those of the checkpoint", shown="all", metavar="R"
    )
    fraction: float = setting(
        1.0,
        "fraction of the map's points in the line cloud, in (0, 1]; the confidence is about spacings of the map",
        metavar="F",
    )


@dataclass(frozen=True)
class TomographySettings:
    """Settings of ``tomography``."""

    rounds: int = setting(2, "times that the lines vote; 0 leaves the modes of the density", metavar="R")


@dataclass(frozen=True)
class HeuristicSettings:
    """Settings of ``heuristic``."""

    scene_kind: str = setting("indoor", "row of the paper's table of neighbour counts", choices=SCENE_KINDS)
    fraction: float = setting(
        1.0, "fraction of the map's points in the line cloud, in (0, 1]; it chooses the counts", metavar="F"
    )
    rounds: int = setting(3, "refinements after the coarse stage", metavar="R")


@dataclass(frozen=True)
class PublishedSettings:
    """Settings of ``published``: none."""


class Row(NamedTuple):
    """An attack: its settings, and ``module:function`` that builds it from them."""

    settings: type[Any]
    build: str

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the settings."""
        return tuple(entry.name for entry in fields(self.settings))


#: Attacks by name.
ATTACKS = {
    "learned": Row(LearnedSettings, "l2p.attacks.learned.checkpoint:build"),
    "tomography": Row(TomographySettings, "l2p.attacks.tomographic:build"),
    "heuristic": Row(HeuristicSettings, "l2p.attacks.heuristic:build"),
    "published": Row(PublishedSettings, "l2p.attacks.published:build"),
}
METHODS = tuple(ATTACKS)
#: Their names as a type, for completion in editors; a user's own attack is ``package.module:Attack``.
MethodName: TypeAlias = Literal["learned", "tomography", "heuristic", "published"]
DEFAULT_METHOD = "learned"


def checked_settings(name: object, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of an attack that are not None, of its own types; those of a user's own attack as they are.

    Raises
    ------
    InputError
        If ``name`` is no known attack, or the attack has no such setting, or it is of another type.
    """
    if not isinstance(name, str):
        raise InputError(
            f"got method {name!r}; expected a name ({', '.join(METHODS)}), package.module:Attack, or an Attack"
        )
    values = {key: os.fspath(value) if isinstance(value, os.PathLike) else value for key, value in given.items()}
    values = {key: value for key, value in values.items() if value is not None}
    if ":" in name:
        return values
    if name not in ATTACKS:
        raise InputError(f"got method {name!r}; expected one of {', '.join(METHODS)}, or package.module:Attack")
    for key, value in values.items():
        if key not in ATTACKS[name].names:
            owners = " or ".join(map(repr, owners_of(key)))
            expected = f"it with method {owners} only" if owners else f"some of {', '.join(ATTACKS[name].names)}"
            raise InputError(f"got a {key.replace('_', ' ')} for method {name!r}; expected {expected}")
        values[key] = _typed(name, key, value)
    return values


def _typed(name: str, key: str, value: Any) -> Any:
    """A value as the plain type of its setting; numbers may be NumPy's."""
    entry = next(entry for entry in fields(ATTACKS[name].settings) if entry.name == key)
    kind = str(entry.type).removesuffix(" | None")
    if kind == "str" and isinstance(value, str):
        return value
    # NumPy's numbers register as these.
    if kind == "int" and isinstance(value, numbers.Integral) and not isinstance(value, bool):
        return int(value)
    if kind == "float" and isinstance(value, numbers.Real) and not isinstance(value, bool):
        return float(value)
    expected = {"str": "a text", "int": "a whole number", "float": "a number"}[kind]
    raise InputError(f"got {key.replace('_', ' ')} {value!r} for method {name!r}; expected {expected}")


def owners_of(name: str) -> list[str]:
    """Names of the attacks that have this setting."""
    return [method for method, row in ATTACKS.items() if name in row.names]


def setting_names() -> list[str]:
    """Names of the settings of all attacks, each once."""
    return list(dict.fromkeys(name for row in ATTACKS.values() for name in row.names))
