"""The indexes of an MCAP file against what they index: message indexes and the summary section."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field

from mlbatch.verify.encoding import Cursor
from mlbatch.verify.verdict import DamageError, Judge

_HEAD = struct.Struct("<BQ")
_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _CHUNK_INDEX, _ATTACHMENT_INDEX, _STATISTICS, _METADATA_INDEX = 2, 8, 10, 11, 13
_FOOTER_BODY = struct.Struct("<QQI")


@dataclass(slots=True)
class ChunkPlace:
    """A chunk as it was read; messages: (log time, offset) by channel; indexes: the same as said.

    content, stored: bytes of its records, and as they lie in the file; index_at: places of its
    message indexes by channel; index_bytes: of all of them.
    """

    at: int
    size: int
    content: int
    compression: str
    stored: int
    messages: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    indexes: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    index_at: dict[int, int] = field(default_factory=dict)
    index_bytes: int = 0
    is_broken: bool = False
    first_ns: int | None = None
    last_ns: int = 0

    def add(self, channel: int, log_ns: int, at: int) -> None:
        """Note a message."""
        self.messages.setdefault(channel, []).append((log_ns, at))
        self.first_ns = log_ns if self.first_ns is None else min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time."""
        return self.first_ns or 0, self.last_ns

    def settle(self, judge: Judge, where: str) -> None:
        """Hold the message indexes against the messages; neither is needed any more."""
        if not self.is_broken:
            name = f"{where} message indexes after the chunk at byte {self.at}"
            judge.equal("container", name, self.messages, self.indexes)
        self.messages, self.indexes = {}, {}


@dataclass(slots=True)
class Found:
    """What a file holds; counts: messages by channel."""

    chunks: list[ChunkPlace] = field(default_factory=list)
    metadata: list[tuple[int, int, str]] = field(default_factory=list)
    attachments: list[tuple[int, int, int, int, int, str, str]] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    first_ns: int | None = None
    last_ns: int = 0
    channels: int = 0
    schemas: int = 0

    def add(self, channel: int, log_ns: int) -> None:
        """Note a message."""
        self.counts[channel] += 1
        self.first_ns = log_ns if self.first_ns is None else min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)

    def index(self, cursor: Cursor, at: int, size: int) -> None:
        """Note a message index; it belongs to the chunk before it."""
        if not self.chunks:
            return
        chunk = self.chunks[-1]
        number = cursor.whole("H")
        chunk.indexes[number] = cursor.part().pairs(_times)
        chunk.index_at[number] = at
        chunk.index_bytes += size


def check_summary(judge: Judge, where: str, found: Found, summary: bytes, at: int) -> None:
    """Hold message indexes and the bytes after the data, which begin at `at`, against the file."""
    if not judge.equal("container", f"{where} last bytes", _MAGIC, summary[-len(_MAGIC) :]):
        return
    footer_at = len(summary) - len(_MAGIC) - _FOOTER_BODY.size
    if footer_at < _HEAD.size:
        judge.blame("container", f"{where} footer", "a footer", f"{len(summary)} bytes")
        return
    begin, _, crc = _FOOTER_BODY.unpack_from(summary, footer_at)
    judge.equal("container", f"{where} start of the summary", at, begin)
    actual = zlib.crc32(summary[: footer_at + _FOOTER_BODY.size - 4])
    if not judge.equal("container", f"{where} CRC of the summary", f"{actual:08x}", f"{crc:08x}"):
        return
    try:
        _check_records(judge, where, found, summary[: footer_at - _HEAD.size])
    except DamageError as err:
        judge.blame("container", f"{where} summary", err.wanted, err.got)


def _check_records(judge: Judge, where: str, found: Found, summary: bytes) -> None:
    """The records of the summary, up to the footer."""
    said: dict[int, list[object]] = {}
    readers = {
        _CHUNK_INDEX: _chunk_index,
        _STATISTICS: _statistics,
        _ATTACHMENT_INDEX: _attachment_index,
        _METADATA_INDEX: _metadata_index,
    }
    data, at = memoryview(summary), 0
    while at + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        body = data[at + _HEAD.size : at + _HEAD.size + length]
        if opcode in readers:
            said.setdefault(opcode, []).append(readers[opcode](Cursor(body)))
        at += _HEAD.size + length
    if any(chunk.is_broken for chunk in found.chunks):
        return  # Its messages are not known.
    chunks = [
        (*c.span_ns, c.at, c.size, c.index_at, c.index_bytes, c.compression, c.stored, c.content)
        for c in found.chunks
    ]
    statistics = (
        *(found.counts.total(), found.schemas, found.channels, len(found.attachments)),
        *(len(found.metadata), len(found.chunks), found.first_ns or 0, found.last_ns),
        dict(found.counts),
    )
    for name, opcode, wanted in (
        ("chunk index", _CHUNK_INDEX, chunks),
        ("statistics", _STATISTICS, [statistics]),
        ("attachment index", _ATTACHMENT_INDEX, found.attachments),
        ("metadata index", _METADATA_INDEX, found.metadata),
    ):
        _compare(judge, f"{where} {name}", list(wanted), said.get(opcode, []))


def _compare(judge: Judge, where: str, wanted: list[object], got: list[object]) -> None:
    judge.equal("container", f"{where} entries", len(wanted), len(got))
    for i, (one, other) in enumerate(zip(wanted, got, strict=False)):
        judge.equal("container", f"{where} {i}", one, other)


def _times(cursor: Cursor) -> tuple[int, int]:
    return cursor.whole("Q"), cursor.whole("Q")


def _counts(cursor: Cursor) -> tuple[int, int]:
    return cursor.whole("H"), cursor.whole("Q")


def _chunk_index(cursor: Cursor) -> object:
    head = tuple(cursor.whole("Q") for _ in range(4))
    places = dict(cursor.part().pairs(_counts))
    size, compression = cursor.whole("Q"), cursor.text()
    return (*head, places, size, compression, cursor.whole("Q"), cursor.whole("Q"))


def _statistics(cursor: Cursor) -> object:
    head = (cursor.whole("Q"), cursor.whole("H"), *(cursor.whole("I") for _ in range(4)))
    return (*head, cursor.whole("Q"), cursor.whole("Q"), dict(cursor.part().pairs(_counts)))


def _attachment_index(cursor: Cursor) -> object:
    return (*(cursor.whole("Q") for _ in range(5)), cursor.text(), cursor.text())


def _metadata_index(cursor: Cursor) -> object:
    return (cursor.whole("Q"), cursor.whole("Q"), cursor.text())
