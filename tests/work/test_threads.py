"""Blocks on several threads: the same answer in the same order, whatever happens in a block."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
import torch

from l2p.work.memory import fitting
from l2p.work.threads import even_size, over_blocks


@pytest.fixture(params=[1, 2, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize(("count", "size"), [(0, 4), (3, 4), (4, 4), (17, 4), (17, 1)])
def test_every_row_is_worked_on_once_and_in_order(threads: int, count: int, size: int) -> None:
    found = list(over_blocks(lambda block, _: torch.arange(count)[block], count, size))
    assert torch.equal(torch.cat([torch.zeros(0).long(), *(part for _, part in found)]), torch.arange(count))
    assert [(block.start, block.stop) for block, _ in found] == [
        (begin, min(begin + size, count)) for begin in range(0, count, size)
    ]


def test_a_slow_first_block_is_still_the_first(threads: int) -> None:
    def work(block: slice, _: int | None) -> int:
        time.sleep(0.05 if block.start == 0 else 0)
        return block.start

    assert [start for _, start in over_blocks(work, 5, 1)] == [0, 1, 2, 3, 4]


def test_torch_has_one_thread_in_a_block_and_its_own_again_afterwards(threads: int) -> None:
    seen = [part for _, part in over_blocks(lambda *_: (torch.get_num_threads(), threading.get_ident()), 8, 1)]
    assert {count for count, _ in seen} == {1}
    assert (threading.get_ident() in {ident for _, ident in seen}) == (threads == 1)
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad, torch.enable_grad])
def test_blocks_run_in_the_mode_of_the_caller(threads: int, mode: type) -> None:
    with mode():
        expected = torch.is_inference_mode_enabled(), torch.is_grad_enabled()
        modes = {
            part
            for _, part in over_blocks(lambda *_: (torch.is_inference_mode_enabled(), torch.is_grad_enabled()), 6, 1)
        }
    assert modes == {expected}


def test_an_error_in_a_block_is_raised_and_ends_the_work(threads: int) -> None:
    begun = []

    def work(block: slice, _: int | None) -> None:
        begun.append(block.start)
        time.sleep(0.01)
        if block.start == 2:
            raise RuntimeError("of block 2")

    with pytest.raises(RuntimeError, match="of block 2"):
        list(over_blocks(work, 100, 1))
    assert len(begun) < 50
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("count", [0, 1, 2, 5, 999, 1000, 1001, 6001])
def test_every_thread_has_as_many_blocks(threads: int, count: int) -> None:
    size = even_size(count, 1000)
    assert 1 <= size <= 1000
    blocks = -(-count // size)
    # Less only where there are not so many rows.
    assert blocks % threads == 0 or count < threads * threads
    assert blocks <= max(threads, count // 1000 + threads)


@pytest.mark.parametrize("row_bytes", [0, 3])
def test_blocks_share_the_room(threads: int, row_bytes: int) -> None:
    """Of 100 bytes, though they run in threads of their own."""
    blocks = over_blocks(lambda _, room: fitting(10**6, 1, room), 20, 10, row_bytes=row_bytes, room=100)
    seen = {part for _, part in blocks}
    assert seen == {100 // min(threads, 100 // (10 * row_bytes or 1))}
    assert all(part == 10**6 for _, part in over_blocks(lambda _, room: fitting(10**6, 1, room), 20, 10))
