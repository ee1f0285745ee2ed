"""A part of a session by arrival: what `--on-jump split` converts on its own."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.learning import teaches
from mlbatch.types import BoolArray, Message, PacketBatch, Recording, WrappedRecording


@dataclass(frozen=True, slots=True)
class Part:
    """Arrivals in [begin_ns, end_ns); None: no limit."""

    begin_ns: int | None = None
    end_ns: int | None = None


class ClippedRecording(WrappedRecording):
    """The packets and messages of a recording that were received within a part.

    Packets outside are not counted: they belong to another part. Messages from before the part are
    included only if they describe sensors, since metadata come at the start.
    """

    __slots__ = ("part",)

    def __init__(self, inner: Recording, part: Part) -> None:
        super().__init__(inner)
        self.part = part

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield the packets of the part, in file order; each call is a new pass."""
        self.inner.keep = self.keep
        batches = self.inner.packets()
        try:
            for batch in batches:
                inside = self._inside(batch)
                self._leave_out(len(batch) - int(np.count_nonzero(inside)))
                clipped = batch if inside.all() else batch.take(np.flatnonzero(inside))
                clipped = replace(clipped, messages=self._messages(batch))
                if len(clipped) or clipped.messages:
                    yield clipped
        finally:
            batches.close()

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
        return low is None or message.host_ns >= low or teaches(message.topic)

    def _leave_out(self, count: int) -> None:
        """Take packets out of the inner counts."""
        self.inner.counts.frames -= count
        self.inner.counts.datagrams -= count
