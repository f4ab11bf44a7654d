"""Lines of a text file that are taken in order, each with its number for messages."""

from __future__ import annotations

import math
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import Float

from l2p.errors import InputError

#: A line: its number, from 1, and its words.
Line = tuple[int, list[bytes]]


class NumberedLines:
    """Lines that are neither empty nor comments (``#``), from the first to the last."""

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = path
        content = Path(path).read_bytes().removeprefix(b"\xef\xbb\xbf")
        words = ((number, line.split()) for number, line in enumerate(content.split(b"\n"), start=1))
        self._lines = [(number, line) for number, line in words if line and not line[0].startswith(b"#")]
        self._at = 0

    def at_end(self) -> bool:
        """Whether all lines are taken."""
        return self._at == len(self._lines)

    def take(self, count: int, what: str) -> list[Line]:
        """Take the next lines; InputError that ``what`` is missing if there are fewer."""
        if not 0 <= count <= len(self._lines) - self._at:
            raise InputError(
                f"{self.path} is truncated or damaged: it announces {what}, and ends with line "
                f"{self._lines[-1][0] if self._lines else 0}"
            )
        self._at += count
        return self._lines[self._at - count : self._at]

    def counts(self, least: int, what: str) -> list[int]:
        """Take a line of at least so many whole numbers."""
        ((number, words),) = self.take(1, what)
        try:
            found = [int(word) for word in words]
        except ValueError:
            found = []
        if len(found) < least or min(found) < 0:
            raise self.wrong((number, words), what)
        return found

    def numbers(
        self, lines: list[Line], columns: slice, width: int, what: str, finite: bool = True
    ) -> Float[np.ndarray, "lines columns"]:
        """Convert some words of each line; InputError at the first line that lacks them, or has NaN unless it may."""
        rows = []
        for line in lines:
            try:
                row = [float(word) for word in line[1][columns]]
            except ValueError:
                row = []
            if len(row) != width or (finite and not all(map(math.isfinite, row))):
                raise self.wrong(line, what)
            rows.append(row)
        return np.array(rows, dtype=np.float64).reshape(-1, width)

    def wrong(self, line: Line, what: str) -> InputError:
        """The error of a line that is not what it should be."""
        text = b" ".join(line[1])[:200].decode("utf-8", errors="replace")
        shown = repr(text if len(text) <= 60 else f"{text[:57]}...")
        return InputError(f"{self.path} line {line[0]}: got {shown}; expected {what}")
