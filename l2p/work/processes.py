"""Several processes for one attack: brought together, as ``torchrun`` or :func:`launch` starts them, and ended as one.

Whatever ends one of them ends all, with one message: of the user's error from the process that met it, of a process
that died from one of those that are left.
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
from l2p.work.shards import Processes, Shards

#: How long a process waits for the others: far longer than they are apart in their work.
PATIENCE = timedelta(minutes=30)
#: Exit code of a process that has lost another.
LOST = 1
#: Set for the processes that :func:`launch` starts, which itself tells of lost processes and of Ctrl-C.
_LAUNCHED = "L2P_LAUNCHED"
#: What the first process that tells why all end puts down at the store of the processes.
_TOLD = "l2p/told"
#: Seconds that processes have to end by themselves when one has failed, and then after being told to.
_GRACE, _MORE_GRACE = 3.0, 10.0
_POLL = 0.05


class Place(NamedTuple):
    """What a process works with: the others, and its device."""

    shards: Shards
    device: str


def among_others() -> bool:
    """Whether this process was started as one of several."""
    count = os.environ.get("WORLD_SIZE", "")
    return count.isdecimal() and int(count) > 1


@contextmanager
def joined(device: str) -> Iterator[Place]:
    """The processes that were started together, until the block ends; without others, this one alone.

    Raises
    ------
    InputError
        If several processes cannot use the device, or do not find each other.
    SystemExit
        In place of an error of the block, if another process has told why all end.
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
    before = signal.signal(signal.SIGTERM, _told_to_end)
    try:
        yield Place(shards, own)
    except BaseException as error:
        # Until it has told why, it is not to be ended by the launcher, which has noticed, too.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if not _speaks(error, store, shards):
            _leave(LOST)
        raise
    signal.signal(signal.SIGTERM, before)
    distributed.destroy_process_group()


def _own_device(device: str) -> str:
    """Each process of a machine takes a GPU of its own."""
    if device == "cuda":
        return f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
    if device != "cpu":
        raise _refusal(f"got device {device!r} for several processes; expected cpu, or cuda for a GPU each")
    return device


def _refusal(said: str) -> InputError:
    """What all processes meet before they know each other, told by the first."""
    if os.environ.get("RANK", "0") != "0":
        _leave(LOST)
    return InputError(said)


def _told_to_end(*_: int | FrameType | None) -> NoReturn:
    raise LostProcessError(
        "the processes were told to end, or one of them has died; start again with --resume to go on from the last "
        "finished round"
    )


def _speaks(error: BaseException, store: Any, shards: Shards) -> bool:
    """Whether it falls to this process to tell why all end."""
    if isinstance(error, (LostProcessError, KeyboardInterrupt)) and os.environ.get(_LAUNCHED):
        return False
    try:
        return store.add(_TOLD, 1) == 1
    except RuntimeError:  # the process that kept the store is the one that died
        return shards.rank <= 1 or not isinstance(error, LostProcessError)


def _leave(code: int) -> NoReturn:
    """End at once: what waits for the lost process in other threads cannot be waited for."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def launch(words: Sequence[str], processes: int) -> int:
    """Run ``l2p`` with these words in several processes of this machine; gives the exit code.

    Raises
    ------
    LostProcessError
        If one of them was killed.
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
    """The exit code of all; a signal tells most, then the user's error."""
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
    """Tell those that still run to end, and see to it that they do."""
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
