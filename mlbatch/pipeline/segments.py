"""A part of a session by arrival: what `--on-jump split` converts on its own."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.discovery.probe import is_metadata
from mlbatch.types import CaptureCounts, Message, PacketBatch, Recording, Topic


@dataclass(frozen=True, slots=True)
class Part:
    """Arrivals in [begin_ns, end_ns); None: no limit."""

    begin_ns: int | None = None
    end_ns: int | None = None


@dataclass(slots=True)
class ClippedRecording:
    """The packets and messages of a recording that arrived within a part; `Recording`.

    What lies outside is left out of the counts, too: it belongs to another part. Messages from
    before the part come only if they teach of sensors, since metadata stand at the start.
    """

    inner: Recording
    part: Part
    topics: tuple[Topic, ...] = ()
    keep: frozenset[str] = frozenset()
    notes: list[str] = field(default_factory=list)
    path: Path = Path()
    container: str = ""
    counts: CaptureCounts = field(default_factory=CaptureCounts)
    size_bytes: int = 0
    position_bytes: int = 0

    def __post_init__(self) -> None:
        self.path, self.container = self.inner.path, self.inner.container
        self.size_bytes = self.inner.size_bytes
        self._follow()

    def packets(self, until_ns: int | None = None) -> Iterator[PacketBatch]:
        """Yield the packets of the part, in file order; may be called again (counts restart).

        until_ns: stop once this much time (ns) has passed since the first packet's arrival.
        """
        self.inner.keep = self.keep
        batches = self.inner.packets()
        first_ns = None
        try:
            for batch in batches:
                inside = self._inside(batch)
                self._leave_out(len(batch) - int(np.count_nonzero(inside)))
                self._follow()
                clipped = batch if inside.all() else batch.take(np.flatnonzero(inside))
                clipped = replace(clipped, messages=self._messages(batch))
                if len(clipped) or clipped.messages:
                    yield clipped
                if len(clipped):
                    first_ns = int(clipped.host_ns[0]) if first_ns is None else first_ns
                    if until_ns is not None and int(clipped.host_ns[-1]) - first_ns > until_ns:
                        return
        finally:
            if isinstance(batches, Generator):
                batches.close()
            self._follow()

    def _inside(self, batch: PacketBatch) -> BoolArray:
        low, high = self.part.begin_ns, self.part.end_ns
        inside = np.ones(len(batch), np.bool_)
        if low is not None:
            inside &= batch.host_ns >= low
        if high is not None:
            inside &= batch.host_ns < high
        return inside

    def _messages(self, batch: PacketBatch) -> tuple[Message, ...]:
        return tuple(message for message in batch.messages if self._is_due(message))

    def _is_due(self, message: Message) -> bool:
        low, high = self.part.begin_ns, self.part.end_ns
        if high is not None and message.host_ns >= high:
            return False
        return low is None or message.host_ns >= low or is_metadata(message.topic)

    def _leave_out(self, count: int) -> None:
        """Take packets out of the inner counts: what clouds become is counted there as well."""
        self.inner.counts.frames -= count
        self.inner.counts.datagrams -= count

    def _follow(self) -> None:
        """Take over what the inner recording says of itself."""
        inner = self.inner
        self.topics, self.notes, self.counts = inner.topics, inner.notes, inner.counts
        self.position_bytes = inner.position_bytes
