"""Settings of the attacks, each declared once: it becomes a flag of ``l2p recover``, a keyword of ``l2p.recover``, a
key of ``python -m eval`` and an entry of the record. Nothing here loads torch, so that ``l2p --help`` is fast.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

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
DEFAULT_METHOD = "learned"


def owners_of(name: str) -> list[str]:
    """Names of the attacks that have this setting."""
    return [method for method, row in ATTACKS.items() if name in row.names]


def setting_names() -> list[str]:
    """Names of the settings of all attacks, each once."""
    return list(dict.fromkeys(name for row in ATTACKS.values() for name in row.names))
