"""An MCAP file as the place where a run's messages go (facts/outputs.md, section 4)."""

from __future__ import annotations

import contextlib
from pathlib import Path

from mlbatch.types import Message, Summary
from mlbatch.writers._atomic import SCANS_CSV
from mlbatch.writers._kept import open_output
from mlbatch.writers._mcap_file import Container


class McapSink:
    """Messages, metadata records `mlbatch.grid` and `mlbatch.report`, attachment scans.csv."""

    def __init__(self, path: Path, kept_bytes: int | None) -> None:
        self._file = open_output(path, kept_bytes)
        self.container = Container(self._file)

    @property
    def chunks(self) -> int:
        """Chunks that are complete."""
        return self.container.chunks

    def flush(self) -> int:
        """Hand complete chunks to the system; gives the bytes up to their end."""
        self._file.flush()
        return self.container.position_bytes

    def send(
        self, topic: str, kind: str, log_ns: int, message: bytes | memoryview, latched: bool = False
    ) -> None:
        """Append a message of type `kind`, package/Type; a topic is made at its first message."""
        self.container.send(topic, kind, log_ns, message, latched)

    def forward(self, message: Message) -> None:
        """Append a message as it was recorded, whatever its encoding."""
        self.container.forward(message)

    def finish(self, summary: Summary, grid: dict[str, str]) -> None:
        """Add metadata and scans.csv, complete and close the file."""
        self.container.note("mlbatch.grid", grid)
        self.container.note("mlbatch.report", {"json": summary.report_json})
        log_ns = summary.t_init_ns or 0
        self.container.attach(SCANS_CSV, "text/csv", log_ns, summary.scans_csv)
        self.container.finish()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        # Closing flushes once more, onto the disk that has just refused.
        with contextlib.suppress(OSError):
            self._file.close()
