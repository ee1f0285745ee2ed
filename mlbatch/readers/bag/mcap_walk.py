"""Walk over the records of an MCAP file, from front to end, without an index.

Source: MCAP specification (mcap.dev/spec), docs/sources/messages.md section 5. Messages are found,
channels learned, other records skipped. An uncompressed chunk is entered like any other part of
the file, so that its messages stay in the buffer they were read to; compressed ones are
decompressed one at a time. The walk survives damage: a fault inside a chunk costs the rest of that
chunk, one outside the rest of the file; both are in `notes`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Iterator, Set
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, U8Array
from mlbatch.readers.bag.mcap_records import (
    CHUNK_HEAD_BYTES,
    HEAD,
    MAGIC,
    MESSAGE_HEAD_BYTES,
    Channels,
    ChunkHead,
    Op,
    chunk_head,
)
from mlbatch.readers.bag.recording import MOST_NOTES, Portion
from mlbatch.readers.byte_records import records
from mlbatch.readers.source import BUFFER_BYTES, MAX_RECORD_BYTES, Decompressor, Source, Window
from mlbatch.types import CutOff, Topic

_COMPRESSIONS = ("lz4", "zstd")
_CHANNEL = struct.Struct("<H")
_MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<i8"),
        ("publish_ns", "<i8"),
    ]
)
_MAX_DEFINITION_BYTES = 1 << 24
# Messages may be as short as their heads: most places kept at a time.
_MOST_STARTS = 1 << 18
# Records that are only outside chunks; the others may be anywhere.
_OF_THE_FILE = (Op.CHUNK, Op.DATA_END, Op.FOOTER)
# Behind a record of _LARGE_BYTES so many bytes are read: the next head. More would be moved to the
# front of the buffer before the rest of the next record is read.
_LARGE_BYTES = 1 << 20
_AHEAD_BYTES = 1 << 14
_SKIPPED = range(Op.CHUNK + 1, Op.DATA_END)


# -- records in a span of bytes -------------------------------------------------------------------


@dataclass(slots=True)
class Span:
    """How far records could be walked: to byte `next`, which may be behind the bytes given.

    need: bytes that the record there takes, 0 if nothing is missing; opcode: of a record there that
    is only outside chunks, or 0; fault: why the walk cannot continue; full: the messages found so
    far have to be gathered first.
    """

    next: int
    need: int = 0
    opcode: int = 0
    length: int = 0
    fault: str = ""
    full: bool = False


@dataclass(slots=True)
class Scanner:
    """Finds messages in bytes; `selects` is true for the topics to read."""

    selects: Callable[[Topic], bool]
    channels: Channels
    _selected: BoolArray = field(default_factory=lambda: np.zeros(1 << 16, bool))

    def __post_init__(self) -> None:
        for number, topic in self.channels.topics.items():
            self._selected[number] = self.selects(topic)

    def scan(self, data: U8Array, at: int, end: int, starts: list[int]) -> Span:
        """Walk over `data[at:end]`; places of whole messages are added to `starts`."""
        view = data.data
        while True:
            at = _messages(view, at, end, starts)
            if len(starts) >= _MOST_STARTS:
                return Span(at, full=True)
            if at + HEAD.size > end:
                return Span(at, HEAD.size if at < end else 0)
            opcode, length = HEAD.unpack_from(view, at)
            size = HEAD.size + length
            if opcode == Op.MESSAGE:
                if length < MESSAGE_HEAD_BYTES:
                    return Span(at, fault=f"expected a message, found a record of {length} bytes")
                if at + HEAD.size + _CHANNEL.size > end:
                    return Span(at, size)
                [channel] = _CHANNEL.unpack_from(view, at + HEAD.size)
                if self._selected[channel]:
                    return Span(at, size, fault=_too_long(length, MAX_RECORD_BYTES))
            elif opcode in (Op.SCHEMA, Op.CHANNEL):
                if at + size > end:
                    return Span(at, size, fault=_too_long(length, _MAX_DEFINITION_BYTES))
                if not self._learn(opcode, bytes(view[at + HEAD.size : at + size])):
                    return Span(at, fault=f"expected a {Op(opcode).name.lower()}, found garbage")
            elif opcode in _OF_THE_FILE:
                return Span(at, opcode=opcode, length=length)
            elif opcode not in _SKIPPED and opcode != Op.HEADER and opcode < Op.PRIVATE:
                return Span(at, fault=f"expected a record, found one of kind 0x{opcode:02x}")
            at += size

    def gather(self, data: U8Array, starts: list[int]) -> Iterator[Portion]:
        """The selected messages among those at `starts`, which is then empty."""
        if not starts:
            return
        at = np.array(starts, np.int64)
        starts.clear()
        head = records(data, _MESSAGE, at)
        selected = self._selected[head["channel"]]
        if not selected.all():
            at = at[selected]
            head = head[selected]
        if len(at):
            end = at + head["length"].astype(np.int64) + HEAD.size
            channel = head["channel"].astype(np.int64)
            log_ns = head["log_ns"].astype(np.int64)
            yield Portion(data, at + _MESSAGE.itemsize, end, log_ns, channel)

    def _learn(self, opcode: int, body: bytes) -> bool:
        """Add a schema or a channel; False if it cannot be parsed."""
        # Many MCAP writers repeat them in every chunk.
        if self.channels.knows(opcode, body):
            return True
        if not self.channels.add(opcode, body):
            return False
        if opcode == Op.CHANNEL:
            [number] = _CHANNEL.unpack_from(body)
            self._selected[number] = self.selects(self.channels.topics[number])
        return True


def _messages(view: memoryview, at: int, end: int, starts: list[int]) -> int:
    """Step over whole messages from `at` on; the place of the first other record."""
    head_at = HEAD.unpack_from
    last = end - HEAD.size - MESSAGE_HEAD_BYTES
    for _ in range(_MOST_STARTS - len(starts)):
        if at > last:
            break
        opcode, length = head_at(view, at)
        after = at + 9 + length
        if opcode != 5 or after > end or length < MESSAGE_HEAD_BYTES:
            break
        starts.append(at)
        at = after
    return at


# -- the file -------------------------------------------------------------------------------------


@dataclass(slots=True)
class Walk:
    """One pass over a file; `selects` is true for the topics to read.

    skip: places of chunks without selected messages; lost: messages, or chunks of unknown content,
    that could not be read; limit: place from which on nothing more is read; buffer_bytes: for
    tests, results do not depend on it; place: how far the walk has come in the file.
    """

    source: Source
    selects: Callable[[Topic], bool]
    channels: Channels
    skip: Set[int] = frozenset()
    notes: list[str] = field(default_factory=list)
    lost: int = 0
    limit: int | None = None
    buffer_bytes: int = BUFFER_BYTES
    place: int = 0
    _scanner: Scanner = field(init=False)
    # Place in the file; None outside of chunks.
    _chunk_end: int | None = None
    _done: bool = False
    # Bytes of an incomplete record at the window's first byte; 0: not known.
    _need: int = 0
    _decompressor: Decompressor = field(default_factory=Decompressor)

    def __post_init__(self) -> None:
        self._scanner = Scanner(self.selects, self.channels)

    def messages(self) -> Iterator[Portion]:
        """All selected messages; damage is noted, only a failing disk raises.

        topic: number of the channel in the file.
        """
        window = Window(self.source, self.buffer_bytes)
        window.begin = len(MAGIC)
        starts: list[int] = []
        while not self._done and window.refill(most=self._most):
            yield from self._walk(window, starts)
            self.place = window.place
            yield from self._scanner.gather(window.data, starts)
            if self.limit is not None and self.place >= self.limit:
                return
        if not self._done:
            yield from self._end(window)

    @property
    def _most(self) -> int:
        """How far the next bytes are read; 0: as far as the buffer goes."""
        return self._need + _AHEAD_BYTES if self._need >= _LARGE_BYTES else 0

    def _walk(self, window: Window, starts: list[int]) -> Iterator[Portion]:
        """Walk until more bytes are needed, or to the end of the data."""
        can_continue = True
        while can_continue:
            bound = window.end
            if self._chunk_end is not None:
                bound = self._chunk_end - window.place_of(0)
            span = self._scanner.scan(window.data, window.begin, min(window.end, bound), starts)
            window.begin = span.next
            self._need = span.need
            if span.full:
                yield from self._scanner.gather(window.data, starts)
                continue
            fault = span.fault
            if self._chunk_end is not None:
                if span.next == bound:
                    self._chunk_end = None
                    continue
                fault = fault or _fault_in_chunk(span, bound)
            if fault:
                can_continue = self._recover(window, fault)
            elif span.opcode == Op.CHUNK:
                can_continue = yield from self._enter(window, span.length, starts)
            else:
                self._done = span.opcode != 0
                return

    def _recover(self, window: Window, fault: str) -> bool:
        """Continue behind the chunk; False outside of chunks, where this is the end."""
        self.lost += 1
        if self._chunk_end is None:
            self._note_end(window.place, f"{fault}; the rest of the file was not read")
            self._done = True
            return False
        self._note(window.place, f"{fault}; the rest of the chunk was not read")
        window.begin = self._chunk_end - window.place_of(0)
        self._chunk_end = None
        return True

    def _enter(
        self, window: Window, length: int, starts: list[int]
    ) -> Generator[Portion, None, bool]:
        """Read the chunk at the window's first byte; False if more of it is needed."""
        at = window.begin
        place = window.place
        after = at + HEAD.size + length
        if window.end - at < HEAD.size + min(length, CHUNK_HEAD_BYTES):
            return False
        head = chunk_head(window.data.data, at + HEAD.size, length)
        if head is None:
            return self._recover(window, "expected a chunk whose lengths agree, found others")
        fault = _fault_of(head)
        if place in self.skip:
            window.begin = after
        elif not head.compression:
            self._chunk_end = window.place_of(after)
            window.begin = at + HEAD.size + head.start
        elif fault:
            self.lost += 1
            self._note(place, f"{fault}; the chunk was not read")
            window.begin = after
        elif after > window.end:
            self._need = after - at
            return False
        else:
            yield from self._scanner.gather(window.data, starts)
            fault = yield from self._compressed(window, head)
            if fault:
                self.lost += 1
                self._note(place, f"{fault}; the rest of the chunk was not read")
            window.begin = after
        return True

    def _compressed(self, window: Window, head: ChunkHead) -> Generator[Portion, None, str]:
        """Messages of the compressed chunk at the window's first byte; returns its fault or ""."""
        begin = window.begin + HEAD.size + head.start
        stored = window.data.data[begin : min(begin + head.length, window.end)]
        data = self._decompressor.decompress(head.compression, stored, head.size)
        starts: list[int] = []
        span = Span(0, full=True)
        while span.full:
            span = self._scanner.scan(data, span.next, len(data), starts)
            yield from self._scanner.gather(data, starts)
        if len(data) < head.size:
            return (
                f"expected {head.size} bytes of {head.compression} data, found {len(data)} before "
                "their end or a fault"
            )
        whole = span.next == len(data) and not span.fault
        return "" if whole else span.fault or _fault_in_chunk(span, len(data))

    def _end(self, window: Window) -> Iterator[Portion]:
        """The file has no footer: read what is whole, note what is lost."""
        left = window.end - window.begin
        if left <= 0 and self._chunk_end is None:
            at_end = "was cut off between records" if left == 0 else "ends within a record"
            place = window.place_of(window.end)
            self._note_end(place, f"the file {at_end}: expected its footer; the rest was read")
            return
        opcode = int(Op.MESSAGE)
        expected = HEAD.size
        if left >= HEAD.size:
            opcode, length = HEAD.unpack_from(window.data.data, window.begin)
            expected = HEAD.size + length
            if opcode == Op.CHUNK and left >= HEAD.size + min(length, CHUNK_HEAD_BYTES):
                head = chunk_head(window.data.data, window.begin + HEAD.size, length)
                if head is not None and head.compression and not _fault_of(head):
                    yield from self._compressed(window, head)
        what = "record"
        # Attachments, metadata and indexes are no loss.
        self.lost += self._chunk_end is not None or opcode in (Op.MESSAGE, Op.CHUNK)
        if self._chunk_end is not None:
            expected = self._chunk_end - window.place
            what = "chunk"
        source_fault = f" ({self.source.fault})" if self.source.fault else ""
        self._note_end(
            window.place,
            f"the file ends within a {what}{source_fault}: expected {expected} bytes, found "
            f"{max(left, 0)}; complete records were read",
        )

    def _note(self, place: int, text: str) -> None:
        if len(self.notes) < MOST_NOTES:
            self.notes.append(f"byte {place}: {text}")

    def _note_end(self, place: int, text: str) -> None:
        """Note why the walk ends early, after any number of other notes."""
        self.notes.append(CutOff(f"byte {place}: {text}"))


def _fault_in_chunk(span: Span, bound: int) -> str:
    """Error text for a span whose chunk ends at `bound`; "" if it is good."""
    if span.opcode:
        return f"expected a record of a chunk, found one of kind 0x{span.opcode:02x}"
    if span.next + span.need > bound:
        return "expected a record that ends within its chunk, found a longer one"
    return ""


def _fault_of(head: ChunkHead) -> str:
    """Why a chunk cannot be decompressed, or ""."""
    if head.compression not in _COMPRESSIONS:
        return f"expected a chunk without compression, lz4 or zstd, found {head.compression!r}"
    return _too_long(max(head.size, head.length), MAX_RECORD_BYTES)


def _too_long(length: int, limit: int) -> str:
    """Error text for a record of this length; "" if it is good."""
    if length <= limit:
        return ""
    return f"expected a record of at most {limit} bytes, found one of {length}"
