"""A chunk of messages on its way from memory to the file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from mlbatch.writers.output_file import Bytes, crc32

# Bytes of so many parts in all, compressed as one.
Compress: TypeAlias = Callable[[Sequence[Bytes], int], list[Bytes]]


@dataclass(slots=True)
class Chunk:
    """Records that are complete and in order.

    records: parts, one after the other; the last may lie in a buffer that is used again once the
    chunk is written; places: log time and offset of the messages of each channel; is_kept: a
    continued file holds it. crc, stored: of the records, once it is sealed.
    """

    records: list[Bytes]
    places: dict[int, list[tuple[int, int]]]
    is_kept: bool = False
    crc: int = 0
    stored: list[Bytes] = field(default_factory=list)

    @property
    def size(self) -> int:
        """Bytes of the records."""
        return sum(map(len, self.records))

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time."""
        times_ns = [log_ns for places in self.places.values() for log_ns, _ in places]
        return min(times_ns), max(times_ns)

    def seal(self, compress: Compress | None) -> None:
        """Compress the records and compute their checksum, which takes long."""
        if self.is_kept:
            return
        for part in self.records:
            self.crc = crc32(part, self.crc)
        self.stored = self.records if compress is None else compress(self.records, self.size)
