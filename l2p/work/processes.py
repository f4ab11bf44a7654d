"""Several processes (ranks) for one attack, started by ``torchrun`` or :func:`launch`.

If one rank fails, all stop, and exactly one prints why: the rank with the user's error or, if a rank died, one of the
others.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from types import FrameType
from typing import Any, NamedTuple, NoReturn

from l2p.errors import InputError, LostProcessError
from l2p.work.launched import among_others
from l2p.work.shards import Processes, Shards

#: Timeout of a rank that waits for the others; far longer than their differences in speed.
PATIENCE = timedelta(minutes=30)
#: Exit code of a rank that has lost another.
LOST = 1
#: Environment variable set by :func:`launch` for its ranks; it reports lost ranks and Ctrl-C itself.
_LAUNCHED = "L2P_LAUNCHED"
#: Store key claimed by the rank that prints the error.
_REPORTED = "l2p/told"
#: Seconds for ranks to end by themselves after one has failed, and then after a signal.
_GRACE, _MORE_GRACE = 3.0, 10.0
_POLL = 0.05


class Place(NamedTuple):
    """Shards and device of a rank."""

    shards: Shards
    device: str


@contextmanager
def joined(device: str) -> Iterator[Place]:
    """Join the ranks that were started together, until the block ends; a single process gets ``ALONE``.

    Raises
    ------
    InputError
        If several ranks cannot use the device, or cannot connect.

    Notes
    -----
    If the block fails and another rank prints the error, the process ends at once with code ``LOST``.
    """
    if not among_others():
        yield Place(Shards(), device)
        return
    import torch
    from torch import distributed
    from torch.distributed.rendezvous import rendezvous

    own = _own_device(device)
    try:
        if own.startswith("cuda") and torch.cuda.is_available():
            torch.cuda.set_device(own)
        store, rank, count = next(rendezvous("env://", timeout=PATIENCE))
        backend = "nccl" if own.startswith("cuda") else "gloo"
        distributed.init_process_group(backend, store=store, rank=rank, world_size=count, timeout=PATIENCE)
    except (ValueError, RuntimeError) as error:
        said = f"the processes did not find each other ({_first_line(error)}); start them with torchrun"
        raise _refusal(said) from error
    shards = Processes(distributed)
    before = signal.signal(signal.SIGTERM, _on_sigterm)
    try:
        yield Place(shards, own)
    except BaseException as error:
        # The launcher must not end this rank before it has printed the error.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if not _is_reporter(error, store, shards):
            _leave(LOST)
        raise
    signal.signal(signal.SIGTERM, before)
    distributed.destroy_process_group()


def _own_device(device: str) -> str:
    """Device of this rank: on ``cuda``, the GPU of its local rank."""
    if device == "cuda":
        return f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
    if device != "cpu":
        raise _refusal(f"got device {device!r} for several processes; expected cpu, or cuda for a GPU each")
    return device


def _refusal(said: str) -> InputError:
    """Make an error that all ranks meet before the group exists; only rank 0 reports it, the others end here."""
    if os.environ.get("RANK", "0") != "0":
        _leave(LOST)
    return InputError(said)


def _on_sigterm(*_: int | FrameType | None) -> NoReturn:
    raise LostProcessError(
        "the processes were told to end, or one of them has died; start again with --resume to go on from the last "
        "finished round"
    )


def _is_reporter(error: BaseException, store: Any, shards: Shards) -> bool:
    """Return whether this rank prints the error."""
    if isinstance(error, (LostProcessError, KeyboardInterrupt)) and os.environ.get(_LAUNCHED):
        return False
    try:
        return store.add(_REPORTED, 1) == 1
    except RuntimeError:  # the rank that held the store has died
        return shards.rank <= 1 or not isinstance(error, LostProcessError)


def _leave(code: int) -> NoReturn:
    """End at once, without joining threads, which may wait forever for a lost rank."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def launch(words: Sequence[str], processes: int) -> int:
    """Run ``l2p`` with these arguments in several processes on this machine; return the exit code.

    Raises
    ------
    LostProcessError
        If one of them was ended by a signal.
    """
    environment = {
        "OMP_NUM_THREADS": str(max(1, len(os.sched_getaffinity(0)) // processes)),
        **os.environ,
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(_free_port()),
        "WORLD_SIZE": str(processes),
        _LAUNCHED: "1",
    }
    started: list[subprocess.Popen[bytes]] = []
    before = signal.signal(signal.SIGTERM, _terminated)
    try:
        for rank in range(processes):
            own = {**environment, "RANK": str(rank), "LOCAL_RANK": str(rank)}
            started.append(subprocess.Popen([sys.executable, "-m", "l2p", *words], env=own))
        while all(process.poll() in (None, 0) for process in started):
            if all(process.poll() == 0 for process in started):
                return 0
            time.sleep(_POLL)
        _wait(started, _GRACE)
        codes = [process.poll() for process in started]
    finally:
        _end(started)
        signal.signal(signal.SIGTERM, before)
    return _outcome(codes)


def _outcome(codes: list[int | None]) -> int:
    """Exit code of all ranks: the largest one; LostProcessError if one was ended by a signal."""
    for rank, code in enumerate(codes):
        if code is not None and code < 0:
            raise LostProcessError(
                f"process {rank} of {len(codes)} was ended by {signal.Signals(-code).name}; start again with "
                "--resume to go on from the last finished round"
            )
    return max(code for code in codes if code)


def _terminated(*_: int | FrameType | None) -> NoReturn:
    raise SystemExit(128 + signal.SIGTERM)


def _wait(started: list[subprocess.Popen[bytes]], seconds: float) -> None:
    until = time.monotonic() + seconds
    while any(process.poll() is None for process in started) and time.monotonic() < until:
        time.sleep(_POLL)


def _end(started: list[subprocess.Popen[bytes]]) -> None:
    """Terminate the processes that still run, and kill those that do not end."""
    for stop in (subprocess.Popen.terminate, subprocess.Popen.kill):
        for process in started:
            if process.poll() is None:
                with suppress(ProcessLookupError):
                    stop(process)
        _wait(started, _MORE_GRACE)


def _free_port() -> int:
    with socket.socket() as place:
        place.bind(("127.0.0.1", 0))
        return place.getsockname()[1]
