"""Where the sessions of a batch go: a folder, or object storage by a local cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mlbatch.batch.session import Session
from mlbatch.batch.task import Task
from mlbatch.errors import ExportError


@dataclass(frozen=True, slots=True)
class OutputFolder:
    """A local output."""

    folder: Path

    def tasks(self, sessions: Sequence[Session], *, retries: int, pages: bool) -> list[Task]:
        """The tasks of sessions."""
        # Workers have other working folders.
        folder = self.folder.absolute()
        return [
            Task(one.absolute(), folder / one.name, Path.cwd(), retries, pages) for one in sessions
        ]


def open_output(output: str, cache: Path | None, cache_gb: float) -> OutputFolder:
    """The output of a batch; ExportError where it cannot be one."""
    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder}: expected a folder, found a file; choose another output")
    return OutputFolder(folder)
