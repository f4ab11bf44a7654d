"""Progress is shown to people only, and silence costs nothing."""

from __future__ import annotations

import io
import sys

import pytest

from l2p.work.progress import NO_PROGRESS, Progress, TerminalProgress, terminal_progress


class Terminal(io.StringIO):
    """A stderr that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_bars_are_for_terminals_only(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert terminal_progress() is NO_PROGRESS
    monkeypatch.setattr(sys, "stderr", Terminal())
    assert isinstance(terminal_progress(), TerminalProgress)


@pytest.mark.parametrize("progress", [NO_PROGRESS, TerminalProgress()])
def test_tasks_nest_and_end(progress: Progress):
    with progress.task("rounds", total=2) as outer:
        for _ in range(2):
            with progress.task("lines", total=100) as inner:
                for _ in range(10):
                    inner(10)
            outer(1)
    with progress.task("again", total=1) as advance:
        advance(1)


def interrupted(progress: Progress) -> None:
    with progress.task("lines", total=10) as advance:
        advance(3)
        raise KeyboardInterrupt


def test_a_failure_ends_the_display(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    progress = TerminalProgress()
    with pytest.raises(KeyboardInterrupt):
        interrupted(progress)
    with progress.task("lines", total=10) as advance:
        advance(10)
    assert "lines" in screen.getvalue()
    assert screen.getvalue().rstrip().endswith("\x1b[2K\x1b[?25h"), "the bar is wiped and the cursor is back"
