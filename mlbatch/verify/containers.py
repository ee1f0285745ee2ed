"""MCAP files and ROS bags: messages in the order of the file, and the indexes checked against them.

`mcap` and `rosbags` parse the records. The lengths of records are checked against the file, and
sizes of compressed chunks against a limit, before a library allocates anything.
Sources: mcap.dev/spec; wiki.ros.org/Bags/Format/2.0; docs/sources/outputs.md section 4.
"""

from __future__ import annotations

import importlib
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import SEEK_CUR, SEEK_END, BufferedReader, BytesIO, FileIO
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

from mlbatch.verify.verdict import CheckLog, DamageError, VerifyError

if TYPE_CHECKING:
    from mcap.records import Chunk, McapRecord
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag1.reader import Header

MCAP_MAGIC = b"\x89MCAP0\r\n"
BAG_MAGIC = b"#ROSBAG V2.0\n"
BAG_LIMITS = {"container": "lengths and indexes; bags have no checksums"}
METADATA_YAML = "metadata.yaml"

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
# Largest chunk: this size, or this multiple of its stored bytes. Scans shrink to a half or a tenth;
# decompression bombs are a thousand times larger than their stored bytes.
_USUAL_BYTES = 1 << 28
_MOST_TIMES = 256

_METADATA_VERSION = 5
_LARGEST_YAML_BYTES = 1 << 20
Yaml: TypeAlias = "dict[str, Yaml] | list[Yaml] | str | int | float | bool | None"
# Log time and offset of each message, by channel or connection.
Index: TypeAlias = dict[int, list[tuple[int, int]]]


@dataclass(frozen=True, slots=True)
class Message:
    """A message in a file."""

    where: str
    topic: str
    # package/Type
    type: str
    # cdr or ros1
    encoding: str
    log_ns: int
    publish_ns: int
    data: bytes | memoryview


@contextmanager
def library_errors(expected: str) -> Iterator[None]:
    """Raise DamageError for whatever a library raises on damaged bytes."""
    try:
        yield
    except DamageError:
        raise
    except Exception as err:
        raise DamageError(expected, str(err) or type(err).__name__) from err


class BoundedFile(BufferedReader):
    """A file that refuses to read past its end, before anything is allocated."""

    def __init__(self, path: Path) -> None:
        super().__init__(FileIO(path))
        self.size = self.seek(0, SEEK_END)
        self.seek(0)

    def read(self, size: int | None = -1, /) -> bytes:
        """Exactly `size` bytes, or DamageError; all up to the end for -1."""
        left = self.size - self.tell()
        if size is None or size < 0:
            return super().read(left)
        if size > left:
            raise DamageError(f"{size} bytes at byte {self.tell()}", f"{left} to the end of file")
        return super().read(size)


class WholeReads(BytesIO):
    """Bytes that refuse to read past their end; libraries take what is left as whole."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.size = len(data)

    def read(self, size: int | None = -1, /) -> bytes:
        """Exactly `size` bytes, or DamageError."""
        left = self.size - self.tell()
        if size is None or not 0 <= size <= left:
            raise DamageError(f"{size} bytes at offset {self.tell()}", str(left))
        return super().read(size)


# -- MCAP -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a record is in the file."""

    opcode: int
    at: int
    size: int


@dataclass(slots=True)
class _ChunkFound:
    """What was read of one chunk and of its message indexes."""

    place: _Place
    compression: str
    stored_size: int
    # Uncompressed.
    size: int = 0
    # False where the chunk is damaged: its messages are not known.
    whole: bool = False
    messages: Index = field(default_factory=dict)
    indexed: Index = field(default_factory=dict)
    index_at: dict[int, int] = field(default_factory=dict)
    index_bytes: int = 0
    first_ns: int | None = None
    last_ns: int = 0

    def add(self, channel: int, log_ns: int, offset: int) -> None:
        """Count a message."""
        self.messages.setdefault(channel, []).append((log_ns, offset))
        self.first_ns = log_ns if self.first_ns is None else min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)

    def index_record(self) -> McapRecord:
        """The record that the summary should contain."""
        from mcap.records import ChunkIndex

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
            self._places = self._walk(file)
            for place in self._places:
                if place.opcode in (_HEADER, _ATTACHMENT, _METADATA):
                    try:
                        self._describe_file(file, place)
                    except DamageError as err:
                        raise VerifyError(f"{path}: byte {place.at}: {err}; convert again") from err

    def _walk(self, file: BoundedFile) -> list[_Place]:
        """All records to the end of the data section."""
        if not file.read(min(len(MCAP_MAGIC), file.size)) == MCAP_MAGIC:
            raise VerifyError(f"{self._path}: expected an MCAP file, found another; check the name")
        places: list[_Place] = []
        at = len(MCAP_MAGIC)
        while not places or places[-1].opcode != _DATA_END:
            opcode, length = 0, 0
            if at + _HEAD.size <= file.size:
                file.seek(at)
                opcode, length = _HEAD.unpack(file.read(_HEAD.size))
            size = _HEAD.size + length
            if not opcode or at + size + _FOOTER_BYTES + len(MCAP_MAGIC) > file.size:
                raise VerifyError(
                    f"{self._path}: expected a whole MCAP file, found one that ends or is damaged "
                    f"at byte {at}; convert again"
                )
            places.append(_Place(opcode, at, size))
            at += size
        return places

    def _describe_file(self, file: BoundedFile, place: _Place) -> None:
        """Read a header, metadata or attachment record."""
        from mcap.records import Attachment, AttachmentIndex, Header, Metadata, MetadataIndex

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
            for place in self._places:
                where = f"{self._where} byte {place.at}"
                if place.opcode in (_CHUNK, _DATA_END):
                    self._finish_chunk()
                if place.opcode == _MESSAGE:
                    self._log.fail("container", where, "messages in chunks", "one outside")
                if place.opcode not in (_CHUNK, _MESSAGE_INDEX):
                    continue
                name = "chunk" if place.opcode == _CHUNK else "message index"
                try:
                    _, record = next(_records(_bytes_of(file, place)))
                    if place.opcode == _CHUNK:
                        yield from self._chunk_messages(place, cast("Chunk", record))
                    else:
                        self._add_message_index(place, record)
                except DamageError as err:
                    where = f"{self._where} {name} at byte {place.at}"
                    self._log.fail("container", where, err.expected, err.found)
            summary_at = self._places[-1].at + self._places[-1].size
            file.seek(summary_at)
            summary = file.read()
        self._check_summary(summary, summary_at)

    def _chunk_messages(self, place: _Place, record: Chunk) -> Iterator[Message]:
        from mcap.records import Channel, Schema
        from mcap.records import Message as McapMessage

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

    def _message(self, record: McapRecord) -> Message:
        from mcap.records import Message as McapMessage

        message = cast(McapMessage, record)
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

    def _add_message_index(self, place: _Place, record: McapRecord) -> None:
        from mcap.records import MessageIndex

        index = cast(MessageIndex, record)
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
        from mcap.records import AttachmentIndex, ChunkIndex, Footer, MetadataIndex, Statistics

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
        from mcap.records import Statistics

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
    from mcap.stream_reader import StreamReader

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
    most = max(_USUAL_BYTES, _MOST_TIMES * len(stored))
    if size > most:
        raise DamageError(f"at most {most} bytes in {len(stored)} that are stored", f"{size}")
    pieces = _zstd_pieces(stored) if compression == "zstd" else _lz4_pieces(stored)
    records = bytearray()
    with library_errors(f"a frame of {compression}"):
        for piece in pieces:
            records += piece
            if len(records) > size:
                raise DamageError(f"{size} bytes of records", "more")
    return bytes(records)


def _zstd_pieces(stored: bytes) -> Iterator[bytes]:
    import zstandard

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


# -- ROS 1 bags -----------------------------------------------------------------------------------


@dataclass(slots=True)
class _BagOutline:
    """The records of a bag outside its chunks."""

    # Header fields, offset and size of the data of each chunk, by its position.
    chunks: dict[int, tuple[Header, int, int]] = field(default_factory=dict)
    # Positions of chunks, as the index at the end has them.
    chunk_infos: list[int] = field(default_factory=list)
    connections: int = 0


class BagFile:
    """A ROS 1 bag of mlbatch. It has no metadata: report and table are separate files."""

    def __init__(self, log: CheckLog, path: Path, where: str) -> None:
        self._log = log
        self._path = path
        self._where = where
        self._counts: Counter[str] = Counter()

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file; each chunk is checked against the index."""
        from rosbags.rosbag1 import Reader

        try:
            with BoundedFile(self._path) as file:
                outline = self._outline(file)
                # The library follows these positions without a check.
                expected = list(outline.chunks)
                if outline.chunk_infos != expected:
                    raise DamageError(f"chunks {expected} in the index", str(outline.chunk_infos))
                reader = Reader(self._path)
                with library_errors("the index of a bag"):
                    reader.open()
                try:
                    yield from self._chunk_messages(file, outline, reader)
                finally:
                    reader.close()
        except DamageError as err:
            raise VerifyError(f"{self._path}: {err}; convert again") from err

    def _outline(self, file: BoundedFile) -> _BagOutline:
        """Read the headers of all records, and skip their data."""
        from rosbags.rosbag1.reader import Header, RecordType, read_uint32

        outline = _BagOutline()
        kinds: Counter[int] = Counter()
        index_at = 0
        first_index_at = file.size
        head = Header()
        file.seek(len(BAG_MAGIC))
        while (at := file.tell()) < file.size:
            with library_errors(f"a record at byte {at}"):
                header = Header.read(file)
                kind = header.get_uint8("op")
                size = read_uint32(file)
                data_at = file.tell()
                if size > file.size - data_at:
                    raise DamageError(f"{size} bytes at byte {data_at}", "the end of the file")
                if not kinds:
                    head = header
                    index_at = head.get_uint64("index_pos")
                    allowed = {RecordType.BAGHEADER}
                elif at < index_at:
                    allowed = {RecordType.CHUNK, RecordType.IDXDATA}
                else:
                    allowed = {RecordType.CONNECTION, RecordType.CHUNK_INFO}
                    first_index_at = min(first_index_at, at)
                if kind not in allowed:
                    names = " or ".join(record.name for record in sorted(allowed))
                    raise DamageError(f"a record {names} at byte {at}", f"type {kind}")
                if kind == RecordType.CHUNK:
                    outline.chunks[at] = (header, data_at, size)
                elif kind == RecordType.CHUNK_INFO:
                    outline.chunk_infos.append(header.get_uint64("chunk_pos"))
            kinds[kind] += 1
            file.seek(size, SEEK_CUR)
        if index_at != first_index_at:
            raise DamageError(f"an index at byte {first_index_at}", f"byte {index_at}")
        with library_errors("a bag with an index"):
            outline.connections = kinds[RecordType.CONNECTION]
            said = (head.get_uint32("conn_count"), head.get_uint32("chunk_count"))
            counts = (outline.connections, len(outline.chunk_infos))
            where = f"{self._where} connections and chunks"
            if not self._log.equal("container", where, counts, said):
                raise DamageError(f"{counts[0]} connections, {counts[1]} chunks", str(said))
        return outline

    def _chunk_messages(
        self, file: BoundedFile, outline: _BagOutline, reader: Reader
    ) -> Iterator[Message]:
        log = self._log
        indexes: dict[int, Index] = {}
        for number, entries in reader.indexes.items():
            for time_ns, chunk_at, offset in entries:
                own = indexes.setdefault(chunk_at, {})
                own.setdefault(number, []).append((time_ns, offset))
        topics = {
            connection.id: (connection.topic, connection.msgtype.replace("/msg/", "/"))
            for connection in reader.connections
        }
        seen: set[int] = set()
        for info in reader.chunk_infos:
            header, data_at, size = outline.chunks[info.pos]
            where = f"{self._where} chunk at byte {info.pos}"
            compression = header.get("compression", b"").decode("ascii", "replace")
            if compression != "none":
                raise DamageError("a chunk without compression, as mlbatch writes it", compression)
            with library_errors("a chunk with its size"):
                log.equal("container", f"{where} size", size, header.get_uint32("size"))
            file.seek(data_at)
            data = file.read(size)
            found: Index = {}
            for offset, number, message in self._in_chunk(data, topics, seen):
                found.setdefault(number, []).append((message.log_ns, offset))
                yield message
            # `rosbags` sorts entries by time.
            found = {number: sorted(entries) for number, entries in found.items()}
            index = {number: sorted(own) for number, own in indexes.pop(info.pos, {}).items()}
            log.equal("container", f"{self._where} index of the {where}", found, index)
            times_ns = [time_ns for entries in found.values() for time_ns, _ in entries]
            counts = {number: len(entries) for number, entries in found.items()}
            # The library adds 1 to the end.
            expected = (min(times_ns, default=2**63 - 1), max(times_ns, default=-1) + 1, counts)
            said = (info.start_time, info.end_time, dict(info.connection_counts))
            log.equal("container", f"{where} in the index", expected, said)
        log.equal("container", f"{self._where} connections in the index", set(topics), seen)

    def _in_chunk(
        self, data: bytes, topics: dict[int, tuple[str, str]], seen: set[int]
    ) -> Iterator[tuple[int, int, Message]]:
        """Offset, connection and message of each message of a chunk; `seen` gets connections."""
        from rosbags.rosbag1.reader import Header, RecordType, read_uint32

        view = memoryview(data)
        stream = BytesIO(data)
        while (offset := stream.tell()) < len(data):
            with library_errors(f"a record at offset {offset} of a chunk"):
                header = Header.read(stream)
                kind = header.get_uint8("op")
                number = header.get_uint32("conn")
                size = read_uint32(stream)
                begin = stream.tell()
                content = view[begin : begin + size]
                if len(content) != size:
                    raise DamageError(f"{size} bytes at offset {begin}", f"{len(content)}")
                stream.seek(size, SEEK_CUR)
                topic, msgtype = topics.get(number, ("", ""))
                if kind == RecordType.CONNECTION:
                    if header.get_string("topic") != topic:
                        raise DamageError(f"topic {topic!r}", header.get_string("topic"))
                    seen.add(number)
                    continue
                if kind != RecordType.MSGDATA or number not in seen:
                    raise DamageError("a connection or a message of one", f"type {kind}")
                log_ns = header.get_time("time")
            where = f"{self._where} {topic} message {self._counts[topic]}"
            self._counts[topic] += 1
            yield offset, number, Message(where, topic, msgtype, "ros1", log_ns, log_ns, content)


# -- ROS 2 bags -----------------------------------------------------------------------------------


def rosbag2_file(log: CheckLog, folder: Path) -> tuple[Path, Yaml]:
    """The MCAP file of a bag, and the content of metadata.yaml."""
    # Only bags need it.
    import yaml

    class PlainLoader(yaml.SafeLoader):
        """Refuses aliases: a few of them can stand for gigabytes."""

        def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("an alias")
            return super().compose_node(parent, index)

    path = folder / METADATA_YAML
    try:
        if path.stat().st_size > _LARGEST_YAML_BYTES:
            raise VerifyError(f"{path}: expected a few lines, found more than 1 MiB; restore it")
        root: Yaml = yaml.load(path.read_text(encoding="utf-8"), PlainLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as err:
        text = " ".join(str(err).split())
        raise VerifyError(f"{path}: expected YAML, found {text}; restore it") from err
    about = _value_at(root, "rosbag2_bagfile_information")
    files = sorted(found for found in folder.iterdir() if found.suffix == ".mcap")
    names = [found.name for found in files]
    said = _value_at(about, "relative_file_paths")
    log.equal("names", f"{METADATA_YAML} relative_file_paths", names, said)
    if len(files) != 1:
        raise VerifyError(
            f"{folder}: expected a bag with one MCAP file, found {len(files)}; convert again"
        )
    return files[0], about


def check_metadata_yaml(
    log: CheckLog, about: Yaml, name: str, counts: Counter[str], span_ns: tuple[int, int]
) -> None:
    """Check the content of metadata.yaml against the messages of the file `name`."""
    first_ns, last_ns = span_ns
    total = counts.total()
    times: dict[str, Yaml] = {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
        "message_count": total,
    }
    expected: dict[str, Yaml] = {
        "version": _METADATA_VERSION,
        "storage_identifier": "mcap",
        **times,
        "files": [{"path": name, **times}],
    }
    for key, value in expected.items():
        log.equal("metadata", f"{METADATA_YAML} {key}", value, _value_at(about, key))
    topics = _value_at(about, "topics_with_message_count")
    said = {}
    for topic in topics if isinstance(topics, list) else []:
        name_of = _value_at(_value_at(topic, "topic_metadata"), "name")
        said[str(name_of)] = _value_at(topic, "message_count")
    log.equal("metadata", f"{METADATA_YAML} topics", dict(counts), said)


def _value_at(value: Yaml, key: str) -> Yaml:
    return value.get(key) if isinstance(value, dict) else None
