"""Record the steps from line to line that some modules take: an input that adds steps is worth keeping for a fuzzer.

Plain ``sys.settrace``, limited to the files of interest; everything else runs at full speed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from types import CodeType, FrameType, ModuleType
from typing import Any

#: A code object, and the numbers of a line and of the line that came before it.
Step = tuple[CodeType, int, int]


class Steps:
    """Keeps the steps that were ever taken inside ``with`` blocks; ``fresh`` are those that the last block added."""

    def __init__(self, modules: Iterable[ModuleType]) -> None:
        self.files = {module.__file__ for module in modules}
        self.known: set[Step] = set()
        self.fresh = 0

    def __enter__(self) -> Steps:
        self.fresh = len(self.known)
        sys.settrace(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)
        self.fresh = len(self.known) - self.fresh

    def _called(self, frame: FrameType, event: str, argument: Any) -> Callable[..., Any] | None:
        if frame.f_code.co_filename not in self.files:
            return None
        code, known, before = frame.f_code, self.known, 0

        def moved(frame: FrameType, event: str, argument: Any) -> Callable[..., Any]:
            nonlocal before
            if event == "line":
                known.add((code, before, frame.f_lineno))
                before = frame.f_lineno
            return moved

        return moved
