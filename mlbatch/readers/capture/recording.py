"""Packet captures, whatever their file format: one reused buffer, batch by batch.

The front of the buffer takes reassembled datagrams, the rest the bytes of the file, so that one
array contains all payloads of a batch. A format supplies a `Walker` that finds the frames.
Counts: one frame per record of the file, and one (`truncated`) for a record that the file cuts off
or that claims an impossible length; reading ends there and `notes` say where.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.errors import RecordingError
from mlbatch.native.arena import PacketArena
from mlbatch.readers.byte_records import SLACK
from mlbatch.readers.capture.dissector import (
    MAX_AGE_NS,
    MAX_DATAGRAM_BYTES,
    Dissector,
    Key,
    OpenSet,
)
from mlbatch.readers.capture.frames import LINKS, Frames, unknown_link
from mlbatch.readers.source import BUFFER_BYTES, Source, Window
from mlbatch.types import (
    MAX_OVERLAP_NS,
    CaptureCounts,
    CutOff,
    PacketBatch,
    Recording,
    StreamTable,
)

# Room for fragments of earlier buffers besides fragments of this one.
_FRONT_EXTRA_BYTES = 1 << 20
# The largest snapshot length of libpcap; a longer frame is a damaged record header.
MAX_FRAME_BYTES = 1 << 18
# Read at the end of a file: more than the packets of some lidars in 100 ms.
_TAIL_BYTES = 1 << 20
# Blocks that must be complete are a little longer than the longest frame.
MAX_BLOCK_BYTES = 1 << 20


@dataclass(slots=True)
class Walk:
    """Frames found in a buffer; the bytes before `next` are dealt with.

    next: may be behind the buffer's end, the bytes between are then skipped; need: bytes required
    from `next` on, 0 if the walk can continue; is_frame: a frame begins at `next`; fault: why
    nothing from `next` on can be read.
    """

    next: int
    need: int = 0
    is_frame: bool = True
    fault: str = ""
    frames: Frames = field(default_factory=Frames.none)


class Walker(Protocol):
    """Finds the frames of a file, in order; keeps what earlier bytes declared."""

    def walk(self, data: U8Array, begin: int, end: int) -> Walk:
        """The frames in `data[begin:end]`, as far as their records are complete."""
        ...


@dataclass(slots=True)
class CaptureRecording(Recording):
    """A capture file.

    walker: makes the Walker of a pass; buffer_bytes: for tests, results do not depend on it.
    """

    walker: Callable[[], Walker]
    streams: StreamTable
    buffer_bytes: int = BUFFER_BYTES
    # Of the next pass; None: each buffer is used again.
    arena: PacketArena | None = None
    # Start of the first record in the last bytes of a file (True: all its records), and bytes of
    # the file before records.
    first_record: Callable[[U8Array, bool], int | None] | None = None
    head_bytes: int = 0
    # Of the newest pass, and sets of captures before this one for the next.
    dissector: Dissector | None = None
    inherited: dict[Key, OpenSet] = field(default_factory=dict)
    inherited_ns: int = 0

    @property
    def fragments_begin_ns(self) -> int | None:
        """Receive time of the first frame of the newest pass, if it left datagrams open."""
        dissector = self.dissector
        return dissector.begin_ns if dissector is not None and dissector.first_keys else None

    def follow(self, earlier: Recording) -> None:
        """Take over what `earlier` left open for the next pass, if this capture continues it.

        It does where its first fragments belong to open sets of one that ended before it began.
        """
        begin_ns = self.fragments_begin_ns
        if not isinstance(earlier, CaptureRecording) or begin_ns is None:
            return
        mine = self.dissector
        theirs = earlier.dissector
        if mine is None or theirs is None:
            return
        pause_ns = begin_ns - theirs.end_ns
        if pause_ns > MAX_AGE_NS:
            theirs.open_sets.clear()
        if pause_ns < -MAX_OVERLAP_NS:
            return
        expected = mine.first_keys - self.inherited.keys()
        for key in [key for key in theirs.open_sets if key in expected]:
            self.inherited[key] = theirs.hand_over(key)
            self.inherited_ns = max(self.inherited_ns, theirs.now_ns)

    def last_packets(self, streams: StreamTable) -> PacketBatch | None:
        """Return packets in the last bytes; None for compressed files and unknown records."""
        with Source(self.path) as source:
            if self.first_record is None or not source.is_plain:
                return None
        with self.path.open("rb") as file:
            head = file.read(self.head_bytes)
            at = max(self.head_bytes, self.size_bytes - _TAIL_BYTES)
            file.seek(at)
            tail = np.frombuffer(file.read(_TAIL_BYTES), np.uint8)
        begin = self.first_record(tail, at == self.head_bytes)
        if begin is None:
            return None
        end = len(head) + len(tail) - begin
        data = np.zeros(end + SLACK, np.uint8)
        data[: len(head)] = np.frombuffer(head, np.uint8)
        data[len(head) : end] = tail[begin:]
        # Fragments may have begun before.
        dissector = Dissector(CaptureCounts(), streams, max_age_ns=-1)
        walker = self.walker()
        walk = Walk(0)
        found = []
        while walk.next < end and not walk.need and not walk.fault:
            walk = walker.walk(data, walk.next, end)
            found.append(dissector.push(data, walk.frames)[0])
        start, size, stream, host_ns = map(np.concatenate, zip(*found, strict=True))
        return PacketBatch(data, start, size, stream, host_ns)

    def use_arena(self, arena: PacketArena) -> bool:
        """Read the next pass into an arena."""
        self.arena = arena
        return True

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield all packets from the start, in file order; each call is a new pass."""
        self.counts = CaptureCounts()
        self.notes = []
        self.position_bytes = 0
        current = _Pass(self)
        self.arena = None
        self.dissector = current.dissector
        if self.inherited:
            self.dissector.inherit(self.inherited, self.inherited_ns)
        self.inherited = {}
        self.inherited_ns = 0
        try:
            with Source(self.path) as source:
                yield from current.batches(source)
        finally:
            self.dissector.finish()
        current.check_links()


class _Pass:
    """One pass over a capture."""

    def __init__(self, recording: CaptureRecording) -> None:
        self.recording = recording
        self.walker = recording.walker()
        self.dissector = Dissector(recording.counts, recording.streams)
        self.arena = recording.arena
        read_bytes = 0 if self.arena is None else self.arena.read_bytes
        self.buffer_bytes = read_bytes or recording.buffer_bytes
        self.front_bytes = self.buffer_bytes + _FRONT_EXTRA_BYTES
        self.unknown_link: int | None = None
        self.has_known_link = False

    def batches(self, source: Source) -> Iterator[PacketBatch]:
        """All packets of the file."""
        window = Window(source, self.buffer_bytes, front=self.front_bytes, arena=self.arena)
        window.refill()
        while True:
            self.recording.position_bytes = source.position_bytes
            walk = self.walker.walk(window.data, window.begin, window.end)
            spanned_bytes = walk.next - window.begin
            for frames, is_last in self._portions(walk.frames, spanned_bytes):
                # With a need the rest comes in another region.
                batch = self._batch(window, frames, is_last=is_last and walk.need > 0)
                if len(batch):
                    yield batch
            window.begin = walk.next
            if walk.fault:
                self._note(window, f"{walk.fault}; the rest of the file was not read")
                self._count_cut()
                return
            can_continue = not walk.need and window.begin < window.end
            if not can_continue and not window.refill(walk.need):
                self._end(window, walk, source)
                return

    def _portions(self, frames: Frames, spanned_bytes: int) -> Iterator[tuple[Frames, bool]]:
        """Frames in portions whose datagrams fit into the front, whatever their fragments.

        The second is True for the last portion. spanned_bytes: of the records of all frames.
        """
        if len(frames) and self.dissector.held_bytes + spanned_bytes <= self.front_bytes:
            # The usual case.
            yield frames, True
            return
        fewest = self.front_bytes // MAX_DATAGRAM_BYTES
        end_bytes = np.cumsum(frames.captured)
        at = 0
        while at < len(frames):
            before = int(end_bytes[at - 1]) if at else 0
            room = self.front_bytes - self.dissector.held_bytes + before
            stop = max(int(np.searchsorted(end_bytes, room, side="right")), at + fewest)
            yield frames.take(slice(at, stop)), stop >= len(frames)
            at = stop

    def _batch(self, window: Window, frames: Frames, *, is_last: bool) -> PacketBatch:
        """The packets that these frames contain or complete; all other frames are counted.

        is_last: no other batch is assembled in the same bytes.
        """
        self._note_links(frames.link)
        datagrams, joined_bytes = self.dissector.push(window.data, frames)
        place = window.arena_place if is_last or not joined_bytes else None
        return PacketBatch(window.data, *datagrams, place=place)

    def _note_links(self, link: I64Array) -> None:
        if not self.has_known_link:
            numbers = sorted(set(link.tolist()))
            unknown = [number for number in numbers if number not in LINKS]
            self.has_known_link = len(unknown) < len(numbers)
            self.unknown_link = unknown[0] if unknown else self.unknown_link

    def check_links(self) -> None:
        """Raise if no frame of the capture was of a known link type."""
        if not self.has_known_link and self.unknown_link is not None:
            why = unknown_link(self.unknown_link)
            raise RecordingError(f"{self.recording.path}: {why}")

    def _end(self, window: Window, walk: Walk, source: Source) -> None:
        """Count a record that the end of the file cuts off."""
        if source.fault:
            self.recording.notes.append(CutOff(f"byte {source.position_bytes}: {source.fault}"))
        if window.begin == window.end:
            return
        if walk.need:
            left = max(window.end - window.begin, 0)
            self._note(
                window, f"the file ends within a record; expected {walk.need} bytes, found {left}"
            )
        else:
            self._note(window, "expected more of the file, found its end")
        if walk.is_frame:
            self._count_cut()

    def _note(self, window: Window, text: str) -> None:
        self.recording.notes.append(CutOff(f"byte {window.place}: {text}"))

    def _count_cut(self) -> None:
        self.recording.counts.frames += 1
        self.recording.counts.skip("truncated")
