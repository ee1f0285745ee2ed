"""Walk over the records of an MCAP file, from its front to its end, without an index.

Source: MCAP specification (mcap.dev/spec), facts/messages.md section 5. A chunk that is not
compressed is entered like any other stretch of the file, so that its messages stay where they were
read to; others are unpacked one at a time. The walk survives what it cannot read: a fault inside a
chunk costs the rest of that chunk, one outside the rest of the file; both are told in `notes`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Set
from dataclasses import dataclass, field

from mlbatch.readers._bag import MOST_NOTES
from mlbatch.readers._mcap_bytes import (
    BUFFER_BYTES,
    MAX_RECORD_BYTES,
    SkippingSource,
    Unzipper,
    Window,
)
from mlbatch.readers._mcap_records import (
    CHUNK_HEAD_BYTES,
    HEAD,
    MAGIC,
    Channels,
    ChunkHead,
    Op,
    chunk_head,
)
from mlbatch.readers._mcap_scan import Messages, Scanner, Stretch, too_long
from mlbatch.types import Topic

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
