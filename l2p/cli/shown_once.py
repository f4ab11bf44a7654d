"""Warnings about input on the terminal."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from l2p.errors import InputWarning


@contextmanager
def warnings_shown_once() -> Iterator[None]:
    """Print each different :class:`InputWarning` of the block once on stderr, in one line; others as Python does.

    A command may read its input more than once.
    """
    said: set[str] = set()
    with warnings.catch_warnings():
        show_others = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not issubclass(category, InputWarning):
                show_others(message, category, filename, lineno, file, line)
            elif str(message) not in said:
                said.add(str(message))
                print(f"l2p: {message}", file=sys.stderr)

        warnings.showwarning = show
        warnings.simplefilter("always", InputWarning)
        yield
