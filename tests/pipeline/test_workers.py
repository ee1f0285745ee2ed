"""Threads that share a sequence of tasks: order, how far they run ahead, errors."""

from __future__ import annotations

import random
import threading
import time
from dataclasses import dataclass

import pytest

from mlbatch.pipeline.workers import OrderedWorkers, run_inline

PARTS = 4


class Work:
    """Notes which part of which task was done, in the order in which that was."""

    def __init__(self, fails: tuple[tuple[int, int], ...] = (), seed: int = 0) -> None:
        self.done: list[tuple[int, int]] = []
        self._fails = fails
        self._pauses_s = random.Random(seed)
        self._lock = threading.Lock()

    def do(self, task: int, part: int) -> None:
        """Do a part of a task, or fail in it."""
        time.sleep(self._pauses_s.random() * 1e-3)
        if (task, part) in self._fails:
            raise OSError(f"task {task}")
        with self._lock:
            self.done.append((task, part))

    def of(self, part: int) -> list[int]:
        """Tasks whose part was done, in this order."""
        return [task for task, own in self.done if own == part]


@dataclass(frozen=True, slots=True)
class Task:
    """A task whose stages are parts 0 to 3 of a work."""

    work: Work
    number: int

    def decode(self) -> None:
        self.work.do(self.number, 0)

    def append(self) -> None:
        self.work.do(self.number, 1)

    def compress(self) -> None:
        self.work.do(self.number, 2)

    def commit(self) -> None:
        self.work.do(self.number, 3)


def run(work: Work, tasks: int, threads: int, ahead: int) -> None:
    with OrderedWorkers[Task](threads, ahead) as workers:
        for task in range(tasks):
            workers.put(Task(work, task))
        workers.finish()


def give(work: Work, tasks: int, then: Exception) -> None:
    with OrderedWorkers[Task](2, 4) as workers:
        for task in range(tasks):
            workers.put(Task(work, task))
        raise then


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("seed", range(3))
def test_parts_in_turn_are_done_in_the_order_of_tasks(threads: int, seed: int) -> None:
    work = Work(seed=seed)
    run(work, 40, threads, ahead=6)
    assert work.of(1) == work.of(3) == list(range(40))
    assert sorted(work.of(0)) == sorted(work.of(2)) == list(range(40))
    for task in range(40):
        assert [part for own, part in work.done if own == task] == list(range(PARTS))


@pytest.mark.parametrize("ahead", [0, 1, 4])
def test_no_more_tasks_are_unfinished_than_allowed(ahead: int) -> None:
    work = Work()
    with OrderedWorkers[Task](3, ahead) as workers:
        for task in range(30):
            workers.put(Task(work, task))
            assert task + 1 - len(work.of(3)) <= ahead


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("threads", [1, 4])
def test_later_tasks_do_no_part_in_turn_from_the_one_that_failed_on(
    part: int, threads: int
) -> None:
    work = Work(fails=((7, part),))
    with pytest.raises(OSError, match="task 7"):
        run(work, 40, threads, ahead=10)
    assert work.of(3) == list(range(7))
    assert {own for task, own in work.done if task > 7} <= ({0} if part < 2 else {0, 1, 2})


def test_the_error_of_the_earliest_task_is_raised() -> None:
    # The later one is there first: it fails at once, the other in its last part.
    for seed in range(10):
        work = Work(fails=((3, 3), (4, 0)), seed=seed)
        with pytest.raises(OSError, match="task 3"):
            run(work, 8, 4, ahead=8)


def test_an_error_of_a_task_goes_before_that_of_who_gives_tasks() -> None:
    work = Work(fails=((0, 1),))
    with pytest.raises(OSError, match="task 0"):
        give(work, 1, then=ValueError("later"))


def test_who_gives_tasks_may_fail_alone() -> None:
    work = Work()
    with pytest.raises(ValueError, match="alone"):
        give(work, 2, then=ValueError("alone"))
    assert work.of(3) == [0, 1]


def test_no_thread_is_left() -> None:
    before = threading.active_count()
    for fails in ((), ((2, 0),), ((2, 3),)):
        work = Work(fails=fails)
        try:
            run(work, 5, 3, ahead=3)
        except OSError:
            assert fails
        assert threading.active_count() == before


def test_alone_all_parts_are_done_at_once() -> None:
    work = Work()
    run_inline(Task(work, 5))
    assert work.done == [(5, part) for part in range(PARTS)]
