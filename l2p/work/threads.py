"""Blocks of lines on all cores: each block on one thread, several blocks at a time.

Torch's own threads share every single operation, and wait for each other after it. Blocks that fit the cache are far
too small for that: on a busy machine, or with ``OMP_WAIT_POLICY=PASSIVE``, two such threads are slower than one
(``benchmarks/kernels.py``). Independent blocks need not wait for each other.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

from l2p.work.memory import fitting

#: Queue depth per thread: blocks begun or finished but not yet consumed, so that no thread is idle.
_AHEAD = 2

Result = TypeVar("Result")


def even_size(count: int, most: int) -> int:
    """Size of blocks, at most ``most`` rows, such that each of torch's threads has the same number of blocks."""
    threads = torch.get_num_threads()
    return max(1, math.ceil(count / (threads * math.ceil(max(1, count) / (threads * most)))))


def over_blocks(
    function: Callable[[slice, int | None], Result],
    count: int,
    size: int,
    device: torch.device | None = None,
    row_bytes: float = 0,
    room: int | None = None,
) -> Iterator[tuple[slice, Result]]:
    """Apply ``function(block, room)`` to blocks of ``size`` of the ``count`` rows; yield results in order.

    As many blocks run at a time as torch has threads, or fewer if the room is too small for their temporaries
    (``row_bytes`` per row); one at a time on a GPU. Meanwhile torch has one thread, and each block an equal part of the
    room. The results do not depend on the number of threads.

    Raises
    ------
    Exception
        Any error of ``function``; no block is begun after it.
    """
    size = fitting(size, row_bytes, room)
    blocks = [slice(begin, min(begin + size, count)) for begin in range(0, count, size)]
    threads = torch.get_num_threads()
    if threads == 1 or len(blocks) < 2 or (device is not None and device.type != "cpu"):
        yield from ((block, function(block, room)) for block in blocks)
        return
    workers = fitting(threads, size * row_bytes, room)
    share = None if room is None else room // workers
    # These modes are per thread: the workers copy them.
    inference, gradients = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

    def worked(block: slice) -> Result:
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients):
            return function(block, share)

    pool = ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,))
    torch.set_num_threads(1)
    begun: deque[tuple[slice, Future[Result]]] = deque()
    try:
        for block in blocks:
            begun.append((block, pool.submit(worked, block)))
            if len(begun) > _AHEAD * workers:
                yield _ended(begun)
        while begun:
            yield _ended(begun)
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads)


def _ended(begun: deque[tuple[slice, Future[Result]]]) -> tuple[slice, Result]:
    block, future = begun.popleft()
    return block, future.result()
