"""Blocks of lines on all cores: each block on one thread, several blocks at a time.

Torch's own threads share every single operation, and wait for each other after it. Blocks that fit the cache are far
too small for that: on a busy machine, or with ``OMP_WAIT_POLICY=PASSIVE``, two such threads are slower than one
(``benchmarks/kernels.py``). Blocks that know nothing of each other need not wait.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

from l2p.work.memory import fitting, room, shared

#: Blocks that wait for each thread, done or to be done, so that no thread waits for one.
_AHEAD = 2
#: Threads that can be asked for: OpenMP crashes the process where the system does not give it as many.
MOST_THREADS = 1024

Found = TypeVar("Found")


def even_size(count: int, most: int) -> int:
    """The size of blocks of no more than ``most`` rows that gives each of torch's threads as many of them."""
    threads = torch.get_num_threads()
    return max(1, math.ceil(count / (threads * math.ceil(max(1, count) / (threads * most)))))


def over_blocks(
    work: Callable[[slice], Found], count: int, size: int, device: torch.device | None = None, row_bytes: float = 0
) -> Iterator[tuple[slice, Found]]:
    """What ``work`` makes of each block of ``size`` of ``count`` rows, in order.

    As many blocks at a time as torch has threads, or as there is room for (:mod:`l2p.work.memory`) at ``row_bytes`` of
    temporaries a row; one after the other on a device that is not the CPU. Torch has one thread meanwhile, and each
    block its share of the room. The answer does not depend on the number of threads.

    Raises
    ------
    Exception
        What ``work`` raises; no block is begun after it.
    """
    size = fitting(size, row_bytes)
    blocks = [slice(begin, min(begin + size, count)) for begin in range(0, count, size)]
    threads = torch.get_num_threads()
    if threads == 1 or len(blocks) < 2 or (device is not None and device.type != "cpu"):
        yield from ((block, work(block)) for block in blocks)
        return
    workers = fitting(threads, size * row_bytes)
    # These belong to a thread: the workers take them over.
    inference, gradients, share = torch.is_inference_mode_enabled(), torch.is_grad_enabled(), shared(workers)

    def worked(block: slice) -> Found:
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients), room(share):
            return work(block)

    pool = ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,))
    torch.set_num_threads(1)
    begun: deque[tuple[slice, Future[Found]]] = deque()
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


def _ended(begun: deque[tuple[slice, Future[Found]]]) -> tuple[slice, Found]:
    block, future = begun.popleft()
    return block, future.result()
