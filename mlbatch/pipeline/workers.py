"""Threads that share one sequence of tasks; what of a task depends on order is done in order.

Threads, and not processes: arrays stay where they are, nothing is read twice, and what takes time
(numpy, checksums, compression, writing) lets other threads run meanwhile.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from types import TracebackType
from typing import Generic, TypeAlias, TypeVar

Task = TypeVar("Task")
# What is done for a task, with a `yield` after each of its parts but the last. The first and third
# are done at any time, the second and fourth in turn: after the same part of all earlier tasks.
Steps: TypeAlias = Iterator[None]
# Parts in turn.
_TURNS = 2


def in_one_go(steps: Steps) -> None:
    """Do all that there is to do for a task, alone."""
    for _ in steps:
        pass


class _Stopped(Exception):
    """An earlier task failed."""


class Workers(Generic[Task]):
    """Runs the steps of tasks; what fails first, in the order of tasks, fails here.

    Then no later task has done its last part, nor its second if that or an earlier one failed.
    """

    def __init__(self, steps: Callable[[Task], Steps], threads: int, ahead: int) -> None:
        """ahead: how many tasks may be unfinished when `put` returns."""
        self._steps = steps
        self._ahead = ahead
        self._waiting: deque[tuple[int, Task]] = deque()
        self._given = 0
        # Tasks that are past each part in turn.
        self._past = [0] * _TURNS
        self._error: BaseException | None = None
        self._is_closed = False
        self._changed = threading.Condition()
        # Daemons, so that a second interrupt ends the process even if a disk hangs.
        self._threads = [
            threading.Thread(target=self._run, name=f"mlbatch-{number}", daemon=True)
            for number in range(threads)
        ]
        for thread in self._threads:
            thread.start()

    def put(self, task: Task) -> None:
        """Append a task; waits while too many are unfinished, raises what failed in one."""
        with self._changed:
            self._waiting.append((self._given, task))
            self._given += 1
            self._changed.notify_all()
            self._wait(lambda: self._given - self._past[-1] <= self._ahead)
        self._refuse()

    def finish(self) -> None:
        """Wait for the end of all tasks; raises what failed in one."""
        with self._changed:
            self._wait(lambda: self._given == self._past[-1])
        self._refuse()

    def __enter__(self) -> Workers[Task]:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        """End all threads, also after an error; what failed in an earlier task is raised first."""
        try:
            with self._changed:
                self._wait(lambda: self._given == self._past[-1])
        finally:
            with self._changed:
                self._is_closed = True
                self._waiting.clear()
                self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        if error is not self._error:
            self._refuse()

    def _refuse(self) -> None:
        if self._error is not None:
            raise self._error

    def _wait(self, is_due: Callable[[], bool]) -> None:
        """Wait, with the lock held, for something to be true or to have failed."""
        self._changed.wait_for(lambda: self._error is not None or is_due())

    def _run(self) -> None:
        """One thread."""
        while (found := self._next()) is not None:
            number, task = found
            try:
                self._work(number, self._steps(task))
            except _Stopped:
                return
            except BaseException as error:
                self._fail(number, error)
                return

    def _next(self) -> tuple[int, Task] | None:
        with self._changed:
            self._wait(lambda: self._is_closed or bool(self._waiting))
            if self._error is not None or not self._waiting:
                return None
            return self._waiting.popleft()

    def _work(self, number: int, steps: Steps) -> None:
        for turn in range(_TURNS):
            next(steps)
            with self._changed:
                self._wait(partial(self._is_turn, turn, number))
                if self._error is not None:
                    raise _Stopped
            next(steps, None)
            with self._changed:
                self._past[turn] += 1
                self._changed.notify_all()

    def _is_turn(self, turn: int, number: int) -> bool:
        """Whether all earlier tasks are past this part."""
        return self._past[turn] == number

    def _fail(self, number: int, error: BaseException) -> None:
        """Stop all, once earlier tasks are through: one of them may fail as well."""
        with self._changed:
            self._wait(lambda: self._past[-1] == number)
            if self._error is None:
                self._error = error
            self._waiting.clear()
            self._changed.notify_all()
