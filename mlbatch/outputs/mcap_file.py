"""MCAP files: chunks, message indexes, statistics and checksums, checked against each other.

`mcap` parses the records. Source: mcap.dev/spec.
"""

from __future__ import annotations

import importlib
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import zstandard
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader

from mlbatch.outputs.containers import (
    BoundedFile,
    Message,
    WholeReads,
    check_unpacked_size,
    library_errors,
)
from mlbatch.outputs.damage import CheckLog, DamageError, VerifyError

MCAP_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_FOOTER_BYTES = _HEAD.size + 20
# Of a chunk: all but compression and records.
_CHUNK_BYTES = 40
_HEADER = 1
_MESSAGE = 5
_CHUNK = 6
_MESSAGE_INDEX = 7
_ATTACHMENT = 9
_METADATA = 12
_DATA_END = 15
_PIECE_BYTES = 1 << 20
# Log time and offset of each message, by channel.
Index: TypeAlias = dict[int, list[tuple[int, int]]]


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a record is in the file."""

    opcode: int
    # Offset of the record in the file, with its head.
    at: int
    # Bytes with the head.
    size: int


@dataclass(slots=True)
class _ChunkFound:
    """What was read of one chunk and of its message indexes."""

    place: _Place
    compression: str
    # Bytes in the file.
    stored_size: int
    # Uncompressed.
    size: int = 0
    # False where the chunk is damaged: its messages are not known.
    whole: bool = False
    # (log time, offset) of the messages found, by channel.
    messages: Index = field(default_factory=dict)
    # The same as the message indexes have it.
    indexed: Index = field(default_factory=dict)
    # Offset of the message index of each channel.
    index_at: dict[int, int] = field(default_factory=dict)
    # Of all message indexes.
    index_bytes: int = 0
    # First and last log time.
    first_ns: int | None = None
    last_ns: int = 0

    def add(self, channel: int, log_ns: int, offset: int) -> None:
        """Count a message."""
        self.messages.setdefault(channel, []).append((log_ns, offset))
        self.first_ns = log_ns if self.first_ns is None else min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)

    def index_record(self) -> McapRecord:
        """The record that the summary should contain."""
        return ChunkIndex(
            chunk_length=self.place.size,
            chunk_start_offset=self.place.at,
            compression=self.compression,
            compressed_size=self.stored_size,
            message_end_time=self.last_ns,
            message_index_length=self.index_bytes,
            message_index_offsets=self.index_at,
            message_start_time=self.first_ns or 0,
            uncompressed_size=self.size,
        )


class McapFile:
    """An MCAP file of mlbatch; its metadata and attachments are read at once."""

    def __init__(self, log: CheckLog, path: Path, where: str) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.profile = ""
        self.library = ""
        # First and last log time, after all messages are read.
        self.span_ns = (0, 0)
        self._log = log
        self._path = path
        self._where = where
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str, str]] = {}
        self._counts: Counter[int] = Counter()
        self._chunk: _ChunkFound | None = None
        self._damaged = False
        self._counted = False
        # Index records that the summary should contain.
        self._chunk_indexes: list[McapRecord] = []
        self._metadata_indexes: list[McapRecord] = []
        self._attachment_indexes: list[McapRecord] = []
        with BoundedFile(path) as file:
            if file.read(min(len(MCAP_MAGIC), file.size)) != MCAP_MAGIC:
                raise VerifyError(f"{path}: expected an MCAP file, found another; convert again")
            for place in self._places(file):
                if place.opcode in (_HEADER, _ATTACHMENT, _METADATA):
                    try:
                        self._describe_file(file, place)
                    except DamageError as err:
                        raise VerifyError(f"{path}: byte {place.at}: {err}; convert again") from err

    def _places(self, file: BoundedFile) -> Iterator[_Place]:
        """All records to the end of the data section."""
        at = len(MCAP_MAGIC)
        opcode = 0
        while opcode != _DATA_END:
            opcode = 0
            length = 0
            if at + _HEAD.size <= file.size:
                file.seek(at)
                opcode, length = _HEAD.unpack(file.read(_HEAD.size))
            size = _HEAD.size + length
            if not opcode or at + size + _FOOTER_BYTES + len(MCAP_MAGIC) > file.size:
                raise VerifyError(
                    f"{self._path}: expected a whole MCAP file, found one that ends or is damaged "
                    f"at byte {at}; convert again"
                )
            yield _Place(opcode, at, size)
            at += size

    def _describe_file(self, file: BoundedFile, place: _Place) -> None:
        """Read a header, metadata or attachment record."""
        data = _bytes_of(file, place)
        _, record = next(_records(data))
        if isinstance(record, Header):
            self.profile = record.profile
            self.library = record.library
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
            self._metadata_indexes.append(MetadataIndex(place.at, place.size, record.name))
        elif isinstance(record, Attachment):
            self.attachments[record.name] = record.data
            # The library skips this checksum.
            actual = zlib.crc32(memoryview(data)[_HEAD.size : -4])
            stored = int.from_bytes(data[-4:], "little")
            self._log.equal("container", f"{self._where} {record.name} CRC", actual, stored)
            self._attachment_indexes.append(
                AttachmentIndex(
                    offset=place.at,
                    length=place.size,
                    log_time=record.log_time,
                    create_time=record.create_time,
                    data_size=len(record.data),
                    name=record.name,
                    media_type=record.media_type,
                )
            )

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file; then the summary is checked against them."""
        with BoundedFile(self._path) as file:
            summary_at = 0
            for place in self._places(file):
                summary_at = place.at + place.size
                if place.opcode in (_CHUNK, _DATA_END):
                    self._finish_chunk()
                if place.opcode == _MESSAGE:
                    where = f"{self._where} byte {place.at}"
                    self._log.fail("container", where, "messages in chunks", "one outside")
                if place.opcode not in (_CHUNK, _MESSAGE_INDEX):
                    continue
                name = "chunk" if place.opcode == _CHUNK else "message index"
                try:
                    _, record = next(_records(_bytes_of(file, place)))
                    if isinstance(record, Chunk):
                        yield from self._chunk_messages(place, record)
                    elif isinstance(record, MessageIndex):
                        self._add_message_index(place, record)
                except DamageError as err:
                    self._damaged = True
                    where = f"{self._where} {name} at byte {place.at}"
                    self._log.fail("container", where, err.expected, err.found)
            file.seek(summary_at)
            summary = file.read()
        self._check_summary(summary, summary_at)

    def _chunk_messages(self, place: _Place, record: Chunk) -> Iterator[Message]:
        log = self._log
        where = f"{self._where} chunk at byte {place.at}"
        chunk = _ChunkFound(place, record.compression, len(record.data))
        self._chunk = chunk
        stored = _HEAD.size + _CHUNK_BYTES + len(record.compression.encode()) + len(record.data)
        if stored != place.size:
            raise DamageError(f"a chunk of {stored} bytes", f"{place.size} bytes")
        data = unpacked(record.compression, record.data, record.uncompressed_size)
        chunk.size = len(data)
        log.equal("container", f"{where} size", len(data), record.uncompressed_size)
        crc = f"{record.uncompressed_crc:08x}"
        if not log.equal("container", f"{where} CRC", f"{zlib.crc32(data):08x}", crc):
            return
        chunk.whole = True
        for offset, inner in _records(data):
            if isinstance(inner, McapMessage):
                yield self._message(inner)
                chunk.add(inner.channel_id, inner.log_time, offset)
            elif isinstance(inner, Channel):
                kind = self._schemas.get(inner.schema_id, "")
                self._channels[inner.id] = (inner.topic, kind, inner.message_encoding)
            elif isinstance(inner, Schema):
                self._schemas[inner.id] = inner.name.replace("/msg/", "/")
            else:
                found = f"{type(inner).__name__} at {offset}"
                raise DamageError("a schema, channel or message", found)
        said_ns = (record.message_start_time, record.message_end_time)
        span_ns = (chunk.first_ns or 0, chunk.last_ns)
        log.equal("container", f"{where} first and last", span_ns, said_ns)

    def _message(self, message: McapMessage) -> Message:
        channel = self._channels.get(message.channel_id)
        if channel is None:
            raise DamageError("a message of a channel before it", f"channel {message.channel_id}")
        topic, kind, encoding = channel
        number = self._counts[message.channel_id]
        self._counts[message.channel_id] += 1
        where = f"{self._where} {topic} message {number}"
        self._log.equal("container", f"{where} sequence", number, message.sequence)
        return Message(
            where, topic, kind, encoding, message.log_time, message.publish_time, message.data
        )

    def _add_message_index(self, place: _Place, index: MessageIndex) -> None:
        chunk = self._chunk
        if chunk is None:
            return
        chunk.indexed[index.channel_id] = index.records
        chunk.index_at[index.channel_id] = place.at
        chunk.index_bytes += place.size

    def _finish_chunk(self) -> None:
        """Check the message indexes of the last chunk; nothing but its index record is kept."""
        chunk = self._chunk
        if chunk is None:
            return
        self._chunk = None
        if not chunk.whole:
            self._damaged = True
            return
        where = f"{self._where} message indexes after the chunk at byte {chunk.place.at}"
        self._log.equal("container", where, chunk.messages, chunk.indexed)
        self._chunk_indexes.append(chunk.index_record())
        if chunk.first_ns is not None:
            first_ns, last_ns = self.span_ns if self._counted else (chunk.first_ns, 0)
            self.span_ns = (min(first_ns, chunk.first_ns), max(last_ns, chunk.last_ns))
            self._counted = True

    def _check_summary(self, data: bytes, at: int) -> None:
        """Check the summary section, `data` from byte `at` on, against what was read."""
        log = self._log
        where = self._where
        if not log.equal("container", f"{where} last bytes", MCAP_MAGIC, data[-len(MCAP_MAGIC) :]):
            return
        data = data[: -len(MCAP_MAGIC)]
        crc = f"{int.from_bytes(data[-4:], 'little'):08x}"
        actual = f"{zlib.crc32(data[:-4]):08x}"
        if not log.equal("container", f"{where} CRC of the summary", actual, crc):
            return
        try:
            records = [record for _, record in _records(data)]
        except DamageError as err:
            log.fail("container", f"{where} summary", err.expected, err.found)
            return
        footers = [record.summary_start for record in records if isinstance(record, Footer)]
        log.equal("container", f"{where} start of the summary", [at], footers)
        if self._damaged:
            return  # The messages of some chunks are not known.
        expected: dict[type[McapRecord], list[McapRecord]] = {
            ChunkIndex: self._chunk_indexes,
            Statistics: [self._statistics()],
            AttachmentIndex: self._attachment_indexes,
            MetadataIndex: self._metadata_indexes,
        }
        for kind, own in expected.items():
            name = f"{where} {kind.__name__}"
            found = [record for record in records if isinstance(record, kind)]
            log.equal("container", f"{name} records", len(own), len(found))
            for number, (one, other) in enumerate(zip(own, found, strict=False)):
                left = vars(one)
                right = vars(other)
                differs = [key for key in left if left[key] != right[key]]
                log.equal(
                    "container",
                    f"{name} {number}",
                    {key: left[key] for key in differs},
                    {key: right[key] for key in differs},
                )

    def _statistics(self) -> McapRecord:
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunk_indexes),
            message_count=self._counts.total(),
            message_end_time=self.span_ns[1],
            message_start_time=self.span_ns[0],
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )


def _bytes_of(file: BoundedFile, place: _Place) -> bytes:
    file.seek(place.at)
    return file.read(place.size)


def _records(data: bytes) -> Iterator[tuple[int, McapRecord]]:
    """The records in `data` as `mcap` reads them, with their offsets."""
    stream = WholeReads(data)
    records = StreamReader(stream, skip_magic=True, emit_chunks=True).records
    begin = 0
    while begin < len(data):
        try:
            record = next(records)
        except DamageError:
            raise
        except Exception as err:
            found = str(err) or type(err).__name__
            raise DamageError(f"an MCAP record at offset {begin}", found) from err
        # The library skips unknown records, and reads past the end of a record.
        length = _HEAD.unpack_from(data, begin)[1]
        end = stream.tell()
        if begin + _HEAD.size + length != end:
            size = end - begin - _HEAD.size
            raise DamageError(f"a record of {length} bytes at offset {begin}", f"{size} bytes")
        yield begin, record
        begin = end


def unpacked(compression: str, stored: bytes, size: int) -> bytes:
    """The records of a chunk, `size` bytes by its header; DamageError if they are not."""
    if not compression:
        return stored
    if compression not in ("zstd", "lz4"):
        raise DamageError("a chunk as it is, or packed by lz4 or zstd", repr(compression))
    check_unpacked_size(size, len(stored))
    pieces = _zstd_pieces(stored) if compression == "zstd" else _lz4_pieces(stored)
    records = bytearray()
    with library_errors(f"a frame of {compression}"):
        for piece in pieces:
            records += piece
            if len(records) > size:
                raise DamageError(f"{size} bytes of records", "more")
    return bytes(records)


def _zstd_pieces(stored: bytes) -> Iterator[bytes]:
    with zstandard.ZstdDecompressor().stream_reader(stored, read_across_frames=True) as reader:
        while piece := reader.read(_PIECE_BYTES):
            yield piece


def _lz4_pieces(stored: bytes) -> Iterator[bytes]:
    # The package has no types: a plain import would not pass the type checker.
    frame = importlib.import_module("lz4.frame").LZ4FrameDecompressor()
    piece = frame.decompress(stored, _PIECE_BYTES)
    while piece:
        yield piece
        piece = b"" if frame.eof else frame.decompress(b"", _PIECE_BYTES)
