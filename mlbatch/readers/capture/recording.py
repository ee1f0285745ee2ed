"""Reading of packet captures, whatever their file format: one reused buffer, batch by batch.

The buffer's front part takes assembled datagrams, the rest the file's bytes, so that one array
holds all payloads of a batch. A format supplies a `Walker` that finds the frames in these bytes.
Counting: one frame per record of the file, and one (`truncated`) for a record that the file cuts
off or that claims an impossible length; reading ends there and `notes` tell where.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from mlbatch.errors import RecordingError
from mlbatch.kernels.reading import CaptureKernel
from mlbatch.readers.byte_records import SLACK
from mlbatch.readers.capture import link_types
from mlbatch.readers.capture.fragments import MAX_DATAGRAM_BYTES, Reassembler
from mlbatch.readers.capture.frames import Addresses, Frames, StreamNumbers, dissect, in_order
from mlbatch.readers.source import Source
from mlbatch.types import CaptureCounts, I64Array, PacketBatch, StreamTable, Topic, U8Array

BUFFER_BYTES = 4 << 20
# Room for fragments of earlier buffers beside those of this one.
_ARENA_EXTRA_BYTES = 1 << 20
# The largest snapshot length of libpcap; a longer frame is a damaged record header.
MAX_FRAME_BYTES = 1 << 18
# Blocks that have to be seen whole are a little longer than the longest frame.
MAX_RECORD_BYTES = 1 << 20


@dataclass(slots=True)
class Walk:
    """Frames found in a buffer; all before byte `next` is dealt with.

    `next` may lie behind the buffer's end: the bytes until there are of no interest. need: bytes
    that must be there from `next` on, 0 if walking can go on; is_frame: a frame begins at `next`;
    fault: why nothing from `next` on can be read.
    """

    next: int
    need: int = 0
    is_frame: bool = True
    fault: str = ""
    frames: Frames = field(default_factory=Frames.none)


class Walker(Protocol):
    """Finds frames in the bytes of a file, in order; remembers what the file said before."""

    def walk(self, data: U8Array, begin: int, end: int) -> Walk:
        """The frames in `data[begin:end]`, as far as their records are whole."""
        ...


@dataclass(slots=True)
class _Window:
    """The buffer: `arena` bytes for assembled datagrams, then bytes `begin` to `end` of the file.

    origin: place in the (decompressed) file of the array's byte 0.
    """

    data: U8Array
    arena: int
    begin: int
    end: int
    origin: int

    @classmethod
    def of(cls, size: int) -> _Window:
        """A window for `size` bytes of a file."""
        arena = size + _ARENA_EXTRA_BYTES
        data = np.zeros(arena + size + SLACK, np.uint8)
        return cls(data, arena, arena, arena, -arena)

    def refill(self, source: Source, need: int) -> bool:
        """Keep the unread bytes, read more behind them; False at the end of the file."""
        kept = max(self.end - self.begin, 0)
        if (
            self.arena + kept + SLACK >= len(self.data)
            or need > len(self.data) - self.arena - SLACK
        ):
            self.data = np.append(self.data, np.zeros(max(need, kept), np.uint8))
        self.data[self.arena : self.arena + kept] = self.data[self.begin : self.end]
        self.origin += min(self.begin, self.end) - self.arena
        skip = max(self.begin - self.end, 0)
        self.begin, self.end = self.arena + skip, self.arena + kept
        room = self.data.data[self.end : len(self.data) - SLACK]
        count = source.fill(room)
        self.end += count
        return count > 0


@dataclass(slots=True)
class CaptureRecording:
    """A capture file; implements `Recording`.

    notes: what was wrong with the file, a line each; position_bytes: of `size_bytes` on disk, how
    far reading has come; engine: `numba` for compiled loops; buffer_bytes and together: for tests.
    Results do not depend on these three.
    """

    path: Path
    container: str
    size_bytes: int
    walker: Callable[[CaptureKernel | None], Walker]
    streams: StreamTable
    buffer_bytes: int = BUFFER_BYTES
    together: bool = True
    engine: str = "numpy"
    counts: CaptureCounts = field(default_factory=CaptureCounts)
    notes: list[str] = field(default_factory=list)
    position_bytes: int = 0
    topics: tuple[Topic, ...] = ()
    keep: frozenset[str] = frozenset()

    def packets(self, until_ns: int | None = None) -> Iterator[PacketBatch]:
        """Yield all packets from the start, in file order; may be called again (counts restart).

        until_ns: stop once this much time (ns) has passed since the first packet's arrival; what
        lies behind the last packet given is then not counted.
        """
        self.counts, self.notes, self.position_bytes = CaptureCounts(), [], 0
        run = _Run(self)
        try:
            with Source(self.path) as source:
                yield from _until(run.batches(source), until_ns, self.counts)
        finally:
            run.reassembler.sets.finish()
        run.check_links()


def _until(
    batches: Iterator[PacketBatch], until_ns: int | None, counts: CaptureCounts
) -> Iterator[PacketBatch]:
    first_ns: int | None = None
    for batch in batches:
        if until_ns is None or not len(batch):
            yield batch
            continue
        first_ns = int(batch.host_ns[0]) if first_ns is None else first_ns
        beyond = np.flatnonzero(batch.host_ns - first_ns > until_ns)
        if len(beyond):
            left_out = len(batch) - int(beyond[0])
            counts.frames -= left_out
            counts.datagrams -= left_out
            if len(batch) > left_out:
                yield batch.take(slice(0, int(beyond[0])))
            return
        yield batch


class _Run:
    """One pass over a capture."""

    def __init__(self, recording: CaptureRecording) -> None:
        self.recording = recording
        self.kernel = CaptureKernel() if recording.engine == "numba" else None
        self.walker = recording.walker(self.kernel)
        self.addresses = Addresses()
        self.numbers = StreamNumbers(self.addresses, recording.streams)
        self.reassembler = Reassembler(recording.counts, recording.together, self.kernel)
        self.unknown_link: int | None = None
        self.known_links = False

    def batches(self, source: Source) -> Iterator[PacketBatch]:
        """All packets of the file."""
        window = _Window.of(self.recording.buffer_bytes)
        window.refill(source, 0)
        while True:
            self.recording.position_bytes = source.position_bytes
            walk = self.walker.walk(window.data, window.begin, window.end)
            for frames in self._portions(walk.frames):
                batch = self._batch(window.data, frames)
                if len(batch):
                    yield batch
            window.begin = walk.next
            if walk.fault:
                self._stop(window, walk.fault)
                return
            more = not walk.need and window.begin < window.end
            if not more and not window.refill(source, walk.need):
                self._end(window, walk, source)
                return

    def _portions(self, frames: Frames) -> Iterator[Frames]:
        """Frames in portions whose datagrams fit into the arena, whatever their fragments."""
        arena = self.recording.buffer_bytes + _ARENA_EXTRA_BYTES
        fewest = arena // MAX_DATAGRAM_BYTES
        at, end_bytes = 0, np.cumsum(frames.captured)
        while at < len(frames):
            before = int(end_bytes[at - 1]) if at else 0
            room = arena - self.reassembler.sets.held_bytes + before
            stop = max(int(np.searchsorted(end_bytes, room, side="right")), at + fewest)
            yield frames.take(slice(at, stop))
            at = stop

    def _batch(self, data: U8Array, frames: Frames) -> PacketBatch:
        """The packets that these frames hold or complete; everything else is counted."""
        self._note_links(frames.link)
        found = dissect(data, frames, self.addresses, self.kernel)
        counts = self.recording.counts
        counts.frames += len(frames)
        for reason, count in found.skipped.items():
            counts.skip(reason, count)
        datagrams = found.datagrams
        if len(found.fragments):
            arrival_ns = frames.host_ns[found.fragments.frame]
            assembled = self.reassembler.push(data, found.fragments, arrival_ns)
            datagrams = in_order(datagrams, assembled)
        counts.datagrams += len(datagrams.frame)
        stream = self.numbers.numbers(datagrams.source, datagrams.port)
        host_ns = frames.host_ns[datagrams.frame]
        return PacketBatch(data, datagrams.start, datagrams.size, stream, host_ns)

    def _note_links(self, link: I64Array) -> None:
        if not self.known_links:
            numbers = sorted(set(link.tolist()))
            strange = [number for number in numbers if number not in link_types.LINKS]
            self.known_links = len(strange) < len(numbers)
            self.unknown_link = strange[0] if strange else self.unknown_link

    def check_links(self) -> None:
        """Raise if no frame of the capture could even be looked into."""
        if not self.known_links and self.unknown_link is not None:
            raise RecordingError(
                f"{self.recording.path}: {link_types.unknown_link(self.unknown_link)}"
            )

    def _stop(self, window: _Window, fault: str) -> None:
        at = window.origin + window.begin
        self.recording.notes.append(f"byte {at}: {fault}; the rest of the file was not read")
        self._count_cut()

    def _end(self, window: _Window, walk: Walk, source: Source) -> None:
        """Count a record that the end of the file cuts off."""
        if source.fault:
            self.recording.notes.append(f"byte {source.position_bytes}: {source.fault}")
        if window.begin == window.end:
            return
        at, left = window.origin + window.begin, max(window.end - window.begin, 0)
        self.recording.notes.append(
            f"byte {at}: the file ends within a record; wanted {walk.need} bytes, got {left}"
            if walk.need
            else f"byte {at}: wanted more of the file, got its end"
        )
        if walk.is_frame:
            self._count_cut()

    def _count_cut(self) -> None:
        self.recording.counts.frames += 1
        self.recording.counts.skip("truncated")
