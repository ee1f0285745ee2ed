"""Sessions as tasks of a Dask scheduler that is already there.

A worker runs the same function as a thread of the driver, with a process for each session. If a
worker dies, its scheduler gives the session to another one, which resumes it. Workers need mlbatch,
and the recordings and the output under the same paths.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Sequence
from typing import TYPE_CHECKING, Any

from mlbatch.batch.driver import Result, failure
from mlbatch.batch.task import Task, run_session
from mlbatch.errors import DiskFullError, ExportError, UsageError, install_extra

if TYPE_CHECKING:
    from distributed import Client

_CONNECT_S = 10


def by_dask(
    tasks: Sequence[Task], address: str, *, fail_fast: bool
) -> Generator[Result, None, None]:
    """Results as they come.

    Raises UsageError without distributed, ExportError without a scheduler.
    """
    try:
        from distributed import as_completed
    except ImportError as err:
        raise UsageError(
            f"--scheduler: expected the package distributed, found none ({err}); "
            f"{install_extra('dask')}"
        ) from err
    client = _connected(address)
    try:
        waiting = list(reversed(tasks))
        # All at once, so that workers that join later get some; with `--fail-fast` one a thread.
        count = sum(client.nthreads().values()) if fail_fast else len(tasks)
        first = [waiting.pop() for _ in range(min(max(count, 1), len(tasks)))]
        running = {_submitted(client, task): task for task in first}
        results = as_completed(list(running), loop=client.loop)
        for future in results:
            result = _result(running[future], future)
            yield result
            if waiting and not (fail_fast and result.failed):
                task = waiting.pop()
                running[_submitted(client, task)] = task
                results.add(list(running)[-1])
            elif fail_fast and result.failed:
                waiting.clear()
    finally:
        with contextlib.suppress(Exception):
            # Sessions that run end by themselves; others are not begun.
            client.cancel([future for future in running if not future.done()])
            client.close()


def _connected(address: str) -> Client:
    from distributed import Client

    try:
        return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as err:
        raise ExportError(
            f"--scheduler {address}: expected a Dask scheduler, found none ({err}); start one with "
            "`dask scheduler`, or leave out --scheduler"
        ) from err


def _submitted(client: Client, task: Task) -> Any:
    # Not pure: what is in the output decides, not the arguments.
    return client.submit(run_session, task, pure=False)


def _result(task: Task, future: Any) -> Result:
    try:
        return Result(task.session.name, future.result(), ran=True)
    except DiskFullError:
        raise
    except Exception as err:
        # KilledWorker: workers died several times with this session.
        return failure(task, err)
