"""Indexes of MCAP files and metadata.yaml of bags, checked against what was read.

Sources: mcap.dev/spec; docs/sources/outputs.md section 4.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    MessageIndex,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.records import Message as McapMessage

from mlbatch.outputs.containers import BoundedFile, Message
from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.mcap_file import (
    CHUNK,
    DATA_END,
    MCAP_MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    McapFile,
    Place,
    bytes_of,
    records_of,
)
from mlbatch.outputs.rosbag2 import METADATA, Yaml, value_at

# Of metadata.yaml.
_VERSION = 5
# Log time and offset of each message, by channel.
Index: TypeAlias = dict[int, list[tuple[int, int]]]


@dataclass(slots=True)
class _ChunkFound:
    """A chunk, what was read from it, and from the message indexes after it."""

    place: Place
    record: Chunk
    # Uncompressed bytes; None where the chunk is damaged: its messages are not known.
    size: int | None = None
    # (log time, offset) of the messages found, by channel; the same as the indexes have it.
    messages: Index = field(default_factory=dict)
    indexed: Index = field(default_factory=dict)
    # Offset of the message index of each channel; bytes of all.
    index_at: dict[int, int] = field(default_factory=dict)
    index_bytes: int = 0

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time; 0 without messages."""
        times_ns = [log_ns for own in self.messages.values() for log_ns, _ in own]
        return min(times_ns, default=0), max(times_ns, default=0)


class CheckedMcap(McapFile):
    """A file whose chunks and indexes are checked as its messages are read."""

    def __init__(self, log: CheckLog, path: Path) -> None:
        super().__init__(log, path, path.name)
        self.name = path.name
        self._spans_ns: list[tuple[int, int]] = []
        self._is_damaged = False
        self._chunks: list[McapRecord] = []
        self._counts: Counter[int] = Counter()

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time, after all messages are read."""
        firsts, lasts = zip(*self._spans_ns or [(0, 0)], strict=True)
        return min(firsts), max(lasts)

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file."""
        chunk: _ChunkFound | None = None
        with BoundedFile(self._path) as file:
            end = 0
            for place in self._places(file):
                end = place.at + place.size
                if place.opcode in (CHUNK, DATA_END):
                    self._check_chunk(chunk)
                    chunk = None
                if place.opcode == MESSAGE:
                    where = f"{self._where} byte {place.at}"
                    self._log.fail("container", where, "messages in chunks", "one outside")
                if place.opcode not in (CHUNK, MESSAGE_INDEX):
                    continue
                name = "chunk" if place.opcode == CHUNK else "message index"
                try:
                    _, record = next(records_of(bytes_of(file, place)))
                    if isinstance(record, Chunk):
                        chunk = _ChunkFound(place, record)
                        yield from self._messages_of(chunk)
                    elif isinstance(record, MessageIndex) and chunk is not None:
                        chunk.indexed[record.channel_id] = record.records
                        chunk.index_at[record.channel_id] = place.at
                        chunk.index_bytes += place.size
                except DamageError as err:
                    self._is_damaged = True
                    where = f"{self._where} {name} at byte {place.at}"
                    self._log.fail("container", where, err.expected, err.found)
            file.seek(end)
            self._check_summary(file.read(), end)

    def _messages_of(self, chunk: _ChunkFound) -> Iterator[Message]:
        data = self._chunk_data(self._log, chunk.place, chunk.record)
        if data is None:
            return
        chunk.size = len(data)
        for offset, inner in records_of(data):
            if isinstance(inner, McapMessage):
                yield self._message(chunk, offset, inner)
            elif isinstance(inner, Channel | Schema):
                self._learn(inner)
            else:
                found = f"{type(inner).__name__} at {offset}"
                raise DamageError("a schema, channel or message", found)
        where = f"{self._where} chunk at byte {chunk.place.at} first and last"
        said_ns = (chunk.record.message_start_time, chunk.record.message_end_time)
        self._log.equal("container", where, chunk.span_ns, said_ns)

    def _message(self, chunk: _ChunkFound, offset: int, message: McapMessage) -> Message:
        number = message.channel_id
        if number not in self._channels:
            raise DamageError("a message of a channel before it", f"channel {number}")
        topic, kind, encoding = self._channels[number]
        where = f"{self._where} {topic} message {self._counts[number]}"
        self._log.equal("container", f"{where} sequence", self._counts[number], message.sequence)
        self._counts[number] += 1
        log_ns = message.log_time
        chunk.messages.setdefault(number, []).append((log_ns, offset))
        return Message(where, topic, kind, encoding, log_ns, message.publish_time, message.data)

    def _check_chunk(self, chunk: _ChunkFound | None) -> None:
        """Check the message indexes after a chunk; nothing but its index record is kept."""
        if chunk is None:
            return
        if chunk.size is None:
            self._is_damaged = True
            return
        where = f"{self._where} message indexes after the chunk at byte {chunk.place.at}"
        self._log.equal("container", where, chunk.messages, chunk.indexed)
        first_ns, last_ns = chunk.span_ns
        self._chunks.append(
            ChunkIndex(
                chunk_length=chunk.place.size,
                chunk_start_offset=chunk.place.at,
                compression=chunk.record.compression,
                compressed_size=len(chunk.record.data),
                message_end_time=last_ns,
                message_index_length=chunk.index_bytes,
                message_index_offsets=chunk.index_at,
                message_start_time=first_ns,
                uncompressed_size=chunk.size,
            )
        )
        if chunk.messages:
            self._spans_ns.append(chunk.span_ns)

    def _check_summary(self, data: bytes, at: int) -> None:
        """Check the bytes after the data section, from byte `at` on, against what was read."""
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
            records = [record for _, record in records_of(data)]
        except DamageError as err:
            log.fail("container", f"{where} summary", err.expected, err.found)
            return
        footers = [record.summary_start for record in records if isinstance(record, Footer)]
        log.equal("container", f"{where} start of the summary", [at], footers)
        if self._is_damaged:
            return
        should = [*self._chunks, self._statistics(), *self.described]
        for kind in (ChunkIndex, Statistics, AttachmentIndex, MetadataIndex):
            name = f"{where} {kind.__name__}"
            own, found = (
                [one for one in side if isinstance(one, kind)] for side in (should, records)
            )
            log.equal("container", f"{name} records", len(own), len(found))
            for number, (one, other) in enumerate(zip(own, found, strict=False)):
                left, right = vars(one), vars(other)
                differs = [key for key in left if left[key] != right[key]]
                sides = ({key: side[key] for key in differs} for side in (left, right))
                log.equal("container", f"{name} {number}", *sides)

    def _statistics(self) -> McapRecord:
        attachments = sum(isinstance(one, AttachmentIndex) for one in self.described)
        return Statistics(
            attachment_count=attachments,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_end_time=self.span_ns[1],
            message_start_time=self.span_ns[0],
            metadata_count=len(self.described) - attachments,
            schema_count=len(self._schemas),
        )


# -- bags -----------------------------------------------------------------------------------------


def check_metadata(
    log: CheckLog,
    about: Yaml,
    files: Sequence[CheckedMcap],
    messages: Sequence[int],
    counts: Counter[str],
) -> None:
    """Check the content of metadata.yaml against files; messages: in each; counts: by topic."""
    firsts, lasts = zip(*(file.span_ns for file in files), strict=True)
    expected: dict[str, Yaml] = {
        "version": _VERSION,
        "storage_identifier": "mcap",
        **_times((min(firsts), max(lasts)), counts.total()),
        "files": [
            {"path": file.name, **_times(file.span_ns, count)}
            for file, count in zip(files, messages, strict=True)
        ],
    }
    for key, value in expected.items():
        log.equal("metadata", f"{METADATA} {key}", value, value_at(about, key))
    topics = value_at(about, "topics_with_message_count")
    said = {}
    for topic in topics if isinstance(topics, list) else []:
        name_of = value_at(value_at(topic, "topic_metadata"), "name")
        said[str(name_of)] = value_at(topic, "message_count")
    log.equal("metadata", f"{METADATA} topics", dict(counts), said)


def _times(span_ns: tuple[int, int], messages: int) -> dict[str, Yaml]:
    first_ns, last_ns = span_ns
    return {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
        "message_count": messages,
    }
