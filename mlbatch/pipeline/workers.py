"""Threads that share a sequence of tasks; ordered stages run in the order of the tasks.

Threads, not processes: arrays are shared, nothing is read twice, and the expensive parts (numpy,
checksums, compression, writing) release the interpreter lock.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Generic, Protocol, TypeVar

from mlbatch.pipeline.interrupts import Uninterrupted


class StagedTask(Protocol):
    """A task in four stages, each run once, in this order."""

    def decode(self) -> None:
        """Any thread, at any time."""
        ...

    def append(self) -> None:
        """In order: after this stage of all earlier tasks."""
        ...

    def compress(self) -> None:
        """Any thread, at any time."""
        ...

    def commit(self) -> None:
        """In order: after this stage of all earlier tasks."""
        ...


Task = TypeVar("Task", bound=StagedTask)
# Ordered stages of a task.
_ORDERED = 2


def run_inline(task: StagedTask) -> None:
    """Run all stages of a task in this thread."""
    task.decode()
    task.append()
    task.compress()
    task.commit()


class _Stopped(Exception):
    """An earlier task failed."""


class OrderedWorkers(Generic[Task]):
    """Runs tasks in threads; the first error, in the order of the tasks, is raised here.

    After an error no later task commits, nor appends if the error occurred before its append.
    """

    def __init__(self, threads: int, ahead: int) -> None:
        """ahead: number of tasks that may be unfinished when `put` returns."""
        self._ahead = ahead
        self._waiting: deque[tuple[int, Task]] = deque()
        self._given = 0
        # Tasks that have done each ordered stage.
        self._past = [0] * _ORDERED
        self._error: BaseException | None = None
        self._is_closed = False
        self._changed = threading.Condition()
        # Daemons, so that a second interrupt ends the process even if a disk hangs.
        self._threads = [
            threading.Thread(target=self._run, name=f"mlbatch-{number}", daemon=True)
            for number in range(threads)
        ]

    def put(self, task: Task) -> None:
        """Append a task; waits while too many are unfinished; raises the error of one."""
        with Uninterrupted(), self._changed:
            self._waiting.append((self._given, task))
            self._given += 1
            self._changed.notify_all()
            self._wait(lambda: self._given - self._past[-1] <= self._ahead)
        self._raise_error()

    def finish(self) -> None:
        """Wait until all tasks are done; raises the error of one."""
        with Uninterrupted(), self._changed:
            self._wait(lambda: self._given == self._past[-1])
        self._raise_error()

    def __enter__(self) -> OrderedWorkers[Task]:
        """Start the threads."""
        try:
            with Uninterrupted():
                for thread in self._threads:
                    thread.start()
        except KeyboardInterrupt:
            self._end()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        """End all threads, also after an error; the error of an earlier task is raised first."""
        with Uninterrupted():
            self._end()
        if error is not self._error:
            self._raise_error()

    def _end(self) -> None:
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

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _wait(self, is_due: Callable[[], bool]) -> None:
        """Wait, with the lock held, for a condition or an error."""
        self._changed.wait_for(lambda: self._error is not None or is_due())

    def _run(self) -> None:
        """Body of a thread."""
        while (found := self._next()) is not None:
            number, task = found
            try:
                task.decode()
                self._in_order(0, number, task.append)
                task.compress()
                self._in_order(1, number, task.commit)
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

    def _in_order(self, ordered: int, number: int, stage: Callable[[], None]) -> None:
        """Run an ordered stage of a task once all earlier tasks have done theirs."""
        with self._changed:
            self._wait(lambda: self._past[ordered] == number)
            if self._error is not None:
                raise _Stopped
        stage()
        with self._changed:
            self._past[ordered] += 1
            self._changed.notify_all()

    def _fail(self, number: int, error: BaseException) -> None:
        """Stop all, once earlier tasks are done: one of them may fail as well."""
        with self._changed:
            self._wait(lambda: self._past[-1] == number)
            if self._error is None:
                self._error = error
            self._waiting.clear()
            self._changed.notify_all()
