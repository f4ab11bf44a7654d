"""Errors that the command line reports in one sentence."""

from __future__ import annotations

import warnings


class InputError(ValueError):
    """Input that cannot be used; the message names what came, what was expected and what to do."""


class InputWarning(UserWarning):
    """Input that is used otherwise than it was given, or in part; the message says how. ``l2p`` prints it once."""


class LostProcessError(RuntimeError):
    """Another process of the same run has ended before the work was done."""


def warn(message: str) -> None:
    """Issue an :class:`InputWarning` of one sentence."""
    warnings.warn(" ".join(message.split()), InputWarning, stacklevel=3)


def sentence(error: Exception) -> str:
    """Message of an error in one line; that of an OSError without its number."""
    message = str(error)
    if isinstance(error, OSError) and error.strerror is not None:
        reason = error.strerror.lower()
        message = reason if error.filename is None else f"{error.filename}: {reason}"
    return " ".join(message.split())
