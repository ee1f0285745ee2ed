"""An MCAP file as the place where a run's messages go (facts/outputs.md, section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mlbatch.types import Message, Summary
from mlbatch.writers._chunk import Chunk
from mlbatch.writers.atomic import SCANS_CSV
from mlbatch.writers.mcap_container import Container
from mlbatch.writers.output_file import OutputFile


class McapSink:
    """Messages, metadata records `mlbatch.grid` and `mlbatch.report`, attachment scans.csv."""

    def __init__(self, path: Path, kept_bytes: int | None, compression: str) -> None:
        self._file = OutputFile(path, kept_bytes)
        self.container = Container(self._file, compression)

    @property
    def ended(self) -> int:
        """Chunks that are complete."""
        return self.container.ended

    def safe(self) -> tuple[int, int]:
        """Chunks that are written, and the bytes up to their end; nothing is buffered."""
        return self.container.chunks, self._file.position_bytes

    def take(self) -> list[Chunk]:
        """The chunks that are complete since the last call."""
        return self.container.take()

    def seal(self, chunks: Sequence[Chunk]) -> None:
        """Make chunks ready to be written; by any thread."""
        self.container.seal(chunks)

    def put(self, chunks: Sequence[Chunk]) -> None:
        """Write sealed chunks, in the order in which they were taken."""
        self.container.put(chunks)

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
        self._file.close()
