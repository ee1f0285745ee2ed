"""Threads that share a sequence of tasks, as the scans of a run; some stages run in their order.

Threads, not processes: arrays are shared, nothing is read twice, and the expensive parts (numpy,
checksums, compression, writing) release the interpreter lock.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.decode_pool import Decoded, DecodeTask, DecodeWorker
from mlbatch.pipeline.interrupts import Uninterrupted
from mlbatch.types import ImuSamples, Message
from mlbatch.writers.base import FilesWriter, ScanJob, ScanWriter

if TYPE_CHECKING:
    from mlbatch.pipeline.files import Files, FinishedScan


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
            self._wait(partial(self._is_next, ordered, number))
            if self._error is not None:
                raise _Stopped
        stage()
        with self._changed:
            self._past[ordered] += 1
            self._changed.notify_all()

    def _is_next(self, ordered: int, number: int) -> bool:
        return self._past[ordered] == number

    def _fail(self, number: int, error: BaseException) -> None:
        """Stop all, once earlier tasks are done: one of them may fail as well."""
        with self._changed:
            self._wait(lambda: self._past[-1] == number)
            if self._error is None:
                self._error = error
            self._waiting.clear()
            self._changed.notify_all()


# -- scans ----------------------------------------------------------------------------------------


class ScanTask:
    """A scan from its raw columns into the output."""

    def __init__(
        self,
        run: Conversion,
        task: DecodeTask | None,
        before: Sequence[ImuSamples | Message],
        writers: Sequence[ScanWriter],
        idle: list[DecodeWorker],
        files: Files | None,
        *,
        kept: FinishedScan | None,
        index: int | None,
    ) -> None:
        """task: None where messages are to be written without a scan; before: what to write first.

        writers: none in a dry run; idle: decode workers not in use;
        files: of the output, None in a dry run; kept: the scan, if it is in a file of another
        run; index: of its window, None where no scan follows the messages.
        """
        self._run = run
        self._task = task
        self._before = before
        self._writers = writers
        self._idle = idle
        self._files = files
        self._kept = kept
        self._index = index
        self._worker: DecodeWorker | None = None
        self._decoded: Decoded | None = None
        self._decode_s = 0.0
        self._write_s = 0.0
        # That of the scans comes first, and has the checksum.
        self._jobs = [ScanJob()]

    def decode_with(self, worker: DecodeWorker) -> None:
        """Decode in this thread, so that only writing is left for others."""
        if self._task is None:
            return
        began_s = time.perf_counter()
        counts_points = self._files is not None and self._files.is_journaled
        self._decoded = worker.decode(self._task, counts_points=counts_points)
        self._decode_s += time.perf_counter() - began_s

    def decode(self) -> None:
        """Raw columns to points, points to the bytes of the output. Any thread."""
        if self._decoded is None and self._task is not None:
            self._worker = self._idle.pop()
            self.decode_with(self._worker)
        if self._writers:
            self._jobs = [self._writer_job(writer) for writer in self._writers]
        self._timed(lambda job: job.pack())

    def append(self) -> None:
        """Count the scan, write what precedes it, reserve its place in the output. In order."""
        if self._decoded is not None:
            scan = self._decoded.scan
            checksum = self._jobs[0].checksum if self._kept is None else self._kept.checksum
            is_listed = self._files is None or self._files.is_listed(scan)
            self._run.account(scan, checksum, is_listed)
        if self._index is not None:
            for job in self._jobs:
                job.start(self._index)
        for item in self._before:
            forward(item, self._writers)
        self._timed(lambda job: job.append())

    def compress(self) -> None:
        """Compress what is complete. Any thread."""
        self._timed(lambda job: job.compress())

    def commit(self) -> None:
        """Write what is complete; note the scan for its file. In order."""
        if self._task is not None and self._decoded is not None and self._files is not None:
            scan, outcomes = self._decoded
            if self._kept is None:
                self._files.note(scan, self._task.only, outcomes, self._jobs[0].checksum)
        self._timed(lambda job: job.commit())
        self._run.stages.write_s += self._write_s
        self._run.stages.decode_s += self._decode_s
        if self._worker is not None:
            # Only now, since its arrays were read until here.
            self._idle.append(self._worker)

    def _writer_job(self, writer: ScanWriter) -> ScanJob:
        if self._task is None or self._decoded is None:
            return writer.flush()
        if self._kept is not None and isinstance(writer, FilesWriter):
            return writer.skip(self._decoded.scan, self._task.only)
        return writer.write(self._decoded.scan, self._task.only)

    def _timed(self, stage: Callable[[ScanJob], None]) -> None:
        began_s = time.perf_counter()
        for job in self._jobs:
            stage(job)
        self._write_s += time.perf_counter() - began_s


def forward(item: ImuSamples | Message, writers: Sequence[ScanWriter]) -> None:
    """Write IMU samples or a message."""
    for writer in writers:
        if isinstance(item, Message):
            writer.write_message(item)
        else:
            writer.write_imu(item)
