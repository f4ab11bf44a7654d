"""Attacks built from a name and settings."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from l2p.attacks.attack import Attack
from l2p.attacks.settings import ATTACKS, checked_settings
from l2p.errors import InputError


def named_attack(name: str, **settings: Any) -> Attack:
    """Build an attack of l2p by its name, or a user's own by ``package.module:Attack``.

    Parameters
    ----------
    name : str
    settings
        Settings of the attack (:mod:`l2p.attacks.settings`) or of the user's class; None is the default.

    Raises
    ------
    FileNotFoundError
        If there is no such checkpoint.
    InputError
        If the name is unknown, the attack has no such setting, or a setting is out of range.
    """
    given = checked_settings(name, settings)
    if ":" in name:
        return _users_own(name, given)
    row = ATTACKS[name]
    return pkgutil.resolve_name(row.build)(row.settings(**given))


def imported(path: str) -> Callable[..., Any]:
    """Import ``package.module:callable``, also from the working folder.

    Raises
    ------
    InputError
        If it cannot be imported or is not callable.
    """
    module, _, name = path.partition(":")
    if str(Path.cwd()) not in sys.path and "" not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        target = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"got path {path!r}; expected package.module:callable, but {error}") from error
    if not callable(target):
        raise InputError(f"got path {path!r}, which is a {type(target).__name__}; expected a callable")
    return target


def _users_own(path: str, settings: dict[str, Any]) -> Attack:
    try:
        attack = imported(path)(**settings)
    except TypeError as error:
        raise InputError(f"got settings {settings} for {path}: {error}") from error
    if not isinstance(attack, Attack):
        raise InputError(f"got path {path!r}, which gives a {type(attack).__name__}; expected an Attack")
    return attack
