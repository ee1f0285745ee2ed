"""Reading of bags, whatever their container: messages in, batches of packets out.

A container supplies portions of messages that lie in one array. Message types and what their stamps
mean: facts/messages.md, sections 1 and 3. Counting: one frame per UDP payload found in messages of
packet types, and one (`truncated`) per message of them that cannot be read.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mlbatch.readers.bag.packet_messages import (
    CORRECTION_TYPE,
    PACKET_TYPES,
    Found,
    MessageError,
    Unpacker,
)
from mlbatch.ros.definitions import type_key
from mlbatch.types import (
    CaptureCounts,
    I64Array,
    Message,
    PacketBatch,
    Stream,
    StreamTable,
    Topic,
    U8Array,
)

# A file of nothing but damage would fill memory and screen with what is wrong with it.
MOST_NOTES = 100


@dataclass(frozen=True, slots=True)
class Portion:
    """n messages in file order, valid until the next portion.

    Message i is `data[begin[i] : end[i]]`; begin, end: (n,) int64; log_ns: (n,) int64, log time;
    topic: (n,) int64, numbers given by `BagRecording.number`.
    """

    data: U8Array
    begin: I64Array
    end: I64Array
    log_ns: I64Array
    topic: I64Array


# One pass over the messages that `BagRecording.wants`; it tells the recording what it loses.
Pass: TypeAlias = "Callable[[BagRecording], Generator[Portion, None, None]]"


@dataclass(slots=True)
class BagRecording:
    """A bag; implements `Recording`.

    start: begins a pass over the messages; standing: notes that hold for every pass.
    """

    path: Path
    container: str
    size_bytes: int
    topics: tuple[Topic, ...]
    streams: StreamTable
    start: Pass
    standing: tuple[str, ...] = ()
    counts: CaptureCounts = field(default_factory=CaptureCounts)
    notes: list[str] = field(default_factory=list)
    position_bytes: int = 0
    keep: frozenset[str] = frozenset()
    _numbers: dict[Topic, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.notes = list(self.standing)
        for number, topic in enumerate(self.topics):
            self._numbers.setdefault(topic, number)

    def wants(self, topic: Topic) -> bool:
        """Whether the messages of a topic are asked for: they hold packets, or shall be kept."""
        return topic.name in self.keep or type_key(topic.type) in PACKET_TYPES

    def number(self, topic: Topic) -> int:
        """Number of a topic, also of one that is met only while reading."""
        number = self._numbers.setdefault(topic, len(self.topics))
        if number == len(self.topics):
            self.topics = (*self.topics, topic)
        return number

    def lose(self, note: str, count: int = 1) -> None:
        """Note what cannot be read, and count `count` messages of it as truncated."""
        if len(self.notes) < MOST_NOTES:
            self.notes.append(note)
        self.counts.frames += count
        self.counts.skip("truncated", count)

    def packets(self, until_ns: int | None = None) -> Iterator[PacketBatch]:
        """Yield all packets from the start, in file order; may be called again (counts restart).

        until_ns: stop once this much time (ns) has passed since the first packet's arrival.
        """
        self.counts, self.notes, self.position_bytes = CaptureCounts(), list(self.standing), 0
        unpacking = _Unpacking(self)
        portions = self.start(self)
        try:
            first_ns: int | None = None
            for portion in portions:
                batch = unpacking.batch(portion)
                if first_ns is None and len(batch):
                    first_ns = int(batch.host_ns[0])
                limit_ns = None if until_ns is None or first_ns is None else first_ns + until_ns
                cut = batch if limit_ns is None else self._until(batch, limit_ns)
                if len(cut) or cut.messages:
                    yield cut
                if cut is not batch:
                    return
        finally:
            self.notes += unpacking.faults()
            portions.close()

    def _until(self, batch: PacketBatch, limit_ns: int) -> PacketBatch:
        """The batch itself, or its front part up to the first packet beyond the limit."""
        beyond = np.flatnonzero(batch.host_ns > limit_ns)
        if not len(beyond):
            return batch
        left_out = len(batch) - int(beyond[0])
        self.counts.frames -= left_out
        self.counts.datagrams -= left_out
        messages = tuple(m for m in batch.messages if m.host_ns <= limit_ns)
        return replace(batch.take(slice(0, int(beyond[0]))), messages=messages)


class _Unpacking:
    """Turns portions into batches; remembers which topics cannot be read."""

    def __init__(self, recording: BagRecording) -> None:
        self._recording = recording
        self._unpackers: dict[int, Unpacker | None] = {}
        self._faulty: dict[int, tuple[int, str]] = {}

    def faults(self) -> list[str]:
        """A line for each topic with messages that could not be read."""
        topics = self._recording.topics
        return [
            f"{topics[number].name}: {count} messages could not be read; the first: {why}"
            for number, (count, why) in self._faulty.items()
        ]

    def batch(self, portion: Portion) -> PacketBatch:
        """Packets and kept messages of a portion."""
        kept: list[tuple[int, Message]] = []
        parts: list[tuple[I64Array, Found, int]] = []
        # Streams get their numbers in the order in which they appear.
        for number in dict.fromkeys(portion.topic.tolist()):
            topic = self._recording.topics[number]
            rows = np.flatnonzero(portion.topic == number)
            if topic.name in self._recording.keep:
                kept += [(row, _message(topic, portion, row)) for row in rows.tolist()]
            unpacker = self._unpacker(number, topic, len(rows))
            if unpacker is None:
                continue
            begin, end, log_ns = (a[rows] for a in (portion.begin, portion.end, portion.log_ns))
            found = unpacker.find_many(portion.data, begin, end, log_ns)
            self._count(number, found)
            kept += self._corrections(topic, found, rows, log_ns)
            parts.append((rows[found.message], found, self._stream(topic, found)))
        kept.sort(key=lambda entry: entry[0])
        return _joined(portion.data, parts, tuple(message for _, message in kept))

    def _unpacker(self, number: int, topic: Topic, messages: int) -> Unpacker | None:
        """What finds packets in a topic's messages, None where they hold none."""
        if type_key(topic.type) not in PACKET_TYPES:
            return None
        if number not in self._unpackers:
            try:
                self._unpackers[number] = Unpacker(topic)
            except MessageError as err:
                self._unpackers[number] = None
                self._faulty[number] = (0, str(err))
        unpacker = self._unpackers[number]
        if unpacker is None:
            self._blame(number, messages, "")
        return unpacker

    def _count(self, number: int, found: Found) -> None:
        counts = self._recording.counts
        counts.datagrams += len(found.start)
        counts.frames += len(found.start) + len(found.corrections) + found.empty
        counts.skip("no_stream", len(found.corrections))
        counts.skip("truncated", found.empty)
        if found.faults:
            self._blame(number, len(found.faults), found.faults[0][1])

    def _blame(self, number: int, messages: int, why: str) -> None:
        before, first = self._faulty.get(number, (0, why))
        self._faulty[number] = before + messages, first
        self._recording.counts.frames += messages
        self._recording.counts.skip("truncated", messages)

    def _stream(self, topic: Topic, found: Found) -> int:
        """Number of a topic's stream; a topic without packets is none."""
        if not len(found.start):
            return 0
        streams = self._recording.streams
        stream = streams.number(Stream(topic=topic.name))
        if found.untimed:
            streams.untimed.add(stream)
        return stream

    def _corrections(
        self, topic: Topic, found: Found, rows: I64Array, log_ns: I64Array
    ) -> list[tuple[int, Message]]:
        """Calibrations from among the packets, as messages of a type of our own."""
        if topic.name not in self._recording.keep:
            return []
        own = Topic(topic.name, CORRECTION_TYPE, "bytes")
        return [
            (int(rows[message]), Message(own, int(log_ns[message]), data))
            for message, data in found.corrections
        ]


def _message(topic: Topic, portion: Portion, row: int) -> Message:
    begin, end = int(portion.begin[row]), int(portion.end[row])
    return Message(topic, int(portion.log_ns[row]), portion.data[begin:end].tobytes())


def _joined(
    data: U8Array, parts: list[tuple[I64Array, Found, int]], messages: tuple[Message, ...]
) -> PacketBatch:
    """Packets of several topics in the order of their messages."""
    if len(parts) == 1:
        _, found, stream = parts[0]
        numbers = np.full(len(found.start), stream, np.int64)
        return PacketBatch(data, found.start, found.size, numbers, found.host_ns, messages)
    none = np.zeros(0, np.int64)
    order = np.argsort(np.concatenate([none, *(row for row, _, _ in parts)]), kind="stable")
    each = [np.full(len(found.start), stream, np.int64) for _, found, stream in parts]
    return PacketBatch(
        data,
        np.concatenate([none, *(found.start for _, found, _ in parts)])[order],
        np.concatenate([none, *(found.size for _, found, _ in parts)])[order],
        np.concatenate([none, *each])[order],
        np.concatenate([none, *(found.host_ns for _, found, _ in parts)])[order],
        messages,
    )


def is_latched(qos: str) -> bool:
    """Whether a recorder's QoS text says transient local: as a word, or 1 in older versions."""
    words = qos.replace("\\n", "\n").split()
    pairs = itertools.pairwise(words)
    return any(a.lstrip("-") == "durability:" and b in ("1", "transient_local") for a, b in pairs)
