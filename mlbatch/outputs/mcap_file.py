"""MCAP files: records, chunks and their checksums, and messages by the indexes of the file.

`mcap` parses the records. Source: mcap.dev/spec.
"""

from __future__ import annotations

import importlib
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import zstandard
from isal.isal_zlib import crc32
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.stream_reader import StreamReader

from mlbatch.outputs.containers import (
    BoundedFile,
    Message,
    MessagePlace,
    WholeReads,
    check_unpacked_size,
    library_errors,
)
from mlbatch.outputs.damage import CheckLog, DamageError, VerifyError

MCAP_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
# Opcode, length of what follows, channel, sequence, log time, publish time.
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_FOOTER_BYTES = _HEAD.size + 20
# Of a chunk: all but compression and records.
_CHUNK_BYTES = 40
_HEADER = 1
MESSAGE = 5
CHUNK = 6
MESSAGE_INDEX = 7
_ATTACHMENT = 9
_METADATA = 12
DATA_END = 15
_PIECE_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Place:
    """Where a record is in the file."""

    opcode: int
    # Offset of the record in the file, with its head.
    at: int
    # Bytes with the head.
    size: int


class McapFile:
    """An MCAP file of mlbatch; its metadata and attachments are read at once.

    described: index records of these, as the summary should have them.
    """

    def __init__(self, log: CheckLog, path: Path, where: str) -> None:
        self.described: list[McapRecord] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.profile = ""
        self.library = ""
        self._log = log
        self._path = path
        self._where = where
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str, str]] = {}
        # Offset and records of the chunk that `message_at` read last.
        self._last = (0, b"")
        with BoundedFile(path) as file:
            if file.read(min(len(MCAP_MAGIC), file.size)) != MCAP_MAGIC:
                raise VerifyError(f"{path}: expected an MCAP file, found another; convert again")
            for place in self._places(file):
                if place.opcode in (_HEADER, _ATTACHMENT, _METADATA):
                    try:
                        self._describe_file(file, place)
                    except DamageError as err:
                        raise VerifyError(f"{path}: byte {place.at}: {err}; convert again") from err

    def _places(self, file: BoundedFile) -> Iterator[Place]:
        """All records to the end of the data section."""
        at = len(MCAP_MAGIC)
        opcode = 0
        while opcode != DATA_END:
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
            yield Place(opcode, at, size)
            at += size

    def _describe_file(self, file: BoundedFile, place: Place) -> None:
        """Read a header, metadata or attachment record."""
        data = bytes_of(file, place)
        _, record = next(records_of(data))
        if isinstance(record, Header):
            self.profile = record.profile
            self.library = record.library
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
            self.described.append(MetadataIndex(place.at, place.size, record.name))
        elif isinstance(record, Attachment):
            self.attachments[record.name] = record.data
            # The library skips this checksum.
            actual = crc32(memoryview(data)[_HEAD.size : -4], 0)
            stored = int.from_bytes(data[-4:], "little")
            self._log.equal("container", f"{self._where} {record.name} CRC", actual, stored)
            self.described.append(
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

    def places(self, topics: Collection[str]) -> list[MessagePlace]:
        """Where the messages of topics are, in the order of the file, by its indexes."""
        entries: list[tuple[Place, int, int, int]] = []
        chunk = Place(0, 0, 0)
        with BoundedFile(self._path) as file:
            end = 0
            for place in self._places(file):
                end = place.at + place.size
                chunk = place if place.opcode == CHUNK else chunk
                if place.opcode == MESSAGE_INDEX:
                    _, record = next(records_of(bytes_of(file, place)))
                    if isinstance(record, MessageIndex):
                        own = ((chunk, offset, log_ns) for log_ns, offset in record.records)
                        entries += [(*entry, record.channel_id) for entry in own]
            file.seek(end)
            for _, record in records_of(file.read(file.size - end - len(MCAP_MAGIC))):
                self._learn(record)
        found: list[MessagePlace] = []
        counts: Counter[str] = Counter()
        # Indexes are by channel; entries of a chunk are in the order of its bytes.
        for chunk, offset, log_ns, number in sorted(entries, key=lambda one: (one[0].at, one[1])):
            topic = self._channels.get(number, ("", "", ""))[0]
            if topic in topics:
                at = MessagePlace(topic, counts[topic], log_ns, chunk.at, chunk.size, offset)
                found.append(at)
                counts[topic] += 1
        return found

    def message_at(self, log: CheckLog, place: MessagePlace) -> Message | None:
        """One message, None if its chunk is damaged; DamageError if there is none."""
        # Messages that follow each other are often of one chunk.
        if self._last[0] != place.chunk:
            with BoundedFile(self._path) as file:
                chunk = Place(CHUNK, place.chunk, place.chunk_bytes)
                _, record = next(records_of(bytes_of(file, chunk)))
            if not isinstance(record, Chunk):
                raise DamageError(f"a chunk at byte {place.chunk}", type(record).__name__)
            whole = self._chunk_data(log, chunk, record)
            if whole is None:
                return None
            self._last = place.chunk, whole
        data = self._last[1]
        begin = place.offset + _MESSAGE_HEAD.size
        head = data[place.offset : begin]
        if len(head) < _MESSAGE_HEAD.size:
            raise DamageError(f"a message at offset {place.offset}", f"{len(data)} bytes")
        opcode, length, channel, _, log_ns, publish_ns = _MESSAGE_HEAD.unpack(head)
        topic, kind, encoding = self._channels.get(channel, ("", "", ""))
        end = place.offset + _HEAD.size + length
        if (opcode, topic, log_ns) != (MESSAGE, place.topic, place.log_ns) or end > len(data):
            raise DamageError(f"a message at offset {place.offset}, as by the index", "another")
        where = f"{self._where} {topic} message {place.number}"
        content = memoryview(data)[begin:end]
        return Message(where, topic, kind, encoding, log_ns, publish_ns, content)

    def _learn(self, record: McapRecord) -> None:
        """Keep a schema or channel."""
        if isinstance(record, Channel):
            kind = self._schemas.get(record.schema_id, "")
            self._channels[record.id] = (record.topic, kind, record.message_encoding)
        elif isinstance(record, Schema):
            self._schemas[record.id] = record.name.replace("/msg/", "/")

    def _chunk_data(self, log: CheckLog, place: Place, record: Chunk) -> bytes | None:
        """The records of a chunk; None if its checksum is wrong."""
        where = f"{self._where} chunk at byte {place.at}"
        stored = _HEAD.size + _CHUNK_BYTES + len(record.compression.encode()) + len(record.data)
        if stored != place.size:
            raise DamageError(f"a chunk of {stored} bytes", f"{place.size} bytes")
        data = unpacked(record.compression, record.data, record.uncompressed_size)
        log.equal("container", f"{where} size", len(data), record.uncompressed_size)
        crc = f"{record.uncompressed_crc:08x}"
        is_right = log.equal("container", f"{where} CRC", f"{crc32(data, 0):08x}", crc)
        return data if is_right else None


def bytes_of(file: BoundedFile, place: Place) -> bytes:
    """The bytes of a record."""
    file.seek(place.at)
    return file.read(place.size)


def records_of(data: bytes) -> Iterator[tuple[int, McapRecord]]:
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
