"""Segments of a session by receive time: `--on-jump split` converts each on its own."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.discovery.calibrations import is_metadata
from mlbatch.pipeline.job import TimeSegment
from mlbatch.types import Message, PacketBatch, Recording, WrappedRecording


class ClippedRecording(WrappedRecording):
    """The packets and messages of a recording that were received within a segment.

    Others are not counted either: they belong to another segment. Messages from before the segment
    are given only if they describe sensors, since metadata are recorded once, at the start.
    """

    __slots__ = ("segment",)

    def __init__(self, inner: Recording, segment: TimeSegment) -> None:
        super().__init__(inner)
        self.segment = segment

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield the packets of the segment, in file order; each call is a new pass."""
        self.inner.keep = self.keep
        self.inner.lend = self.lend
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
        low = self.segment.begin_ns
        high = self.segment.end_ns
        inside = np.ones(len(batch), np.bool_)
        if low is not None:
            inside &= batch.host_ns >= low
        if high is not None:
            inside &= batch.host_ns < high
        return inside

    def _messages(self, batch: PacketBatch) -> tuple[Message, ...]:
        return tuple(message for message in batch.messages if self._is_due(message))

    def _is_due(self, message: Message) -> bool:
        low = self.segment.begin_ns
        high = self.segment.end_ns
        if high is not None and message.host_ns >= high:
            return False
        return low is None or message.host_ns >= low or is_metadata(message.topic)

    def _leave_out(self, count: int) -> None:
        """Take packets out of the inner counts."""
        self.inner.counts.frames -= count
        self.inner.counts.datagrams -= count
