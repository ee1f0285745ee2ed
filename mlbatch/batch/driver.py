"""All sessions of a batch: skipped ones, threads or Dask workers for the others, results."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue

from mlbatch.batch.record import FAILED, SessionRecord
from mlbatch.batch.task import Stop, Task, finished, run_session
from mlbatch.errors import DiskFullError, Interrupted, MlbatchError, system_error

SKIPPED = "skipped"
# Requests to a store at the same time.
_REQUESTS = 16


@dataclass(frozen=True, slots=True)
class Result:
    """A session at the end of a batch; ran: not skipped."""

    name: str
    record: SessionRecord
    ran: bool

    @property
    def failed(self) -> bool:
        """Whether there is no output, or one beyond limits."""
        return not self.record.is_done

    @property
    def word(self) -> str:
        """State in the last table; failures of earlier runs, too, are failures."""
        if self.failed:
            return FAILED
        return self.record.state if self.ran else SKIPPED


# Called after each session.
Progress = Callable[[Result], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """How to run sessions."""

    workers: int = 1
    fail_fast: bool = False
    retry_failed: bool = False
    scheduler: str = ""  # address of a Dask scheduler; "": threads of this process
    progress: Progress = field(default=lambda result: None)

    def run(self, tasks: Sequence[Task]) -> list[Result]:
        """Run what is missing or changed; the results in the order of the tasks.

        With `fail_fast` sessions that were not begun have no result. Raises Interrupted, and
        DiskFullError: then no other session is begun.
        """
        results: dict[str, Result] = {}
        left = []
        for task, record in zip(tasks, _records(tasks), strict=True):
            if record is None or (self.retry_failed and not record.is_done):
                left.append(task)
                continue
            results[task.session.name] = Result(task.session.name, record, ran=False)
            self.progress(results[task.session.name])
        try:
            with contextlib.closing(self._results(left)) as found:
                for result in found:
                    results[result.name] = result
                    self.progress(result)
        except KeyboardInterrupt as err:
            raise Interrupted(
                f"interrupted; {len(results)} of {len(tasks)} sessions have ended; "
                "the same command continues with the others"
            ) from err
        except DiskFullError as err:
            raise DiskFullError(
                f"{err} ({len(results)} of {len(tasks)} sessions have ended)"
            ) from err
        order = [task.session.name for task in tasks]
        return [results[name] for name in order if name in results]

    def _results(self, tasks: Sequence[Task]) -> Generator[Result, None, None]:
        if not self.scheduler:
            return _by_threads(tasks, self.workers, fail_fast=self.fail_fast)
        from mlbatch.batch.cluster import by_dask

        return by_dask(tasks, self.scheduler, fail_fast=self.fail_fast)


def _records(tasks: Sequence[Task]) -> list[SessionRecord | None]:
    """Records of earlier runs that count."""
    if not any(task.is_remote for task in tasks):
        return list(map(_before, tasks))
    # Requests take their time in the network.
    with ThreadPoolExecutor(_REQUESTS) as pool:
        return list(pool.map(_before, tasks))


def _before(task: Task) -> SessionRecord | None:
    """The record of an earlier run that counts."""
    try:
        return finished(task)
    except MlbatchError:
        # Its run names what is wrong.
        return None


def failure(task: Task, err: Exception) -> Result:
    """The result of a session that could not be run; it is not in its folder."""
    name = task.session.name
    if isinstance(err, OSError):
        err = system_error(err)
    line = str(err) if isinstance(err, MlbatchError) else f"{type(err).__name__}: {err}"
    record = SessionRecord(name, FAILED, 1, line, {}, inputs=[*task.session.inputs])
    return Result(name, record, ran=True)


def _by_threads(
    tasks: Sequence[Task], workers: int, *, fail_fast: bool
) -> Generator[Result, None, None]:
    """Results as they come, of threads that each wait for one process.

    Simple queues, since an interrupt within `threading.Condition` may leave its lock taken.
    """
    stop = Stop()
    closed = threading.Event()
    waiting: SimpleQueue[Task] = SimpleQueue()
    results: SimpleQueue[Result | DiskFullError | None] = SimpleQueue()

    def work() -> None:
        while not closed.is_set() and not waiting.empty():
            try:
                task = waiting.get_nowait()
            except Empty:
                break
            try:
                result = result_of(task, stop)
            except DiskFullError as err:
                closed.set()
                results.put(err)
                break
            if result is not None:
                if fail_fast and result.failed:
                    closed.set()
                results.put(result)
        results.put(None)

    for task in tasks:
        waiting.put(task)
    alive = min(workers, len(tasks))
    threads = [threading.Thread(target=work, daemon=True) for _ in range(alive)]
    try:
        # An interrupt may come while some have begun a session, and others were not started.
        for thread in threads:
            thread.start()
        while alive:
            result = results.get()
            if result is None:
                alive -= 1
                continue
            if isinstance(result, DiskFullError):
                raise result
            yield result
    finally:
        if alive:
            # Sessions end in order: their outputs can be resumed.
            closed.set()
            stop.now()
            # A thread that is not alive yet will find `closed`.
            for thread in threads:
                if thread.is_alive():
                    thread.join()


def result_of(task: Task, stop: Stop) -> Result | None:
    """Run a session; None if it was interrupted. Raises DiskFullError, which ends the others."""
    try:
        return Result(task.session.name, run_session(task, stop), ran=True)
    except Interrupted:
        return None
    except DiskFullError:
        raise
    except Exception as err:
        # One session must not end the others.
        return failure(task, err)
