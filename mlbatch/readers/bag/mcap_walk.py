"""Walk over the records of an MCAP file, from its front to its end, without an index.

Source: MCAP specification (mcap.dev/spec), facts/messages.md section 5. A chunk that is not
compressed is entered like any other stretch of the file, so that its messages stay where they were
read to; others are unpacked one at a time. The walk survives what it cannot read: a fault inside a
chunk costs the rest of that chunk, one outside the rest of the file; both are told in `notes`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Iterator, Set
from dataclasses import dataclass, field

import numpy as np

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
from mlbatch.readers.bag.recording import MOST_NOTES
from mlbatch.readers.byte_records import records
from mlbatch.readers.source import (
    BUFFER_BYTES,
    MAX_RECORD_BYTES,
    SkippingSource,
    Unzipper,
    Window,
)
from mlbatch.types import BoolArray, I64Array, Topic, U8Array

_COMPRESSIONS = ("lz4", "zstd")


@dataclass(slots=True)
class Walk:
    """One pass over a file; `wants` tells which topics' messages are asked for.

    skip: places of chunks that hold nothing of interest; lost: messages, or chunks of unknown
    content, that could not be read; limit: place from which on nothing more is read; buffer_bytes:
    for tests, results do not depend on it; place: how far the walk has come in the file.
    """

    source: SkippingSource
    wants: Callable[[Topic], bool]
    channels: Channels
    skip: Set[int] = frozenset()
    notes: list[str] = field(default_factory=list)
    lost: int = 0
    limit: int | None = None
    buffer_bytes: int = BUFFER_BYTES
    place: int = 0
    _scanner: Scanner = field(init=False)
    _chunk_end: int | None = None  # In the file; None outside of chunks.
    _done: bool = False
    _unzipper: Unzipper = field(default_factory=Unzipper)

    def __post_init__(self) -> None:
        self._scanner = Scanner(self.wants, self.channels)

    def messages(self) -> Iterator[Messages]:
        """All wanted messages; nothing is raised for damage, only for a disk that fails."""
        window = Window(self.source, self.buffer_bytes)
        window.begin = len(MAGIC)
        starts: list[int] = []
        while not self._done and window.refill():
            yield from self._walk(window, starts)
            self.place = window.place
            yield from self._scanner.gather(window.data, starts)
            if self.limit is not None and self.place >= self.limit:
                return
        if not self._done:
            yield from self._end(window)

    # -- the file's level ---------------------------------------------------------------------

    def _walk(self, window: Window, starts: list[int]) -> Iterator[Messages]:
        """Walk until more bytes are needed, or to the end of the data."""
        go_on = True
        while go_on:
            bound = window.end
            if self._chunk_end is not None:
                bound = self._chunk_end - window.place_of(0)
            stretch = self._scanner.scan(window.data, window.begin, min(window.end, bound), starts)
            window.begin = stretch.next
            if stretch.full:
                yield from self._scanner.gather(window.data, starts)
                continue
            fault = stretch.fault
            if self._chunk_end is not None:
                if stretch.next == bound:
                    self._chunk_end = None
                    continue
                fault = fault or _fault_in_chunk(stretch, bound)
            if fault:
                go_on = self._recover(window, fault)
            elif stretch.opcode == Op.CHUNK:
                go_on = yield from self._enter(window, stretch.length, starts)
            else:
                self._done = stretch.opcode != 0
                return

    def _recover(self, window: Window, fault: str) -> bool:
        """Go on behind the chunk; False if there is none and this is the end."""
        self.lost += 1
        rest = "file" if self._chunk_end is None else "chunk"
        self._note(window.place, f"{fault}; the rest of the {rest} was not read")
        if self._chunk_end is None:
            self._done = True
            return False
        window.begin = self._chunk_end - window.place_of(0)
        self._chunk_end = None
        return True

    def _enter(
        self, window: Window, length: int, starts: list[int]
    ) -> Generator[Messages, None, bool]:
        """Deal with the chunk at the window's first byte; False if more of it is needed."""
        at, place = window.begin, window.place
        after = at + HEAD.size + length
        if window.end - at < HEAD.size + min(length, CHUNK_HEAD_BYTES):
            return False
        head = chunk_head(window.data.data, at + HEAD.size, length)
        if head is None:
            return self._recover(window, "wanted a chunk whose lengths agree, got others")
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
            return False
        else:
            yield from self._scanner.gather(window.data, starts)
            fault = yield from self._unzipped(window, head)
            if fault:
                self.lost += 1
                self._note(place, f"{fault}; the rest of the chunk was not read")
            window.begin = after
        return True

    def _unzipped(self, window: Window, head: ChunkHead) -> Generator[Messages, None, str]:
        """Messages of the compressed chunk at the window's first byte; what is wrong with it."""
        begin = window.begin + HEAD.size + head.start
        stored = window.data.data[begin : min(begin + head.length, window.end)]
        data = self._unzipper.unpack(head.compression, stored, head.size)
        starts: list[int] = []
        stretch = Stretch(0, full=True)
        while stretch.full:
            stretch = self._scanner.scan(data, stretch.next, len(data), starts)
            yield from self._scanner.gather(data, starts)
        if len(data) < head.size:
            return (
                f"wanted {head.size} bytes of {head.compression} data, got {len(data)} before "
                "their end or a fault"
            )
        whole = stretch.next == len(data) and not stretch.fault
        return "" if whole else stretch.fault or _fault_in_chunk(stretch, len(data))

    def _end(self, window: Window) -> Iterator[Messages]:
        """The file ends where it should not: read what is whole, tell what is lost."""
        left = window.end - window.begin
        if left <= 0 and self._chunk_end is None:
            at_end = "was cut off between records" if left == 0 else "ends within a record"
            place = window.place_of(window.end)
            self._note(place, f"the file {at_end}: wanted its footer; the rest was read")
            return
        opcode, wanted, what = Op.MESSAGE, HEAD.size, "record"
        if left >= HEAD.size:
            opcode, length = HEAD.unpack_from(window.data.data, window.begin)
            wanted = HEAD.size + length
            if opcode == Op.CHUNK and left >= HEAD.size + min(length, CHUNK_HEAD_BYTES):
                head = chunk_head(window.data.data, window.begin + HEAD.size, length)
                if head is not None and head.compression and not _fault_of(head):
                    yield from self._unzipped(window, head)
        # Attachments, metadata and indexes hold nothing of what is read.
        self.lost += self._chunk_end is not None or opcode in (Op.MESSAGE, Op.CHUNK)
        if self._chunk_end is not None:
            wanted, what = self._chunk_end - window.place, "chunk"
        source_fault = f" ({self.source.fault})" if self.source.fault else ""
        self._note(
            window.place,
            f"the file ends within a {what}{source_fault}: wanted {wanted} bytes, got "
            f"{max(left, 0)}; what is whole was read",
        )

    def _note(self, place: int, text: str) -> None:
        if len(self.notes) < MOST_NOTES:
            self.notes.append(f"byte {place}: {text}")


def _fault_in_chunk(stretch: Stretch, bound: int) -> str:
    """What is wrong with a stretch whose chunk ends at `bound`."""
    if stretch.opcode:
        return f"wanted a record of a chunk, got one of kind 0x{stretch.opcode:02x}"
    if stretch.next + stretch.need > bound:
        return "wanted a record that ends within its chunk, got a longer one"
    return ""


def _fault_of(head: ChunkHead) -> str:
    """Why a chunk cannot be unpacked."""
    if head.compression not in _COMPRESSIONS:
        return f"wanted a chunk without compression, lz4 or zstd, got {head.compression!r}"
    return too_long(max(head.size, head.length), MAX_RECORD_BYTES)


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
# Messages may be as short as their heads: so many places are kept at a time.
_MOST_STARTS = 1 << 18
# Records that stand outside chunks; the others may stand anywhere.
_OF_THE_FILE = (Op.CHUNK, Op.DATA_END, Op.FOOTER)
_SKIPPED = range(Op.CHUNK + 1, Op.DATA_END)


@dataclass(slots=True)
class Messages:
    """Messages of wanted channels in file order, (n,) int64 each.

    Message i is `data[begin[i] : end[i]]`; valid until the next ones are asked for.
    """

    data: U8Array
    channel: I64Array
    begin: I64Array
    end: I64Array
    log_ns: I64Array


@dataclass(slots=True)
class Stretch:
    """How far records could be walked: to byte `next`, which may lie behind the stretch.

    need: bytes that the record there takes, 0 if nothing is known to be missing; opcode: of a
    record there that only stands outside chunks, or 0; fault: why there is no going on; full: the
    messages found so far have to be gathered first.
    """

    next: int
    need: int = 0
    opcode: int = 0
    length: int = 0
    fault: str = ""
    full: bool = False


@dataclass(slots=True)
class Scanner:
    """Finds messages in bytes; `wants` tells which topics' messages are asked for."""

    wants: Callable[[Topic], bool]
    channels: Channels
    _wanted: BoolArray = field(default_factory=lambda: np.zeros(1 << 16, bool))

    def __post_init__(self) -> None:
        for number, topic in self.channels.topics.items():
            self._wanted[number] = self.wants(topic)

    def scan(self, data: U8Array, at: int, end: int, starts: list[int]) -> Stretch:
        """Walk over `data[at:end]`; places of whole messages are added to `starts`."""
        view = data.data
        while True:
            at = _messages(view, at, end, starts)
            if len(starts) >= _MOST_STARTS:
                return Stretch(at, full=True)
            if at + HEAD.size > end:
                return Stretch(at, HEAD.size if at < end else 0)
            opcode, length = HEAD.unpack_from(view, at)
            size = HEAD.size + length
            if opcode == Op.MESSAGE:
                if length < MESSAGE_HEAD_BYTES:
                    return Stretch(at, fault=f"wanted a message, got a record of {length} bytes")
                if at + HEAD.size + _CHANNEL.size > end:
                    return Stretch(at, size)
                [channel] = _CHANNEL.unpack_from(view, at + HEAD.size)
                if self._wanted[channel]:
                    return Stretch(at, size, fault=too_long(length, MAX_RECORD_BYTES))
            elif opcode in (Op.SCHEMA, Op.CHANNEL):
                if at + size > end:
                    return Stretch(at, size, fault=too_long(length, _MAX_DEFINITION_BYTES))
                if not self._learn(opcode, bytes(view[at + HEAD.size : at + size])):
                    return Stretch(at, fault=f"wanted a {Op(opcode).name.lower()}, got garbage")
            elif opcode in _OF_THE_FILE:
                return Stretch(at, opcode=opcode, length=length)
            elif opcode not in _SKIPPED and opcode != Op.HEADER and opcode < Op.PRIVATE:
                return Stretch(at, fault=f"wanted a record, got one of kind 0x{opcode:02x}")
            at += size

    def gather(self, data: U8Array, starts: list[int]) -> Iterator[Messages]:
        """Those of the messages at `starts` that are wanted; `starts` is then empty."""
        if not starts:
            return
        at = np.array(starts, np.int64)
        starts.clear()
        head = records(data, _MESSAGE, at)
        wanted = self._wanted[head["channel"]]
        if not wanted.all():
            at, head = at[wanted], head[wanted]
        if len(at):
            end = at + head["length"].astype(np.int64) + HEAD.size
            channel = head["channel"].astype(np.int64)
            log_ns = head["log_ns"].astype(np.int64)
            yield Messages(data, channel, at + _MESSAGE.itemsize, end, log_ns)

    def _learn(self, opcode: int, body: bytes) -> bool:
        """Take in a schema or a channel; False if it is none."""
        # Many recorders repeat them in every chunk.
        if self.channels.knows(opcode, body):
            return True
        if not self.channels.add(opcode, body):
            return False
        if opcode == Op.CHANNEL:
            [number] = _CHANNEL.unpack_from(body)
            self._wanted[number] = self.wants(self.channels.topics[number])
        return True


def _messages(view: memoryview, at: int, end: int, starts: list[int]) -> int:
    """Step over whole messages from `at` on; the place of the first record that is none."""
    head_at, last = HEAD.unpack_from, end - HEAD.size - MESSAGE_HEAD_BYTES
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


def too_long(length: int, limit: int) -> str:
    """What is wrong with a record of this length; empty if nothing is."""
    if length <= limit:
        return ""
    return f"wanted a record of at most {limit} bytes, got one of {length}"
