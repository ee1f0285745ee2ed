"""Indexes of MCAP files and metadata.yaml of bags, checked against what was read.

Sources: mcap.dev/spec; docs/sources/outputs.md section 4.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.mcap_file import MCAP_MAGIC, Place, RecordListener, records_of
from mlbatch.outputs.rosbag2 import METADATA, Yaml, value_at

# Of metadata.yaml.
_VERSION = 5
# Log time and offset of each message, by channel.
Index: TypeAlias = dict[int, list[tuple[int, int]]]


@dataclass(slots=True)
class _ChunkFound:
    """Data read from one chunk and its message indexes."""

    place: Place
    compression: str
    # Bytes in the file, and uncompressed.
    stored_size: int
    size: int = 0
    # False where the chunk is damaged: its messages are not known.
    whole: bool = False
    # (log time, offset) of the messages found, by channel.
    messages: Index = field(default_factory=dict)
    # The same as the message indexes have it.
    indexed: Index = field(default_factory=dict)
    # Offset of the message index of each channel; bytes of all.
    index_at: dict[int, int] = field(default_factory=dict)
    index_bytes: int = 0

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time; 0 without messages."""
        times_ns = [log_ns for own in self.messages.values() for log_ns, _ in own]
        return min(times_ns, default=0), max(times_ns, default=0)

    def index_record(self) -> McapRecord:
        """The record that the summary should contain."""
        first_ns, last_ns = self.span_ns
        return ChunkIndex(
            chunk_length=self.place.size,
            chunk_start_offset=self.place.at,
            compression=self.compression,
            compressed_size=self.stored_size,
            message_end_time=last_ns,
            message_index_length=self.index_bytes,
            message_index_offsets=self.index_at,
            message_start_time=first_ns,
            uncompressed_size=self.size,
        )


class McapIndexChecks(RecordListener):
    """Checks of one file; where: its name."""

    def __init__(self, log: CheckLog, where: str) -> None:
        # First and last log time, after all messages are read.
        self.span_ns = (0, 0)
        self._log = log
        self._where = where
        self._chunk: _ChunkFound | None = None
        self._damaged = False
        self._spans_ns: list[tuple[int, int]] = []
        self._channels: set[int] = set()
        self._schemas: set[int] = set()
        self._counts: Counter[int] = Counter()
        # Index records that the summary should contain.
        self._expected: dict[type[McapRecord], list[McapRecord]] = {
            kind: [] for kind in (ChunkIndex, Statistics, AttachmentIndex, MetadataIndex)
        }

    def record(self, place: Place, record: McapRecord) -> None:
        """Note what the summary should say of a record."""
        if isinstance(record, Metadata):
            self._expected[MetadataIndex].append(MetadataIndex(place.at, place.size, record.name))
        elif isinstance(record, Attachment):
            self._expected[AttachmentIndex].append(
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
        elif isinstance(record, Chunk):
            self._chunk = _ChunkFound(place, record.compression, len(record.data))
        elif isinstance(record, MessageIndex) and self._chunk is not None:
            self._chunk.indexed[record.channel_id] = record.records
            self._chunk.index_at[record.channel_id] = place.at
            self._chunk.index_bytes += place.size

    def chunk(self, place: Place, size: int) -> None:
        """Note the size of a chunk that can be read."""
        if self._chunk is not None:
            self._chunk.size = size
            self._chunk.whole = True

    def inner(self, offset: int, record: McapRecord, where: str) -> None:
        """Count a message, schema or channel."""
        if isinstance(record, Channel):
            self._channels.add(record.id)
        elif isinstance(record, Schema):
            self._schemas.add(record.id)
        elif isinstance(record, Message) and self._chunk is not None:
            number = self._counts[record.channel_id]
            self._counts[record.channel_id] += 1
            self._log.equal("container", f"{where} sequence", number, record.sequence)
            own = self._chunk.messages.setdefault(record.channel_id, [])
            own.append((record.log_time, offset))

    def chunk_end(self, where: str, chunk: Chunk) -> None:
        """Check the times in the header of a chunk."""
        found = (0, 0) if self._chunk is None else self._chunk.span_ns
        said_ns = (chunk.message_start_time, chunk.message_end_time)
        self._log.equal("container", f"{where} first and last", found, said_ns)

    def damage(self) -> None:
        """The messages of some chunks are not known."""
        self._damaged = True

    def indexes_end(self) -> None:
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
        self._expected[ChunkIndex].append(chunk.index_record())
        if chunk.messages:
            self._spans_ns.append(chunk.span_ns)
            firsts, lasts = zip(*self._spans_ns, strict=True)
            self.span_ns = (min(firsts), max(lasts))
            self._spans_ns = [self.span_ns]

    def summary(self, data: bytes, at: int) -> None:
        """Check the summary section against what was read."""
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
        if self._damaged:
            return
        self._expected[Statistics].append(self._statistics())
        for kind, own in self._expected.items():
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
            attachment_count=len(self._expected[AttachmentIndex]),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._expected[ChunkIndex]),
            message_count=self._counts.total(),
            message_end_time=self.span_ns[1],
            message_start_time=self.span_ns[0],
            metadata_count=len(self._expected[MetadataIndex]),
            schema_count=len(self._schemas),
        )


# -- bags -----------------------------------------------------------------------------------------


class BagFile(NamedTuple):
    """Content of one MCAP file: messages, first and last log time."""

    name: str
    messages: int
    span_ns: tuple[int, int]


def check_metadata(
    log: CheckLog, about: Yaml, files: Sequence[BagFile], counts: Counter[str]
) -> None:
    """Check the content of metadata.yaml against files; counts: of their messages by topic."""
    first_ns = min(file.span_ns[0] for file in files)
    last_ns = max(file.span_ns[1] for file in files)
    expected: dict[str, Yaml] = {
        "version": _VERSION,
        "storage_identifier": "mcap",
        **_times((first_ns, last_ns), counts.total()),
        "files": [{"path": file.name, **_times(file.span_ns, file.messages)} for file in files],
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
