"""The MCAP container: records, chunks, compression, index (MCAP specification, mcap.dev/spec).

Records are encoded by the reference library. Chunks are not: it would copy every scan three times,
while here a large message goes from the buffer it was assembled in straight to the file.
"""

from __future__ import annotations

import importlib
import re
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from isal.isal_zlib import crc32
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

import mlbatch
from mlbatch.errors import UsageError
from mlbatch.ros.definitions import definition, is_known, qos, qos_in_numbers
from mlbatch.types import Message, Summary, Topic
from mlbatch.writers.atomic import SCANS_CSV
from mlbatch.writers.base import NO_COMPRESSION
from mlbatch.writers.output_file import Bytes, OutputFile, joined_crc, take_scratch

# Compresses so many bytes, given in parts, to one frame.
Compress: TypeAlias = Callable[[Sequence[Bytes], int], list[Bytes]]

# Defined here, since `mcap.writer` reads the metadata of distributions when it is imported.
MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 4 * 2**20
# A message of this size ends its chunk; smaller ones are collected.
LARGE_BYTES = 2**20
# Levels of the zstd library; the default takes 0.58 of the CPU of level 3 for 4 % more bytes.
_ZSTD_LEVELS = range(1, 23)
_ZSTD_DEFAULT = 1

# Opcode, length of what follows, channel, sequence, log time, publish time.
_MESSAGE = struct.Struct("<BQHIQQ")
# Opcode, length of what follows, first and last log time, size and CRC of the records, length of
# the compression's name; the name and the stored size of the records follow.
_CHUNK = struct.Struct("<BQQQQII")
_SIZE = struct.Struct("<Q")
_RECORD = struct.Struct("<BQ")
_RECORD_HEAD = _RECORD.size  # opcode and length, not counted in the length
# The part of the footer that the CRC of the summary covers: all but the CRC.
_FOOTER_HEAD = struct.Struct("<BQQQ")
_FOOTER_LENGTH = 20


@dataclass(slots=True)
class Chunk:
    """Complete records in order, on their way from memory to the file."""

    container: McapContainer
    # Parts; the last may be in a buffer that is reused once the chunk is written.
    records: list[Bytes]
    # Log time and offset of the messages of each channel.
    index: dict[int, list[tuple[int, int]]]
    last_crc: int | None = None  # of the last part, if known
    # Of the records, and of what is stored, once they are compressed.
    crc: int = 0
    stored: list[Bytes] = field(default_factory=list)
    stored_crc: int = 0

    @property
    def size(self) -> int:
        """Uncompressed bytes."""
        return sum(map(len, self.records))

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time."""
        times_ns = [log_ns for entries in self.index.values() for log_ns, _ in entries]
        return min(times_ns), max(times_ns)

    def compress(self) -> None:
        """Compress the records and compute their checksum. Any thread."""
        *parts, last = self.records
        self.crc = _crc_of(parts)
        if self.last_crc is None:
            self.crc = crc32(last, self.crc)
        else:
            self.crc = joined_crc(self.crc, self.last_crc, len(last))
        self.stored = self.container.compressed(self.records, self.size)
        self.stored_crc = self.crc if self.stored is self.records else _crc_of(self.stored)

    def write(self) -> None:
        """Write the chunk and its index; in the order of the chunks."""
        self.container.write_chunk(self)


def _crc_of(parts: Sequence[Bytes]) -> int:
    crc = 0
    for part in parts:
        crc = crc32(part, crc)
    return crc


class McapContainer:
    """One MCAP file: topics, messages in chunks, metadata, attachments, index."""

    def __init__(
        self,
        path: Path,
        compression: str = NO_COMPRESSION,
        check_topic: Callable[[Topic], None] | None = None,
        library: str = f"mlbatch {mlbatch.__version__}",
    ) -> None:
        """Create a file.

        compression: as in `--compression`; check_topic: called with each forwarded topic, raises
        ExportError to refuse it; library: in the header, by which outputs of `convert` are known.
        """
        self._file = OutputFile(path)
        self._compression, self._new_compress = compression_of(compression)
        self._check_topic = check_topic
        self._idle: list[Compress] = []
        self._schemas: dict[tuple[str, str, str], Schema] = {}
        self._channels: dict[str, Channel] = {}  # by topic, our own
        self._forwarded: dict[Topic, Channel] = {}
        self._sent: dict[int, int] = {}  # messages by channel
        self._span_ns = (0, 0)
        # The chunk under construction.
        self._records = bytearray()
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._pending: list[Chunk] = []  # complete and not taken
        self._chunks: list[ChunkIndex] = []  # written
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._file.put(MAGIC)
        self._file.put(encoded(Header("ros2", library)))

    # -- messages -----------------------------------------------------------------------------

    def send(
        self,
        topic: str,
        kind: str,
        log_ns: int,
        message: bytes | memoryview,
        latched: bool = False,
        crc: int | None = None,
    ) -> None:
        """Append a message of type `kind`, package/Type; the first one creates the topic."""
        channel = self._channels.get(topic)
        if channel is None:
            schema = self._schema(_ros2_name(kind), "ros2msg", definition(kind))
            metadata = {"offered_qos_profiles": qos(latched)}
            channel = self._channels[topic] = self._new_channel(topic, "cdr", metadata, schema)
        self._append(channel, log_ns, message, crc)

    def forward(self, message: Message) -> None:
        """Append a recorded message unchanged, on its topic and with its definition."""
        channel = self._forwarded.get(message.topic)
        if channel is None:
            channel = self._forwarded[message.topic] = self._forwarded_channel(message.topic)
        self._append(channel, message.host_ns, message.data)

    def _append(
        self, channel: Channel, log_ns: int, message: bytes | memoryview, crc: int | None = None
    ) -> None:
        self._index.setdefault(channel.id, []).append((log_ns, len(self._records)))
        length = _MESSAGE.size - _RECORD_HEAD + len(message)
        sequence = self._sent.get(channel.id, 0)
        self._sent[channel.id] = sequence + 1
        self._records += _MESSAGE.pack(Opcode.MESSAGE, length, channel.id, sequence, log_ns, log_ns)
        if len(message) >= LARGE_BYTES:
            self._end_chunk(message, crc)
            return
        self._records += message
        if len(self._records) >= CHUNK_BYTES:
            self._end_chunk(b"")

    def _forwarded_channel(self, topic: Topic) -> Channel:
        if self._check_topic is not None:
            self._check_topic(topic)
        is_ros1 = topic.encoding == "ros1"
        text = topic.definition
        if not text and not is_ros1 and is_known(topic.type):
            # Bags of ROS 2 Humble and older contain no definitions.
            text = definition(topic.type)
        encoding = topic.format or ("ros1msg" if is_ros1 else "ros2msg")
        name = _ros2_name(topic.type) if encoding.startswith("ros2") else topic.type
        if is_ros1:
            metadata = {"latching": "1"} if topic.latched else {}
        else:
            metadata = {"offered_qos_profiles": qos_in_numbers(topic.qos) or qos(topic.latched)}
        schema = self._schema(name, encoding, text)
        return self._new_channel(topic.name, topic.encoding, metadata, schema)

    def _schema(self, name: str, encoding: str, text: str) -> Schema:
        """Return the schema with this content; the first use writes it."""
        schema = self._schemas.get((name, encoding, text))
        if schema is None:
            # Definitions that are not UTF-8 were read so that their bytes are kept.
            data = text.encode("utf-8", "surrogateescape")
            schema = Schema(len(self._schemas) + 1, data, encoding, name)
            self._schemas[name, encoding, text] = schema
            self._records += encoded(schema)
        return schema

    def _new_channel(
        self, topic: str, encoding: str, metadata: dict[str, str], schema: Schema
    ) -> Channel:
        number = len(self._channels) + len(self._forwarded) + 1
        channel = Channel(number, topic, encoding, metadata, schema.id)
        self._records += encoded(channel)
        return channel

    # -- chunks -------------------------------------------------------------------------------

    def take_chunks(self) -> list[Chunk]:
        """Return the chunks completed since the last call, to be compressed and written."""
        chunks = self._pending
        self._pending = []
        return chunks

    def compressed(self, records: list[Bytes], size: int) -> list[Bytes]:
        """Return records as they are stored. Any thread."""
        if self._new_compress is None:
            return records
        compress = take_scratch(self._idle, self._new_compress)
        stored = compress(records, size)
        self._idle.append(compress)
        return stored

    def write_chunk(self, chunk: Chunk) -> None:
        """Write a compressed chunk and its index; in the order of the chunks."""
        start = self._file.position_bytes
        size = chunk.size
        first_ns, last_ns = chunk.span_ns
        name = self._compression.encode()
        head_size = _CHUNK.size + len(name) + _SIZE.size
        stored_bytes = sum(map(len, chunk.stored))
        length = head_size - _RECORD_HEAD + stored_bytes
        head = _CHUNK.pack(Opcode.CHUNK, length, first_ns, last_ns, size, chunk.crc, len(name))
        head += name + _SIZE.pack(stored_bytes)
        crc = joined_crc(crc32(head, 0), chunk.stored_crc, stored_bytes)
        self._file.put(head, *chunk.stored, crc=crc)
        index_start = self._file.position_bytes
        index = b""
        offsets = {}
        for number, entries in chunk.index.items():
            offsets[number] = index_start + len(index)
            index += encoded(MessageIndex(number, entries))
        self._file.put(index)
        if self._chunks:
            self._span_ns = min(first_ns, self._span_ns[0]), max(last_ns, self._span_ns[1])
        else:
            self._span_ns = first_ns, last_ns
        self._chunks.append(
            ChunkIndex(
                chunk_length=index_start - start,
                chunk_start_offset=start,
                compression=self._compression,
                compressed_size=stored_bytes,
                message_end_time=last_ns,
                message_index_length=len(index),
                message_index_offsets=offsets,
                message_start_time=first_ns,
                uncompressed_size=size,
            )
        )

    def end_chunk(self) -> None:
        """Complete the chunk under construction: no message follows."""
        self._end_chunk(b"")

    def _end_chunk(self, tail: bytes | memoryview, crc: int | None = None) -> None:
        """Complete the chunk under construction; tail: its last bytes, of this CRC-32 if known."""
        if not self._index:
            return
        self._pending.append(Chunk(self, [self._records, tail], self._index, crc))
        self._records = bytearray()
        self._index = {}

    def _write_all_chunks(self) -> None:
        """Complete and write all chunks."""
        self._end_chunk(b"")
        for chunk in self.take_chunks():
            chunk.compress()
            chunk.write()

    # -- end of the file ----------------------------------------------------------------------

    def finish(self, summary: Summary, grid: dict[str, str]) -> None:
        """Add the metadata records and scans.csv, complete and close the file."""
        self._write_all_chunks()
        self._write_metadata("mlbatch.grid", grid)
        self._write_metadata("mlbatch.fill", summary.fill)
        self._write_metadata("mlbatch.report", {"json": summary.report_json})
        log_ns = summary.t_init_ns or 0
        self._write_attachment(SCANS_CSV, "text/csv", log_ns, summary.scans_csv)
        self._complete()

    def finish_piece(self, grid: dict[str, str]) -> int:
        """Complete and close one of several files of a run; returns its CRC-32.

        Report and scans.csv are of the whole run: they are not in it.
        """
        self._write_all_chunks()
        self._write_metadata("mlbatch.grid", grid)
        self._complete()
        return self._file.crc

    def close(self) -> None:
        """Complete and close a file that is no output of a run: without metadata of one."""
        self._write_all_chunks()
        self._complete()

    def _complete(self) -> None:
        self._write_summary()
        self._file.complete()

    def abandon(self) -> None:
        """Close the incomplete file."""
        self._file.close()

    def _all_channels(self) -> tuple[Channel, ...]:
        return (*self._channels.values(), *self._forwarded.values())

    def _write_metadata(self, name: str, values: dict[str, str]) -> None:
        data = encoded(Metadata(name, values))
        self._metadata.append(MetadataIndex(self._file.position_bytes, len(data), name))
        self._file.put(data)

    def _write_attachment(self, name: str, media_type: str, log_ns: int, text: str) -> None:
        content = text.encode()
        # Time 0 means unknown: files must not depend on when they were written.
        data = encoded(Attachment(0, log_ns, name, media_type, content))
        self._attachments.append(
            AttachmentIndex(
                self._file.position_bytes,
                len(data),
                log_time=log_ns,
                create_time=0,
                data_size=len(content),
                name=name,
                media_type=media_type,
            )
        )
        self._file.put(data)

    def _write_summary(self) -> None:
        self._file.put(encoded(DataEnd(0)))
        start = self._file.position_bytes
        summary = b""
        offsets = b""
        for opcode, records in self._summary_groups():
            data = b"".join(map(encoded, records))
            if data:
                offsets += encoded(SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        offsets_start = start + len(summary)
        head = _FOOTER_HEAD.pack(Opcode.FOOTER, _FOOTER_LENGTH, start, offsets_start)
        crc = crc32(summary + offsets + head, 0)
        footer = encoded(Footer(start, offsets_start, crc))
        self._file.put(summary, offsets, footer, MAGIC)

    def _summary_groups(self) -> list[tuple[Opcode, Iterable[McapRecord]]]:
        """Return the records of the summary by kind."""
        channels = self._all_channels()
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(channels),
            channel_message_counts=self._sent,
            chunk_count=len(self._chunks),
            message_count=sum(self._sent.values()),
            message_end_time=self._span_ns[1],
            message_start_time=self._span_ns[0],
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, self._schemas.values()),
            (Opcode.CHANNEL, channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]


def encoded(record: McapRecord) -> bytes:
    """Return the bytes of a record."""
    builder = RecordBuilder()
    record.write(builder)
    end: Callable[[], bytes] = builder.end
    return end()


def _ros2_name(kind: str) -> str:
    """Return `package/Type` as ROS 2 writes it; services and actions name their kind already."""
    return kind.replace("/", "/msg/") if kind.count("/") == 1 else kind


# -- compression ----------------------------------------------------------------------------------


def compression_of(text: str) -> tuple[str, Callable[[], Compress] | None]:
    """Return the name of `--compression` in the file, and what creates a compressor per thread."""
    if text == NO_COMPRESSION:
        return "", None
    if text == "lz4":
        return "lz4", _lz4
    match = re.fullmatch(r"zstd(?::(\d{1,2}))?", text)
    level = int(match[1] or _ZSTD_DEFAULT) if match else 0
    if level not in _ZSTD_LEVELS:
        raise UsageError(
            f"--compression: expected none, lz4, zstd or zstd:1 to zstd:{_ZSTD_LEVELS[-1]}, found "
            f"{text!r}; choose one"
        )
    return "zstd", lambda: _zstd(level)


def _zstd(level: int) -> Compress:
    import zstandard

    compressor = zstandard.ZstdCompressor(level=level)

    def compress(parts: Sequence[Bytes], size: int) -> list[Bytes]:
        frame = compressor.compressobj(size=size)
        return [*map(frame.compress, parts), frame.flush()]

    return compress


def _lz4() -> Compress:
    # The package has no types: a plain import would not pass the type checker.
    frames = importlib.import_module("lz4.frame")

    def compress(parts: Sequence[Bytes], size: int) -> list[Bytes]:
        frame = frames.LZ4FrameCompressor()
        return [frame.begin(size), *map(frame.compress, parts), frame.flush()]

    return compress
