"""Progress bars, on stderr and only on a terminal; the attacks only call ``advance``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol, runtime_checkable

#: Seconds between two updates of a bar, so that ``advance`` is cheap in tight loops.
REFRESH_SECONDS = 0.1


@runtime_checkable
class Progress(Protocol):
    """Display of the progress of named tasks.

    >>> with NO_PROGRESS.task("nearest lines", total=100) as advance:
    ...     advance(100)
    """

    def task(self, name: str, total: int) -> AbstractContextManager[Callable[[int], None]]:
        """Open a task of ``total`` steps; call the function that it yields with the number of steps just done."""
        ...


class SilentProgress:
    """Progress that is not shown."""

    @contextmanager
    def task(self, name: str, total: int) -> Iterator[Callable[[int], None]]:
        """Open a task that is not shown."""
        yield _ignore


class TerminalProgress:
    """Bars with rate and remaining time on stderr; tasks may be nested, and disappear when done."""

    def __init__(self) -> None:
        self._bars: Any = None
        self._open = 0

    @contextmanager
    def task(self, name: str, total: int) -> Iterator[Callable[[int], None]]:
        """Open a bar of ``total`` steps."""
        if self._bars is None:
            self._bars = _bars()
        if self._open == 0:
            self._bars.start()
        self._open += 1
        bar = _Bar(self._bars, name, total)
        try:
            yield bar.advance
        finally:
            self._bars.remove_task(bar.key)
            self._open -= 1
            if self._open == 0:
                self._bars.stop()


class _Bar:
    """A bar; counts are added up and shown every ``REFRESH_SECONDS``."""

    def __init__(self, bars: Any, name: str, total: int) -> None:
        self._bars = bars
        self.key = bars.add_task(name, total=total)
        self._pending = 0
        self._shown = time.monotonic()

    def advance(self, count: int) -> None:
        self._pending += count
        now = time.monotonic()
        if now - self._shown >= REFRESH_SECONDS:
            self._bars.advance(self.key, self._pending)
            self._pending, self._shown = 0, now


#: Default of the parameter ``progress``.
NO_PROGRESS = SilentProgress()


def terminal_progress() -> Progress:
    """Return bars if stderr is a terminal, otherwise ``NO_PROGRESS``."""
    return TerminalProgress() if sys.stderr.isatty() else NO_PROGRESS


def _ignore(count: int) -> None:
    pass


def _rate(speed: float | None) -> str:
    """Steps per second as text; per minute below 10 per second."""
    if not speed:
        return ""
    return f"{speed:,.0f}/s" if speed >= 10 else f"{60 * speed:,.0f}/min"


def _bars() -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress
    from rich.text import Text

    class RateColumn(ProgressColumn):
        def render(self, task: Any) -> Text:
            return Text(_rate(task.speed), style="progress.data.speed")

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), RateColumn(), TimeRemainingColumn())
    return RichProgress(*columns, console=Console(stderr=True), transient=True)
