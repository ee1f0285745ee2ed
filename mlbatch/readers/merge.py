"""Several recordings as one session: packets in order of their receive times.

Equal times keep the order of the recordings. Where a recording's own times step back, its packets
keep their order and count with the largest time so far. A recording of messages alone is read
first, so that its metadata are known before any packet, or by its log times, so that memory needs
to contain little of it.

Captures that follow each other (tcpdump -C, -G) are read as the one capture that they were: each
takes over the fragments of datagrams that the one before left open.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.native.capture import CaptureLoops
from mlbatch.readers.byte_records import SLACK
from mlbatch.types import MAX_OVERLAP_NS, PacketBatch, Recording

# Called with the next packets of a recording, before they are merged; None: it has no more.
Seen: TypeAlias = Callable[[Recording, "PacketBatch | None"], None]
_NONE = np.zeros(0, np.int64)
_NOTHING = PacketBatch(np.zeros(0, np.uint8), _NONE, _NONE, _NONE, _NONE)


def never(recording: Recording) -> bool:
    """False: packets are merged by receive time."""
    return False


def merge(
    recordings: Sequence[Recording],
    by_log_time: Callable[[Recording], bool] = never,
    seen: Seen | None = None,
) -> Generator[PacketBatch, None, None]:
    """Yield all packets of all recordings; batches of a single recording are passed on as they are.

    Each recording is opened at its first receive time: only overlapping ones are in memory.
    by_log_time: whether to order a recording by the log times of its messages; only for recordings
    without packets, which have times of their own; seen: called for what several recordings give.
    """
    if len(recordings) == 1:
        yield from recordings[0].packets()
        return
    feeds = [_Feed.peek(recording, by_log_time(recording)) for recording in recordings]
    try:
        yield from _merged(feeds, seen)
    finally:
        for feed in feeds:
            feed.close()


def _merged(feeds: list[_Feed], seen: Seen | None) -> Iterator[PacketBatch]:
    out: U8Array = np.zeros(0, np.uint8)
    while waiting := [feed for feed in feeds if not feed.ended]:
        # The feed that is known up to the earliest time bounds the others; of equals, the first.
        slowest = min(waiting, key=lambda feed: feed.known_until_ns)
        bound_ns = slowest.known_until_ns
        is_before = True
        ready = []
        for feed in waiting:
            is_before = is_before and feed is not slowest
            given = feed.take(bound_ns, inclusive=is_before or feed is slowest)
            if seen is not None and len(given[0]):
                seen(feed.recording, given[0])
            ready.append(given)
        messages = tuple(message for batch, _ in ready for message in batch.messages)
        ready = [(batch, key_ns) for batch, key_ns in ready if len(batch)]
        if len(ready) == 1:
            yield replace(ready[0][0], messages=messages)
        elif ready:
            batch, out = _interleave(ready, out)
            yield replace(batch, messages=messages)
        elif messages:
            yield replace(_NOTHING, messages=messages)
        if slowest.is_unopened:
            _take_over(slowest, feeds)
        slowest.advance()
        if slowest.ended and seen is not None:
            seen(slowest.recording, None)


def _take_over(feed: _Feed, feeds: list[_Feed]) -> None:
    """Let a capture that is opened next continue those that it follows."""
    begin_ns = feed.recording.fragments_begin_ns
    if begin_ns is None:
        return
    others = [other for other in feeds if other.recording.fragments_begin_ns is not None]
    for other in others:
        other.read_ahead(begin_ns + MAX_OVERLAP_NS)
    # Of several with fragments of the same datagram the one whose name is most alike.
    others.sort(key=lambda other: -_alike(other.recording.path, feed.recording.path))
    for other in others:
        if other.is_read:
            feed.recording.follow(other.recording)


def _alike(first: Path, second: Path) -> int:
    """Number of characters with which both paths begin."""
    pairs = zip(str(first), str(second), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


@dataclass(slots=True)
class _Feed:
    """Packets of one recording that are known and not yet given out.

    key_ns: (n,) largest receive time up to each packet of `batch`; known_until_ns: no later packet
    of this recording can come before it; is_read: there is no further batch.
    """

    recording: Recording
    by_log_time: bool
    known_until_ns: int = 0
    ended: bool = False
    is_read: bool = False
    batch: PacketBatch | None = None
    key_ns: I64Array = field(default_factory=lambda: _NONE)
    _packets: Generator[PacketBatch, None, None] | None = None

    @classmethod
    def peek(cls, recording: Recording, by_log_time: bool) -> _Feed:
        """A feed that knows its first packet's time, but has no buffer yet."""
        packets = recording.packets()
        first = next((batch for batch in packets if len(batch) or batch.messages), None)
        # Closing now returns the buffer.
        packets.close()
        # The first datagram may begin in another recording.
        begin_ns = recording.fragments_begin_ns
        if first is None:
            return cls(recording, by_log_time, begin_ns or 0, ended=begin_ns is None)
        if len(first):
            first_ns = int(first.host_ns[0])
            known_until_ns = first_ns if begin_ns is None else min(first_ns, begin_ns)
        else:
            # Log times of messages order packets of other recordings only with `by_log_time`.
            known_until_ns = first.messages[0].host_ns if by_log_time else 0
        return cls(recording, by_log_time, known_until_ns)

    def take(self, bound_ns: int, inclusive: bool) -> tuple[PacketBatch, I64Array]:
        """Give out the packets up to `bound_ns`, with their keys."""
        if self.batch is None:
            return _NOTHING, self.key_ns
        messages = self.batch.messages
        stop = int(np.searchsorted(self.key_ns, bound_ns, side="right" if inclusive else "left"))
        given = replace(self.batch.take(slice(0, stop)), messages=messages)
        key_ns = self.key_ns[:stop]
        self.batch = self.batch.take(slice(stop, None))
        self.key_ns = self.key_ns[stop:]
        return given, key_ns

    @property
    def is_unopened(self) -> bool:
        """True before the first `advance`."""
        return self._packets is None and not self.is_read

    def advance(self) -> None:
        """Get the next batch; its bytes replace the bytes of the one before."""
        self.batch = self._next()
        self.ended = self.batch is None

    def read_ahead(self, until_ns: int) -> None:
        """Read a capture that is open to this time or its end; keep what was not given out."""
        while self._packets is not None and self.known_until_ns <= until_ns:
            kept = []
            if self.batch is not None and len(self.batch):
                # The next batch replaces the bytes.
                copied, _ = _interleave([(self.batch, self.key_ns)], _NOTHING.data)
                kept = [(copied, self.key_ns)]
            batch = self._next()
            if batch is not None:
                kept.append((batch, self.key_ns))
            if kept:
                self.batch, _ = _interleave(kept, _NOTHING.data)
                self.key_ns = np.concatenate([key_ns for _, key_ns in kept])

    def _next(self) -> PacketBatch | None:
        """The next batch, whose times are known then; None at the end."""
        if self.is_unopened:
            self._packets = self.recording.packets()
        packets = self._packets or ()
        batch = next((batch for batch in packets if len(batch) or batch.messages), None)
        if batch is None:
            self.is_read = True
            self._packets = None
            return None
        self.key_ns = np.maximum(np.maximum.accumulate(batch.host_ns), self.known_until_ns)
        if len(batch):
            self.known_until_ns = int(self.key_ns[-1])
        elif self.by_log_time:
            last_ns = max(message.host_ns for message in batch.messages)
            self.known_until_ns = max(self.known_until_ns, last_ns)
        return batch

    def close(self) -> None:
        """End the reading in this thread, not when the last reference is dropped."""
        if self._packets is not None:
            self._packets.close()


def _interleave(
    ready: list[tuple[PacketBatch, I64Array]], out: U8Array
) -> tuple[PacketBatch, U8Array]:
    """Join batches: packets by their keys, payloads in `out` or, if too small, in a new array."""
    size = np.concatenate([batch.size for batch, _ in ready])
    end = np.cumsum(size)
    start = end - size
    if len(out) < end[-1] + SLACK:
        out = np.zeros(int(end[-1]) * 3 // 2 + SLACK, np.uint8)
    first = 0
    for batch, _ in ready:
        rows = slice(first, first + len(batch))
        CaptureLoops().copy_runs(batch.data, batch.start, batch.size, out, start[rows])
        first += len(batch)
    order = np.argsort(np.concatenate([key_ns for _, key_ns in ready]), kind="stable")
    stream = np.concatenate([batch.stream for batch, _ in ready])
    host_ns = np.concatenate([batch.host_ns for batch, _ in ready])
    return PacketBatch(out, start, size, stream, host_ns).take(order), out
