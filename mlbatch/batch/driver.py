"""All sessions of a batch: skipped ones, threads or Dask workers for the others, results."""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import shlex
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from mlbatch.batch.record import FAILED, SessionRecord
from mlbatch.batch.status import SessionStatus
from mlbatch.batch.task import Task, finished, run_session
from mlbatch.errors import (
    DiskFullError,
    ExportError,
    Interrupted,
    MlbatchError,
    UsageError,
    install_extra,
    one_line,
    system_error,
)

BATCH_LOG = "batch.log"
# Requests to a store at the same time.
_REQUESTS = 16
_CONNECT_S = 10

# Called after each session.
Progress = Callable[[SessionStatus], None]
# DiskFullError ends all sessions.
Outcome = SessionStatus | DiskFullError
Ended = Callable[[Outcome], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """How to run sessions."""

    workers: int = 1
    fail_fast: bool = False
    retry_failed: bool = False
    log: Path | None = None  # gets a line for each session that begins or ends
    scheduler: str = ""  # address of a Dask scheduler; "": threads of this process
    progress: Progress = field(default=lambda status: None)

    def run(self, tasks: Sequence[Task]) -> list[SessionStatus]:
        """Run what is missing or changed; the sessions in the order of the tasks.

        With `fail_fast` sessions that were not begun are left out. Raises Interrupted, and
        DiskFullError: then no other session is begun.
        """
        found: dict[str, SessionStatus] = {}
        left: deque[Task] = deque()
        for task, record in zip(tasks, _records(tasks), strict=True):
            if record is None or (self.retry_failed and not record.is_done):
                left.append(task)
                continue
            found[task.session.name] = SessionStatus(task.session.name, record, is_earlier=True)
            self.progress(found[task.session.name])
        names = [task.session.name for task in tasks]
        if not left:
            return [found[name] for name in names]
        command = shlex.join(["mlbatch", *sys.argv[1:]])
        self._note(f"{len(tasks)} sessions, {len(left)} to run: {command}")
        try:
            self._run(left, found)
        except KeyboardInterrupt as err:
            self._note("interrupted")
            raise Interrupted(
                f"interrupted; {len(found)} of {len(tasks)} sessions have ended; "
                "the same command continues with the others"
            ) from err
        except DiskFullError as err:
            self._note(f"ended: {err}")
            raise DiskFullError(
                f"{err} ({len(found)} of {len(tasks)} sessions have ended)"
            ) from err
        self._note("ended")
        return [found[name] for name in names if name in found]

    def _note(self, line: str) -> None:
        """Add a line to the log, in one write, since several drivers may share it."""
        if self.log is None:
            return
        now = datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
        text = one_line(f"{now} {platform.node()}:{os.getpid()} {line}")
        # A session whose files have no space says so itself.
        with contextlib.suppress(OSError):
            self.log.parent.mkdir(parents=True, exist_ok=True)
            with self.log.open("ab", buffering=0) as file:
                file.write(f"{text}\n".encode(errors="surrogateescape"))

    def _run(self, waiting: deque[Task], found: dict[str, SessionStatus]) -> None:
        """Run sessions. A simple queue, since an interrupt may leave a lock of Python's taken."""
        executor: Threads | Dask = Threads(self.workers)
        if self.scheduler:
            # All at once, so that workers that join later get some; else one per thread.
            executor = Dask(self.scheduler, None if self.fail_fast else len(waiting))
        outcomes: SimpleQueue[Outcome] = SimpleQueue()
        running = 0
        try:
            while waiting or running:
                if waiting and running < executor.at_once:
                    running += 1
                    self._note(f"session {waiting[0].session.name}: begun")
                    executor.begin(waiting.popleft(), outcomes.put)
                    continue
                outcome = outcomes.get()
                running -= 1
                if isinstance(outcome, DiskFullError):
                    raise outcome
                found[outcome.name] = outcome
                self._note(f"session {outcome.name}: {outcome.line}")
                if self.fail_fast and outcome.is_failed:
                    waiting.clear()
                self.progress(outcome)
        finally:
            executor.close()


def _records(tasks: Sequence[Task]) -> list[SessionRecord | None]:
    """Records of earlier runs that count."""
    if not any(task.is_remote for task in tasks):
        return list(map(_earlier, tasks))
    # Requests take their time in the network.
    with ThreadPoolExecutor(_REQUESTS) as pool:
        return list(pool.map(_earlier, tasks))


def _earlier(task: Task) -> SessionRecord | None:
    try:
        return finished(task)
    except MlbatchError:
        # Its run names what is wrong.
        return None


def _outcome(task: Task, run: Callable[[], SessionRecord]) -> Outcome:
    """Outcome of a session; a session that could not run must not end the others."""
    name = task.session.name
    try:
        return SessionStatus(name, run())
    except DiskFullError as err:
        return err
    except Exception as err:
        # Of Dask also KilledWorker: workers died several times with this session.
        if isinstance(err, OSError):
            err = system_error(err)
        line = str(err) if isinstance(err, MlbatchError) else f"{type(err).__name__}: {err}"
        # The session's folder has no record of this.
        record = SessionRecord(name, FAILED, 1, line, {}, inputs=[*task.session.inputs])
        return SessionStatus(name, record)


class Threads:
    """A thread for each session, which waits for its process; at_once: how many it is given."""

    def __init__(self, at_once: int) -> None:
        self.at_once = at_once
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def begin(self, task: Task, ended: Ended) -> None:
        """Begin a session; `ended` is called from another thread."""

        def work() -> None:
            ended(_outcome(task, partial(run_session, task, self._stop)))

        self._threads = [one for one in self._threads if one.is_alive()]
        self._threads.append(threading.Thread(target=work, daemon=True))
        self._threads[-1].start()

    def close(self) -> None:
        """End the processes in order, and wait for them."""
        self._stop.set()
        for thread in self._threads:
            # One that is not alive yet will find `stop`.
            if thread.is_alive():
                thread.join()


class Dask:
    """Tasks of a Dask scheduler that is already there.

    If a worker dies, its scheduler gives the session to another one, which resumes it. Workers need
    mlbatch, and the recordings and the output under the same paths.
    """

    def __init__(self, address: str, at_once: int | None) -> None:
        """at_once: None: a session for each thread of the workers.

        Raises UsageError without distributed, ExportError without a scheduler.
        """
        try:
            from distributed import Client
        except ImportError as err:
            raise UsageError(
                f"--scheduler: expected the package distributed, found none ({err}); "
                f"{install_extra('dask')}"
            ) from err
        try:
            self._client = Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as err:
            raise ExportError(
                f"--scheduler {address}: expected a Dask scheduler, found none ({err}); start one "
                "with `dask scheduler`, or leave out --scheduler"
            ) from err
        # A worker that died is no news: its sessions go to others, or fail with a line.
        logging.getLogger("distributed.client").setLevel(logging.ERROR)
        self.at_once = at_once or max(1, sum(self._client.nthreads().values()))
        # The scheduler forgets a task that nobody refers to.
        self._futures: list[Any] = []

    def begin(self, task: Task, ended: Ended) -> None:
        """Submit a session."""
        # Not pure: what is in the output decides, not the arguments.
        future = self._client.submit(run_session, task, pure=False)
        self._futures.append(future)
        future.add_done_callback(lambda future: ended(_outcome(task, future.result)))

    def close(self) -> None:
        """Begin no others; sessions that run end by themselves."""
        with contextlib.suppress(Exception):
            self._client.cancel([future for future in self._futures if not future.done()])
            self._client.close()
