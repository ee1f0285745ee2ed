"""Records of an MCAP file other than messages: channels, chunks and the summary.

Layouts: MCAP specification (mcap.dev/spec) and its registry of encodings
(docs/sources/messages.md, section 5). Small records are parsed by the library `mcap`, from bytes
that are already in memory, so that no length within them can allocate more.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from io import BytesIO
from typing import TYPE_CHECKING

from mlbatch.readers.bag.recording import is_latched
from mlbatch.ros.definitions import type_key
from mlbatch.types import Topic

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

MAGIC = b"\x89MCAP0\r\n"
# Opcode, and length of the body.
HEAD = struct.Struct("<BQ")


class Op(IntEnum):
    """First byte of a record."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    CHUNK_INDEX = 0x08
    STATISTICS = 0x0B
    DATA_END = 0x0F
    PRIVATE = 0x80  # From here on records of applications, which are skipped.


# Body of a message before its data: channel, sequence, two times.
MESSAGE_HEAD_BYTES = 22
# First and last time, size of the records, their CRC, length of the compression's name.
_CHUNK_HEAD = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_LONGEST_NAME = 64
CHUNK_HEAD_BYTES = _CHUNK_HEAD.size + _LONGEST_NAME + _LENGTH.size
# Record of two places and a CRC; with the magic the last bytes of a whole file.
_FOOTER = struct.Struct("<BQQQI")
FOOTER_BYTES = _FOOTER.size + len(MAGIC)
# Messages, schemas, channels, attachments, metadata, chunks, first and last log time.
_STATISTICS = struct.Struct("<QHIIIIQQ")
_INDEX_HEAD = struct.Struct("<QQQQI")
_INDEX_ENTRY = struct.Struct("<HQ")

_LATCHED_ROS1 = frozenset({"1", "true", "True"})
# Bytes of schemas and channels that are remembered as known.
_MOST_KNOWN_BYTES = 64 << 20


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """Head of a chunk; start: of its records in the body; length: theirs as stored; size: plain."""

    compression: str
    start: int
    length: int
    size: int


def chunk_head(data: memoryview, at: int, length: int) -> ChunkHead | None:
    """The head of the chunk whose body of `length` bytes begins at `at`; None: contradictory."""
    if length < _CHUNK_HEAD.size + _LENGTH.size:
        return None
    *_, size, _, name_length = _CHUNK_HEAD.unpack_from(data, at)
    if name_length > min(_LONGEST_NAME, length - _CHUNK_HEAD.size - _LENGTH.size):
        return None
    name_at = at + _CHUNK_HEAD.size
    name = bytes(data[name_at : name_at + name_length]).decode("ascii", "replace")
    start = _CHUNK_HEAD.size + name_length + _LENGTH.size
    [stored] = _LENGTH.unpack_from(data, at + start - _LENGTH.size)
    return None if stored > length - start else ChunkHead(name, start, stored, size)


@dataclass(slots=True)
class Channels:
    """Schemas and channels so far; topics: by the channel's number."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    topics: dict[int, Topic] = field(default_factory=dict)
    _known: set[tuple[int, bytes]] = field(default_factory=set)
    _known_bytes: int = 0
    # Texts of schemas: channels share them, since many may name one long schema.
    _texts: dict[int, str] = field(default_factory=dict)

    def knows(self, opcode: int, body: bytes) -> bool:
        """Whether the same schema or channel was added before."""
        return (opcode, body) in self._known

    def add(self, opcode: int, body: bytes) -> bool:
        """Add a schema or a channel; False if it cannot be parsed."""
        from mcap.data_stream import ReadDataStream
        from mcap.exceptions import EndOfFile
        from mcap.records import Channel, Schema

        stream = ReadDataStream(BytesIO(body))
        try:
            if opcode == Op.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema
                # Definitions that are no text are kept byte for byte.
                self._texts[schema.id] = schema.data.decode("utf-8", "surrogateescape")
            else:
                channel = Channel.read(stream)
                schema_id = channel.schema_id
                text = self._texts.get(schema_id, "")
                self.topics[channel.id] = _topic(channel, self.schemas.get(schema_id), text)
        except (EndOfFile, struct.error, UnicodeDecodeError):
            return False
        if self._known_bytes > _MOST_KNOWN_BYTES:
            self._known = set()
            self._known_bytes = 0
        self._known.add((opcode, body))
        self._known_bytes += len(body)
        return True


def _topic(channel: Channel, schema: Schema | None, definition: str) -> Topic:
    metadata = channel.metadata
    qos = metadata.get("offered_qos_profiles", "")
    latched = metadata.get("latching", "") in _LATCHED_ROS1 or is_latched(qos)
    return Topic(
        name=channel.topic,
        type="" if schema is None else type_key(schema.name),
        encoding=channel.message_encoding,
        definition=definition,
        format="" if schema is None else schema.encoding,
        qos=qos,
        latched=latched,
    )


def summary_start(tail: bytes) -> int | None:
    """Position of the summary, by the last FOOTER_BYTES of a file; 0: none; None: cut off."""
    if len(tail) != FOOTER_BYTES or not tail.endswith(MAGIC):
        return None
    opcode, length, start, _, _ = _FOOTER.unpack_from(tail)
    return start if (opcode, length) == (Op.FOOTER, _FOOTER.size - HEAD.size) else None


def last_log_ns(statistics: bytes) -> int | None:
    """Newest log time by the body of a statistics record; None without a message."""
    if len(statistics) < _STATISTICS.size:
        return None
    messages, *_, last_ns = _STATISTICS.unpack_from(statistics)
    return int(last_ns) if messages else None


def records_of(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and body of the whole records from the front of `data`."""
    at = 0
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if length > len(data) - at:
            return
        yield opcode, data[at : at + length]
        at += length


def chunk_of_index(body: bytes) -> tuple[int, frozenset[int]] | None:
    """Place of a chunk and its channels with messages; None for an index without channels."""
    if len(body) < _INDEX_HEAD.size:
        return None
    *_, start, _, length = _INDEX_HEAD.unpack_from(body)
    entries = body[_INDEX_HEAD.size : _INDEX_HEAD.size + length]
    if not length or len(entries) != length or length % _INDEX_ENTRY.size:
        return None
    return start, frozenset(number for number, _ in _INDEX_ENTRY.iter_unpack(entries))
