"""The MCAP container: records, chunks and index (MCAP specification, mcap.dev/spec).

Records are encoded by the reference library. Chunks are not: it would copy every scan three times,
while here a large message goes from the buffer it was assembled in straight to the file.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Iterable, Sequence

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
from mcap.writer import MCAP0_MAGIC

import mlbatch
from mlbatch.errors import ExportError
from mlbatch.ros.definitions import definition, is_known, qos, qos_in_numbers
from mlbatch.types import Message, Topic
from mlbatch.writers._chunk import Chunk, Compress
from mlbatch.writers._compression import compression_of
from mlbatch.writers._gathered import OutputFile, crc32, taken

CHUNK_BYTES = 4 * 2**20
# Messages of this size end the chunk they are in; smaller ones are collected.
LARGE_BYTES = 2**20
# Opcode, length of what follows, channel, sequence, log time, publish time.
_MESSAGE = struct.Struct("<BQHIQQ")
# Opcode, length of what follows, first and last log time, size and CRC of the records, length of
# the name of a compression; then the name, and the size of the records as they are stored.
_CHUNK = struct.Struct("<BQQQQII")
_SIZE = struct.Struct("<Q")
_RECORD = struct.Struct("<BQ")
_RECORD_HEAD = 9  # opcode and length, not counted in the length
# What the CRC of the summary covers of the footer: all but the CRC itself.
_FOOTER_HEAD = struct.Struct("<BQQQ")
_FOOTER_LENGTH = 20


class Container:
    """Topics, messages in chunks, metadata and attachments of one file."""

    def __init__(self, file: OutputFile, compression: str) -> None:
        """compression: as `--compression` has it."""
        self._file = file
        self._compression, self._new_compress = compression_of(compression)
        self._idle: list[Compress] = []
        self._schemas: dict[tuple[str, str, str], Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._foreign: dict[Topic, Channel] = {}
        self._sent: dict[int, int] = {}
        self._span_ns = (0, 0)
        self._chunk = bytearray()
        self._places: dict[int, list[tuple[int, int]]] = {}
        # Chunks that are complete: so many in all, and those that nobody took so far.
        self.ended = 0
        self._ended: list[Chunk] = []
        self._chunks: list[ChunkIndex] = []
        # Lengths of the chunks that a continued file holds.
        self._kept = deque(self._kept_chunks())
        self._kept_count = len(self._kept)
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        file.put(MCAP0_MAGIC)
        file.put(encoded(Header("ros2", f"mlbatch {mlbatch.__version__}")))

    def send(
        self, topic: str, kind: str, log_ns: int, message: bytes | memoryview, latched: bool = False
    ) -> None:
        """Append a message of type `kind`; a topic is made at its first message."""
        channel = self._channels.get(topic) or self._open_topic(topic, kind, latched)
        self._append(channel, log_ns, message)

    def _append(self, channel: Channel, log_ns: int, message: bytes | memoryview) -> None:
        self._places.setdefault(channel.id, []).append((log_ns, len(self._chunk)))
        length = _MESSAGE.size - _RECORD_HEAD + len(message)
        sent = self._sent.get(channel.id, 0)
        self._sent[channel.id] = sent + 1
        self._chunk += _MESSAGE.pack(Opcode.MESSAGE, length, channel.id, sent, log_ns, log_ns)
        if len(message) >= LARGE_BYTES:
            self._end_chunk(message)
            return
        self._chunk += message
        if len(self._chunk) >= CHUNK_BYTES:
            self._end_chunk(b"")

    def forward(self, message: Message) -> None:
        """Append a message as it was recorded, on its own topic with its own definition."""
        channel = self._foreign.get(message.topic) or self._open_foreign(message.topic)
        self._append(channel, message.host_ns, message.data)

    def contents(self) -> list[tuple[Channel, str, int]]:
        """Every channel with the name of its schema and the number of its messages."""
        names = {schema.id: schema.name for schema in self._schemas.values()}
        channels = (*self._channels.values(), *self._foreign.values())
        return [(c, names[c.schema_id], self._sent.get(c.id, 0)) for c in channels]

    @property
    def chunks(self) -> int:
        """Chunks that are written."""
        return len(self._chunks)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time of the file, once it is finished."""
        return self._span_ns

    def note(self, name: str, values: dict[str, str]) -> None:
        """Append a metadata record."""
        self._settle()
        data = encoded(Metadata(name, values))
        self._metadata.append(MetadataIndex(self._file.position_bytes, len(data), name))
        self._file.put(data)

    def attach(self, name: str, media_type: str, log_ns: int, text: str) -> None:
        """Append a text as an attachment."""
        self._settle()
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

    def finish(self) -> None:
        """Append the index; the file itself stays open."""
        self._settle()
        self._file.put(encoded(DataEnd(0)))
        start, summary, offsets = self._file.position_bytes, b"", b""
        for opcode, records in self._groups():
            data = b"".join(map(encoded, records))
            if data:
                offsets += encoded(SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        offsets_start = start + len(summary)
        head = _FOOTER_HEAD.pack(Opcode.FOOTER, _FOOTER_LENGTH, start, offsets_start)
        crc = crc32(summary + offsets + head, 0)
        footer = encoded(Footer(start, offsets_start, crc))
        self._file.put(summary, offsets, footer, MCAP0_MAGIC)

    def _open_topic(self, topic: str, kind: str, latched: bool) -> Channel:
        schema = self._schema(_ros2_name(kind), "ros2msg", definition(kind))
        metadata = {"offered_qos_profiles": qos(latched)}
        channel = self._channels[topic] = self._channel(topic, "cdr", metadata, schema)
        return channel

    def _open_foreign(self, topic: Topic) -> Channel:
        ros1 = topic.encoding == "ros1"
        text, kind = topic.definition, topic.type
        if not text and not ros1 and is_known(kind):
            # Older recorders store no definitions.
            text = definition(kind)
        form = topic.format or ("ros1msg" if ros1 else "ros2msg")
        name = _ros2_name(kind) if form.startswith("ros2") else kind
        metadata = {"offered_qos_profiles": qos_in_numbers(topic.qos) or qos(topic.latched)}
        if ros1:
            metadata = {"latching": "1"} if topic.latched else {}
        schema = self._schema(name, form, text)
        channel = self._channel(topic.name, topic.encoding, metadata, schema)
        self._foreign[topic] = channel
        return channel

    def _schema(self, name: str, form: str, text: str) -> Schema:
        """The schema with this content, written at its first use."""
        schema = self._schemas.get((name, form, text))
        if schema is None:
            # Definitions that are no text were read in a way that keeps their bytes.
            data = text.encode("utf-8", "surrogateescape")
            schema = Schema(len(self._schemas) + 1, data, form, name)
            self._schemas[name, form, text] = schema
            self._chunk += encoded(schema)
        return schema

    def _channel(
        self, topic: str, encoding: str, metadata: dict[str, str], schema: Schema
    ) -> Channel:
        number = len(self._channels) + len(self._foreign) + 1
        channel = Channel(number, topic, encoding, metadata, schema.id)
        self._chunk += encoded(channel)
        return channel

    # -- chunks -------------------------------------------------------------------------------

    def take(self) -> list[Chunk]:
        """The chunks that are complete since the last call; for `put`, once they are sealed."""
        chunks, self._ended = self._ended, []
        return chunks

    def seal(self, chunks: Sequence[Chunk]) -> None:
        """Make chunks ready to be written; by any thread."""
        if self._new_compress is None:
            for chunk in chunks:
                chunk.seal(None)
            return
        compress = taken(self._idle, self._new_compress)
        for chunk in chunks:
            chunk.seal(compress)
        self._idle.append(compress)

    def put(self, chunks: Iterable[Chunk]) -> None:
        """Write chunks and their indexes, in the order in which they were taken."""
        for chunk in chunks:
            start, size, (first_ns, last_ns) = self._file.position_bytes, chunk.size, chunk.span_ns
            name = self._compression.encode()
            around = _CHUNK.size + len(name) + _SIZE.size
            if chunk.is_kept:
                self._file.skip(self._kept.popleft())
                stored_bytes = self._file.position_bytes - start - around
            else:
                stored_bytes = sum(map(len, chunk.stored))
                length = around - _RECORD_HEAD + stored_bytes
                times = (length, first_ns, last_ns, size, chunk.crc, len(name))
                head = _CHUNK.pack(Opcode.CHUNK, *times) + name + _SIZE.pack(stored_bytes)
                self._file.put(head, *chunk.stored)
            index_start = self._file.position_bytes
            index, offsets = b"", {}
            for number, places in chunk.places.items():
                offsets[number] = index_start + len(index)
                index += encoded(MessageIndex(number, places))
            self._file.put(index)
            self._note_chunk(
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

    def _end_chunk(self, tail: bytes | memoryview) -> None:
        """Complete the chunk under construction, `tail` being its last bytes."""
        if not self._places:
            return
        is_kept = self.ended < self._kept_count
        self._ended.append(Chunk([self._chunk, tail], self._places, is_kept))
        self._chunk, self._places = bytearray(), {}
        self.ended += 1

    def _settle(self) -> None:
        """Complete and write all chunks."""
        self._end_chunk(b"")
        chunks = self.take()
        self.seal(chunks)
        self.put(chunks)

    def _kept_chunks(self) -> Iterable[int]:
        """Lengths of the chunks in what stays of a continued file."""
        at, end = len(MCAP0_MAGIC), self._file.kept_bytes
        while at < end:
            head = self._file.look_at(at, _RECORD.size)
            opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, end)
            at += _RECORD.size + length
            if opcode == Opcode.CHUNK:
                yield _RECORD.size + length
        if end and at != end:
            raise ExportError(
                f"{self._file.path}: wanted the chunks of the interrupted run, got other bytes; "
                "leave out --resume to begin anew"
            )

    def _note_chunk(self, chunk: ChunkIndex) -> None:
        """Keep what the summary needs of a chunk."""
        first_ns, last_ns = chunk.message_start_time, chunk.message_end_time
        if self._chunks:
            first_ns, last_ns = min(first_ns, self._span_ns[0]), max(last_ns, self._span_ns[1])
        self._span_ns = (first_ns, last_ns)
        self._chunks.append(chunk)

    def _groups(self) -> list[tuple[Opcode, Iterable[McapRecord]]]:
        """The records of the summary by their kind."""
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels) + len(self._foreign),
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
            (Opcode.CHANNEL, (*self._channels.values(), *self._foreign.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]


def encoded(record: McapRecord) -> bytes:
    """The bytes of a record."""
    builder = RecordBuilder()
    record.write(builder)
    end: Callable[[], bytes] = builder.end
    return end()


def _ros2_name(kind: str) -> str:
    """`package/Type` as ROS 2 writes it; services and actions carry their kind already."""
    return kind.replace("/", "/msg/") if kind.count("/") == 1 else kind
