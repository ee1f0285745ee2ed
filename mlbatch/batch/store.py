"""Where the sessions of a batch go: a folder, or object storage by way of the cache."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mlbatch.batch.cache import Cache
from mlbatch.batch.session import Session, is_url
from mlbatch.batch.task import Task
from mlbatch.errors import ExportError


def tasks_of(
    sessions: Sequence[Session], output: str, cache: Cache, *, retries: int, pages: bool
) -> list[Task]:
    """The tasks of sessions; ExportError where the output cannot be one, UsageError for URLs."""
    uploads = is_url(output)
    # Without the package every session would fail.
    inputs = (text for session in sessions for text in (*session.inputs, session.rig or ""))
    url = next(filter(is_url, (output, *inputs)), None)
    if url is not None:
        from mlbatch.batch.remote import check_package

        check_package(url)
    # Workers have other working folders.
    folder = cache.output(output) if uploads else Path(output).absolute()
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder}: expected a folder, found a file; choose another output")
    return [
        Task(
            session=session.absolute(),
            folder=folder / session.name,
            cwd=Path.cwd(),
            cache=cache,
            upload=f"{output.rstrip('/')}/{session.name}" if uploads else "",
            retries=retries,
            pages=pages,
        )
        for session in sessions
    ]
