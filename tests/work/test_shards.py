"""Several processes that share the lines: threads that stand in for them find the points of one, to the last bit."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest
import torch
from tiny import learned, seeing

import l2p
from l2p.attacks import run as attack
from l2p.attacks.attack import Attack, Elements, Estimate
from l2p.attacks.heuristic import Heuristic, HeuristicConfig
from l2p.attacks.tomographic import Tomography
from l2p.errors import InputError, LostProcessError
from l2p.geometry.elements import Lines
from l2p.geometry.frame import Frame
from l2p.geometry.nearest import MANY, nearest_lines_to_lines, nearest_lines_to_points, nearest_points_to_lines
from l2p.judging.references import CandidateOracle, LeaveOneOut, Oracle
from l2p.maps.lines import LineCloud
from l2p.maps.recovery import Recovery
from l2p.work.journal import Journal, Saved
from l2p.work.shards import BLOCK, Processes, Shards
from l2p.work.work import Work

Found = TypeVar("Found")

METHODS: dict[str, Callable[[], Attack]] = {
    "learned": lambda: learned(rounds=2),
    "learned, no rounds": lambda: learned(rounds=0),
    "learned, of a tenth": lambda: learned(rounds=1, fraction=0.1),
    "learned, with appearance": seeing,
    "learned, other descriptors": lambda: seeing("orb"),
    "tomography": Tomography,
    "heuristic": lambda: Heuristic(HeuristicConfig(rounds=2)),
}


class Meeting:
    """What ``torch.distributed`` does, for threads."""

    def __init__(self, count: int) -> None:
        self.barrier = threading.Barrier(count, timeout=60)
        self.given: list[Any] = [None] * count

    def seat(self, rank: int) -> SimpleNamespace:
        """What one thread takes for ``torch.distributed``."""

        def exchange(mine: Any) -> list[Any]:
            self.given[rank] = mine
            self.barrier.wait()
            all_of_them = list(self.given)
            self.barrier.wait()
            return all_of_them

        def all_gather(places: list[torch.Tensor], part: torch.Tensor) -> None:
            for place, given in zip(places, exchange(part), strict=True):
                place.copy_(given)

        def gather(part: torch.Tensor, places: list[torch.Tensor] | None) -> None:
            for place, given in zip(places or (), exchange(part), strict=False):
                place.copy_(given)

        def all_reduce(whole: torch.Tensor, op: str = "sum") -> None:
            parts = torch.stack(exchange(whole.clone()))
            whole.copy_(parts.sum(dim=0) if op == "sum" else parts.amax(dim=0))

        def broadcast(whole: torch.Tensor, source: int) -> None:
            whole.copy_(exchange(whole.clone())[source])

        return SimpleNamespace(
            get_rank=lambda: rank,
            get_world_size=lambda: len(self.given),
            ReduceOp=SimpleNamespace(MAX="max"),
            all_gather=all_gather,
            gather=gather,
            all_reduce=all_reduce,
            broadcast=broadcast,
        )


def in_processes(count: int, work: Callable[[Shards], Found]) -> list[Found]:
    """What ``work`` gives in each of several threads that stand in for processes; or the error of one."""
    meeting = Meeting(count)

    def seated(rank: int) -> Found:
        try:
            return work(Processes(meeting.seat(rank)))
        except BaseException:
            meeting.barrier.abort()
            raise

    with ThreadPoolExecutor(count) as pool:
        running = [pool.submit(seated, rank) for rank in range(count)]
    for error in [each.exception() for each in running]:
        if error is not None and not isinstance(error, LostProcessError):
            raise error
    return [each.result() for each in running]


def recovered(lines: LineCloud, method: Attack, shards: Shards) -> Recovery | None:
    if shards.rank == 0:
        return attack.run(lines, method, work=Work(shards))
    return attack.assist(method, shards)


@pytest.fixture(scope="module")
def lines(on_walls: Callable[[int], np.ndarray]) -> LineCloud:
    points, rng = on_walls(6 * BLOCK + 32), np.random.default_rng(0)
    descriptor = rng.integers(0, 120, (len(points), 128), dtype=np.uint8)
    rgb = rng.integers(0, 256, points.shape, dtype=np.uint8)
    return l2p.lift(points, seed=0, rgb=rgb, descriptor=descriptor, descriptor_kind="sift")


@pytest.fixture(scope="module")
def alone(lines: LineCloud) -> dict[str, Recovery]:
    return {name: attack.run(lines, method()) for name, method in METHODS.items()}


# An attack


@pytest.mark.parametrize("count", [2, 7])
@pytest.mark.parametrize("name", METHODS)
def test_several_processes_find_what_one_finds(
    lines: LineCloud, alone: dict[str, Recovery], name: str, count: int
) -> None:
    """800 lines are 7 blocks, the last one smaller."""
    # Made beforehand: weights are drawn from the one generator that threads share.
    methods = [METHODS[name]() for _ in range(count)]
    first, *others = in_processes(count, lambda shards: recovered(lines, methods[shards.rank], shards))
    assert others == [None] * (count - 1)
    assert first is not None
    for part in ("xyz", "confidence", "neighbors", "affinity"):
        np.testing.assert_array_equal(getattr(first, part), getattr(alone[name], part), err_msg=part)


def test_too_few_lines_to_go_round_are_refused(lines: LineCloud) -> None:
    few = LineCloud(lines.direction[: 2 * BLOCK + 1], lines.moment[: 2 * BLOCK + 1])
    message = f"got 4 processes for {2 * BLOCK + 1} lines; expected at most 3, since each takes whole"
    with pytest.raises(InputError, match=message):
        in_processes(4, lambda shards: recovered(few, Tomography(), shards))


def test_a_process_with_other_settings_is_refused(lines: LineCloud) -> None:
    methods = METHODS["learned"](), METHODS["learned, no rounds"]()

    def work(shards: Shards) -> object:
        return recovered(lines, methods[shards.rank], shards)

    with pytest.raises(InputError, match="process 1 has another method, other settings, another checkpoint or another"):
        in_processes(2, work)


class Wandering(Attack):
    """A user's own: estimates move a step along their line every round; all that it knows of processes is ``work``."""

    rounds = 3
    columns: Mapping[str, tuple[int, ...]] = {"beta": ()}

    def begin(self, elements: Elements, saved: Mapping[str, torch.Tensor] | None, work: Work) -> SimpleNamespace:
        beta = elements.lines.moment[:, 0] if saved is None else saved["beta"]
        return SimpleNamespace(lines=elements.lines, beta=beta)

    def step(self, state: SimpleNamespace, work: Work) -> SimpleNamespace:
        own = state.beta[work.own(len(state.beta))]
        return SimpleNamespace(lines=state.lines, beta=work.gather(own + state.beta.median(), len(state.beta)))

    def finish(self, state: SimpleNamespace, work: Work) -> Estimate:
        beta = state.beta[work.own(len(state.beta))]
        nobody = beta.new_zeros(len(beta), 0)
        return Estimate(beta, torch.ones_like(beta), nobody.int(), nobody)


class Memory(Journal):
    """A journal in memory, which a run can be interrupted at and continued from."""

    def __init__(self, interrupt: int | None = None, saved: Saved | None = None) -> None:
        self.interrupt, self.saved = interrupt, saved

    def last(self) -> Saved | None:
        return self.saved

    def save(self, saved: Saved) -> None:
        self.saved = saved
        if saved.rounds == self.interrupt:
            raise KeyboardInterrupt


REFERENCES: dict[str, Callable[[np.ndarray], Attack]] = {
    "a user's own": lambda points: Wandering(),
    "oracle": lambda points: Oracle(points, 20, 0.3),
    "candidate oracle": lambda points: CandidateOracle(points, Tomography(), 20, 40),
    "leave-one-out": LeaveOneOut,
}


@pytest.mark.parametrize("name", REFERENCES)
def test_references_and_users_own_attacks_are_shared_and_resumed_alike(
    name: str, on_walls: Callable[[int], np.ndarray]
) -> None:
    points = on_walls(3 * BLOCK + 32)
    hidden = l2p.hide(points, seed=0)
    lines = hidden.map
    attacks = [REFERENCES[name](hidden.truth.xyz) for _ in range(3)]
    whole = attack.run(lines, attacks[0])
    shared, _ = in_processes(2, lambda shards: recovered(lines, attacks[shards.rank], shards))
    assert shared is not None
    np.testing.assert_array_equal(shared.xyz, whole.xyz)
    np.testing.assert_array_equal(shared.neighbors, whole.neighbors)
    if name in ("a user's own", "candidate oracle"):
        journal = Memory(interrupt=1)
        with pytest.raises(KeyboardInterrupt):
            attack.run(lines, attacks[2], work=Work(journal=journal))
        again = attack.run(lines, attacks[2], work=Work(journal=Memory(saved=journal.saved)))
        np.testing.assert_array_equal(again.xyz, whole.xyz)


def test_a_lost_process_is_an_error_of_the_others() -> None:
    def work(shards: Shards) -> str:
        if shards.rank == 1:
            raise ZeroDivisionError
        with pytest.raises(LostProcessError, match=r"process \d of 3 has lost another one; start again with --resume"):
            shards.sum(torch.ones(3, dtype=torch.int64))
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        in_processes(3, work)


# What it is made of


@pytest.mark.parametrize(("rows", "count"), [(1, 1), (2 * BLOCK, 2), (8 * BLOCK - 24, 3), (15 * BLOCK + 40, 16)])
def test_every_line_belongs_to_one_process(rows: int, count: int) -> None:
    part = torch.arange(3 * rows).view(rows, 3)

    def work(shards: Shards) -> tuple[int, torch.Tensor, torch.Tensor]:
        shards.check(rows)
        own = part[shards.own(rows)]
        return len(own), shards.gather(own, rows), shards.collect(own, rows)

    sizes, gathered, collected = zip(*in_processes(count, work), strict=True)
    assert sum(sizes) == rows and min(sizes) > 0 and not any(size % BLOCK for size in sizes[:-1])
    assert all(torch.equal(whole, part) for whole in gathered)
    assert torch.equal(collected[0], part) and not any(len(rest) for rest in collected[1:])


def test_what_a_process_sends_is_counted() -> None:
    rows = BLOCK + 36

    def work(shards: Shards) -> int:
        shards.sum(torch.ones(10, dtype=torch.int64))
        shards.gather(torch.ones(len(range(rows)[shards.own(rows)]), 2), rows)
        shards.first(torch.ones(5, dtype=torch.float64))
        return shards.sent

    assert in_processes(2, work) == [80 + BLOCK * 8 + 40, 80 + 36 * 8]
    assert Shards().sent == 0


@pytest.mark.parametrize("search", ["lines to lines", "points to lines", "lines to points"])
@pytest.mark.parametrize("size", [500, MANY + 100])
def test_searches_find_the_neighbors_of_own_lines(
    on_walls: Callable[[int], np.ndarray], search: str, size: int
) -> None:
    """Below and above the number of points from which on there is a tree."""
    cloud = l2p.lift(on_walls(size), seed=0)
    frame = Frame.of(cloud)
    lines: Lines = frame.enter(cloud)
    points = frame.enter_points(on_walls(size))
    find = {
        "lines to lines": lambda shards: nearest_lines_to_lines(lines, 9, work=Work(shards)),
        "points to lines": lambda shards: nearest_points_to_lines(lines, points, 9, work=Work(shards)),
        "lines to points": lambda shards: nearest_lines_to_points(points, lines, 9, work=Work(shards)),
    }[search]
    whole = find(Shards())
    parts = in_processes(3, find)
    assert torch.equal(torch.cat([part.index for part in parts]), whole.index)
    assert torch.equal(torch.cat([part.distance for part in parts]), whole.distance)
