"""MCAP files of ROS 2 and ROS 1, whole or cut off (docs/sources/messages.md, section 5).

Messages are found by walking from record to record, so that files without chunks, index or summary
read like all others. A summary, if there is one, gives the topics at once, and the chunks without
selected messages.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.readers.bag.mcap_records import (
    FOOTER_BYTES,
    MAGIC,
    Channels,
    Op,
    chunk_of_index,
    last_log_ns,
    records_of,
    summary_start,
)
from mlbatch.readers.bag.mcap_walk import Walk
from mlbatch.readers.bag.recording import BagRecording, Portion
from mlbatch.readers.source import BUFFER_BYTES, MAX_RECORD_BYTES, Source
from mlbatch.types import Recording, StreamTable, Topic

CONTAINER = "MCAP"
# How far to search for topics in a file without a summary; usually they are at the front.
_SEARCH_BYTES = 64 << 20
_PEEK_BYTES = 1 << 16
# A summary of more records is not kept in memory; the file is read without it.
_MOST_RECORDS = 500_000


def recognises(head: bytes) -> bool:
    """Whether a file that begins with `head` is an MCAP file."""
    return head.startswith(MAGIC)


def open_packets(path: Path, streams: StreamTable) -> Recording:
    """Open an MCAP file; its payloads come from streams (topic)."""
    return open_folder(path, [path], streams)


def open_folder(
    folder: Path,
    files: Sequence[Path],
    streams: StreamTable,
    notes: Sequence[str] = (),
    buffer_bytes: int = BUFFER_BYTES,
) -> BagRecording:
    """Open the files of a bag as one recording, in the order of their first messages.

    buffer_bytes: for tests, results do not depend on it.
    """
    # Equal times, and files without messages, keep their order.
    ordered = sorted(files, key=_first_ns) if len(files) > 1 else list(files)
    topics: dict[Topic, None] = {}
    last_ns: list[int | None] = []
    for file in ordered:
        with Source(file) as source:
            summary = _summary(source)
            topics |= dict.fromkeys(_channels(source, summary, buffer_bytes).topics.values())
            last_ns.append(summary.last_ns)
    size_bytes = sum(file.stat().st_size for file in ordered)
    portions = partial(_portions, files=tuple(ordered), buffer_bytes=buffer_bytes)
    return BagRecording(
        folder,
        CONTAINER,
        size_bytes,
        streams,
        portions,
        tuple(notes),
        topics=tuple(topics),
        last_ns=None if None in last_ns else max(filter(None, last_ns), default=None),
    )


def _first_ns(file: Path) -> float:
    """Log time of a file's first message; files without one come last."""
    with Source(file) as source:
        walk = Walk(source, _everything, Channels(), limit=_SEARCH_BYTES, buffer_bytes=_PEEK_BYTES)
        return next((int(messages.log_ns[0]) for messages in walk.messages()), math.inf)


@dataclass(slots=True)
class _Summary:
    """The end of a file: its channels, and the channels in each chunk, by place."""

    channels: Channels = field(default_factory=Channels)
    chunks: dict[int, frozenset[int]] = field(default_factory=dict)
    # Newest log time, None where it is not stated.
    last_ns: int | None = None


def _summary(source: Source) -> _Summary:
    """The summary of a file; empty where there is none or it cannot be read."""
    found = _Summary()
    place = source.size_bytes - FOOTER_BYTES
    start = summary_start(source.look_at(place, FOOTER_BYTES))
    if not start or not 0 < place - start <= MAX_RECORD_BYTES:
        return found
    # A channel is known by its schema, which may be behind it here.
    used = (Op.SCHEMA, Op.CHANNEL, Op.CHUNK_INDEX, Op.STATISTICS)
    every = records_of(source.look_at(start, place - start))
    records = list(itertools.islice((one for one in every if one[0] in used), _MOST_RECORDS))
    if len(records) == _MOST_RECORDS:
        return found
    for opcode, body in sorted(records, key=lambda record: record[0]):
        if opcode in (Op.SCHEMA, Op.CHANNEL):
            found.channels.add(opcode, body)
        elif opcode == Op.STATISTICS:
            found.last_ns = last_log_ns(body)
        elif opcode == Op.CHUNK_INDEX and (chunk := chunk_of_index(body)) is not None:
            found.chunks[chunk[0]] = chunk[1]
    return found


def _channels(source: Source, summary: _Summary, buffer_bytes: int) -> Channels:
    """The channels of a file: by its summary, else by a search from its front."""
    channels = summary.channels
    if not channels.topics:
        walk = Walk(source, _nothing, channels, limit=_SEARCH_BYTES, buffer_bytes=buffer_bytes)
        for _ in walk.messages():
            pass
    return channels


def _nothing(topic: Topic) -> bool:
    return False


def _everything(topic: Topic) -> bool:
    return True


def _portions(
    recording: BagRecording, files: Sequence[Path], buffer_bytes: int
) -> Generator[Portion, None, None]:
    """The messages that a recording selects, by file."""
    read_bytes = 0
    for file in files:
        with Source(file) as source:
            summary = _summary(source)
            topics = summary.channels.topics
            selected = {number for number, topic in topics.items() if recording.selects(topic)}
            # A channel that the summary does not describe may have a selected topic.
            unselected = topics.keys() - selected
            skip = frozenset(
                place for place, inside in summary.chunks.items() if inside <= unselected
            )
            walk = Walk(
                source, recording.selects, summary.channels, skip, buffer_bytes=buffer_bytes
            )
            numbers = _TopicNumbers(recording, walk.channels)
            try:
                for messages in walk.messages():
                    recording.position_bytes = read_bytes + source.position_bytes
                    yield numbers.portion(messages)
            finally:
                _report(recording, walk, file if len(files) > 1 else None)
            read_bytes += source.size_bytes
            recording.position_bytes = read_bytes


def _report(recording: BagRecording, walk: Walk, file: Path | None) -> None:
    """Add what a walk could not read to the notes and counts of the recording."""
    name = "" if file is None else f"{file.name}: "
    # A note that the file was cut off remains one.
    recording.notes += [type(note)(name + note) for note in walk.notes]
    recording.lose(count=walk.lost)


@dataclass(slots=True)
class _TopicNumbers:
    """Topics of a recording by channels of a file."""

    recording: BagRecording
    channels: Channels
    _table: I64Array = field(default_factory=lambda: np.full(1 << 16, -1, np.int64))

    def portion(self, messages: Portion) -> Portion:
        """Messages with the numbers of their topics."""
        topic = self._table[messages.topic]
        if (topic < 0).any():
            for number, known in self.channels.topics.items():
                if self.recording.selects(known):
                    self._table[number] = self.recording.number(known)
            topic = self._table[messages.topic]
        return replace(messages, topic=topic)
