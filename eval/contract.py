"""What a contender is: a method with its parameters, and what it sees of a map besides the lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from l2p.attacks.attack import Attack
from l2p.attacks.learned.learned import Learned
from l2p.attacks.run import run
from l2p.errors import InputError
from l2p.maps.appearance import ATTRIBUTES, Appearance
from l2p.maps.recovery import Recovery
from l2p.schemes.scheme import SCHEMES

#: Schemes of lines that do not all meet in one point; other maps have attacks of their own.
LINE_SCHEMES = tuple(name for name in SCHEMES if not name.startswith(("planes", "permuted", "sphere")))


@dataclass(frozen=True, eq=False)
class Trial:
    """Hidden map to attack, with the attributes that the method sees. Only references may use ``truth``, (points, 3) in
    the order of the lines; of pairs, in the order of their appearances."""

    key: str
    lines: Any
    truth: Float[np.ndarray, "lines 3"]
    kind: str
    fraction: float
    seed: int
    device: str


@runtime_checkable
class Contender(Protocol):
    """Method with its parameters."""

    #: Whether it is a reference, which uses the truth, rather than an attack.
    knows_truth: ClassVar[bool]
    #: Whether the duration of ``recover`` is the running time of the method.
    timed: ClassVar[bool]

    @property
    def label(self) -> str:
        """Name in tables; unique in a run."""
        ...

    @property
    def sees(self) -> tuple[str, ...]:
        """Attributes published beside the lines that it is given, some of ``ATTRIBUTES``; () for lines alone."""
        ...

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return the attributes of a map that it uses when it is given all of them."""
        ...

    def serves(self, scheme: str) -> bool:
        """Whether it can be run on maps that are hidden by this scheme."""
        ...

    def files(self, cloud: str) -> dict[str, str]:
        """Return digests of the files read for the line cloud of that name: the prediction depends on them, too."""
        ...

    def recover(self, trial: Trial) -> Recovery:
        """Recover the points."""
        ...


@dataclass(frozen=True)
class Peer:
    """Method that is built for a trial and run by :func:`l2p.attacks.run.run`."""

    label: str = ""
    sees: tuple[str, ...] = ()
    knows_truth: ClassVar[bool] = False
    timed: ClassVar[bool] = True

    def build(self, trial: Trial) -> Attack:
        """Build the method for this trial."""
        raise NotImplementedError

    def uses(self, appearance: Appearance) -> tuple[str, ...]:
        """Return nothing: it uses lines alone."""
        return ()

    def serves(self, scheme: str) -> bool:
        """Return whether the map is a line cloud."""
        return scheme in LINE_SCHEMES

    def files(self, cloud: str) -> dict[str, str]:
        """Return no digests: it reads no files."""
        return {}

    def recover(self, trial: Trial) -> Recovery:
        """Build, then run."""
        return run(trial.lines, self.build(trial), device=trial.device, name=self.label)


def settle_sight(contender: Any, label: str) -> None:
    """Check ``sees`` and put it in order; if the contender has no label, it gets this one with what it sees."""
    given = contender.sees
    known = isinstance(given, list | tuple) and all(name in ATTRIBUTES for name in given)
    if not known or len(set(given)) < len(given):
        names = ", ".join(ATTRIBUTES)
        raise InputError(f"got sees {given!r} for {contender.label or label}; expected a list of some of {names}")
    object.__setattr__(contender, "sees", tuple(name for name in ATTRIBUTES if name in given))
    if not contender.label:
        object.__setattr__(contender, "label", " + ".join((label, *contender.sees)))


def check_sight(contender: Contender, attack: Attack | None = None) -> None:
    """Refuse a contender that sees something by an attack that uses lines alone; without an attack, any that does."""
    if not contender.sees:
        return
    got = f"got sees {list(contender.sees)} for {contender.label}"
    if isinstance(attack, Learned):
        if not attack.network.config.appearance:
            file = attack.source.get("checkpoint", "its network")
            raise InputError(f"{got}, but {file} uses lines alone; give a checkpoint with the input likeness")
    elif attack is None or type(attack).uses is Attack.uses:
        raise InputError(f"{got}, which uses lines alone; leave it out")
