"""Attackers: each sees the lines and uses some of the attributes that are published beside them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from l2p.attacks.attack import Attack
from l2p.maps.appearance import ATTRIBUTES, Appearance

#: Names of the attributes that an attacker uses, in the order of ``ATTRIBUTES``; empty: he sees lines alone.
Attacker = tuple[str, ...]

#: Attributes in words.
WORDS = {"rgb": "colours", "descriptor": "descriptors"}


def attackers_of(attack: Attack, appearance: Appearance) -> tuple[Attacker, ...]:
    """List the attackers that differ in what they use, from the one who uses most to the one who sees lines alone.

    Parameters
    ----------
    attack : Attack
        Decides which of the published attributes are used.
    appearance : Appearance
        All published attributes.
    """
    names = appearance.names[::-1]
    found = []
    for size in range(len(names), -1, -1):
        for some in combinations(names, size):
            used = attack.uses(appearance.without(others(some)))
            found.append(tuple(name for name in ATTRIBUTES if name in some and name in used))
    return tuple(dict.fromkeys(found))


def others(some: Sequence[str]) -> Attacker:
    """List the attributes that are not among ``some``."""
    return tuple(name for name in ATTRIBUTES if name not in some)


def seen_by(attacker: Attacker) -> str:
    """List what an attacker sees.

    >>> seen_by(()), seen_by(("rgb", "descriptor"))
    ('lines', 'lines + colours + descriptors')
    """
    return " + ".join(("lines", *(WORDS[name] for name in attacker)))


def named(attributes: Sequence[str]) -> str:
    """Name attributes in a sentence.

    >>> named(["rgb", "descriptor"])
    'colours and descriptors'
    """
    return " and ".join(WORDS[name] for name in attributes)
