"""Jobs run one after the other, or in child processes, which end whenever this process ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

import torch

from l2p.errors import InputError

Job = TypeVar("Job")

#: Seconds before a process that should end is killed.
PATIENCE = 5.0


@dataclass(frozen=True)
class Failure:
    """Reason why a job failed: a sentence, and a traceback if the error is not the user's."""

    sentence: str
    place: str = ""


def attempt(work: Callable[[Job], None], job: Job) -> Failure | None:
    """Do the job; return a failure rather than raise it, since the other jobs continue."""
    try:
        work(job)
    except (InputError, FileNotFoundError) as error:
        return Failure(str(error))
    except Exception as error:  # a user's method may raise anything
        return Failure(f"{type(error).__name__}: {error}", traceback.format_exc())
    return None


def outcomes(
    work: Callable[[Job], None], jobs: Sequence[Job], processes: int, threads: int
) -> Generator[tuple[Job, Failure | None], None, None]:
    """Do the jobs, in this process if one is enough; yield each with its failure or None, as they end.

    Parameters
    ----------
    work
        Function at module level, since child processes import it by name.
    processes
        Most processes at a time.
    threads
        Torch's threads per process.

    Notes
    -----
    Close the iterator (``contextlib.closing``), so that the processes end if it is left early.
    """
    processes = min(processes, len(jobs))
    if processes <= 1:
        for job in jobs:
            yield job, attempt(work, job)
        return
    waiting, busy = deque(jobs), dict[Connection, _Worker[Job]]()
    try:
        while waiting or busy:
            while waiting and len(busy) < processes:
                worker = _Worker(work, threads)
                busy[worker.pipe] = worker
                worker.give(waiting.popleft())
            for worker in [busy[pipe] for pipe in wait(list(busy))]:  # type: ignore[index]
                job, failure = worker.outcome()
                if worker.alive and waiting:
                    worker.give(waiting.popleft())
                else:
                    busy.pop(worker.pipe).end()
                yield job, failure
    finally:
        for worker in busy.values():
            worker.process.terminate()
        for worker in busy.values():
            worker.end()


class _Worker(Generic[Job]):
    """Process that does one job at a time."""

    def __init__(self, work: Callable[[Job], None], threads: int) -> None:
        # Spawn, not fork: torch's threads do not survive a fork.
        context = multiprocessing.get_context("spawn")
        self.pipe, child = context.Pipe()
        self.process = context.Process(target=_serve, args=(child, work, threads))
        with _interrupts_held():
            self.process.start()
        child.close()
        self.alive = True
        self._job: Any = None

    def give(self, job: Job) -> None:
        """Begin a job."""
        self._job = job
        with suppress(OSError):  # ``outcome`` reports a process that has died
            self.pipe.send(job)

    def outcome(self) -> tuple[Job, Failure | None]:
        """Return the job and its failure, or None; also if the process has died."""
        try:
            return self._job, self.pipe.recv()
        except (EOFError, OSError):
            self.alive = False
            self.process.join(PATIENCE)
            code = self.process.exitcode
            killed = ", perhaps for want of memory; try fewer processes" if code == -signal.SIGKILL else ""
            return self._job, Failure(f"its process ended with exit code {code}{killed}")

    def end(self) -> None:
        """Let the process end, and kill it if it does not."""
        self.pipe.close()
        self.process.join(PATIENCE)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _serve(pipe: Connection, work: Callable[[Any], None], threads: int) -> None:
    """Loop of a worker: do one job after the other until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the parent, which ends this process
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(attempt(work, job))


def _end_with_parent() -> None:
    """End at once when the parent has ended, even in the middle of a job."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Mask SIGINT in the block; a process started in it inherits the mask, so Ctrl-C does not interrupt its start."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
