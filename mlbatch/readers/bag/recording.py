"""Bags, whatever their container: portions of messages in, batches of packets out.

Message types and the meaning of their stamps: docs/sources/messages.md, sections 1 and 3.
Counts: one frame per UDP payload in messages of packet types, and one (`truncated`) per message of
them that cannot be read.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.readers import CORRECTION_TYPE
from mlbatch.readers.bag.packet_messages import PacketsFound, Unpacker
from mlbatch.ros.definitions import type_key
from mlbatch.ros.encoding import MessageError
from mlbatch.ros.packet_types import PACKET_TYPES
from mlbatch.types import (
    CaptureCounts,
    CutOff,
    Message,
    PacketBatch,
    Recording,
    Stream,
    StreamTable,
    Topic,
)

# A file full of damage would fill memory and screen with notes.
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


# Begins a pass over the messages that `BagRecording.selects`; reports losses to the recording.
PortionReader: TypeAlias = "Callable[[BagRecording], Generator[Portion, None, None]]"


@dataclass(slots=True)
class BagRecording(Recording):
    """A bag; opening_notes: what was wrong when it was opened, part of the notes of every pass."""

    streams: StreamTable
    portions: PortionReader
    opening_notes: tuple[str, ...] = ()
    _numbers: dict[Topic, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.notes = list(self.opening_notes)
        for number, topic in enumerate(self.topics):
            self._numbers.setdefault(topic, number)

    def selects(self, topic: Topic) -> bool:
        """Whether the messages of a topic are read: they contain packets, or are to be kept."""
        return topic.name in self.keep or type_key(topic.type) in PACKET_TYPES

    def number(self, topic: Topic) -> int:
        """Number of a topic, also of one that first appears while reading."""
        number = self._numbers.setdefault(topic, len(self.topics))
        if number == len(self.topics):
            self.topics = (*self.topics, topic)
        return number

    def lose(self, note: str = "", count: int = 1) -> None:
        """Note once what cannot be read, and count `count` messages of it as truncated."""
        has_room = len(self.notes) < MOST_NOTES or isinstance(note, CutOff)
        if note and has_room and note not in self.notes:
            self.notes.append(note)
        self.counts.frames += count
        self.counts.skip("truncated", count)

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield all packets from the start, in file order; each call is a new pass."""
        self.counts = CaptureCounts()
        self.notes = list(self.opening_notes)
        self.position_bytes = 0
        unpacking = _Unpacking(self)
        portions = self.portions(self)
        try:
            for portion in portions:
                batch = unpacking.batch(portion)
                if len(batch) or batch.messages:
                    yield batch
        finally:
            self.notes += unpacking.faults()
            portions.close()


@dataclass(frozen=True, slots=True)
class _TopicPackets:
    """Packets of one topic in a portion; row: (p,) int64, message of each in the portion."""

    found: PacketsFound
    row: I64Array
    stream: int


class _Unpacking:
    """Converts portions to batches; remembers which topics cannot be read."""

    def __init__(self, recording: BagRecording) -> None:
        self._recording = recording
        self._unpackers: dict[int, Unpacker | None] = {}
        # By topic: number of unreadable messages, and why the first of them is.
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
        parts: list[_TopicPackets] = []
        # Streams are numbered in order of appearance.
        for number in dict.fromkeys(portion.topic.tolist()):
            topic = self._recording.topics[number]
            rows = np.flatnonzero(portion.topic == number)
            if topic.name in self._recording.keep:
                lends = topic.name in self._recording.lend
                kept += [(row, _message(topic, portion, row, lends)) for row in rows.tolist()]
            unpacker = self._unpacker(number, topic, len(rows))
            if unpacker is None:
                continue
            log_ns = portion.log_ns[rows]
            found = unpacker.find_many(portion.data, portion.begin[rows], portion.end[rows], log_ns)
            self._count(number, found)
            kept += self._corrections(topic, found, rows, log_ns)
            parts.append(_TopicPackets(found, rows[found.message], self._stream(topic, found)))
        kept.sort(key=lambda entry: entry[0])
        return _joined(portion.data, parts, tuple(message for _, message in kept))

    def _unpacker(self, number: int, topic: Topic, messages: int) -> Unpacker | None:
        """Finds the packets in a topic's messages; None where they contain none."""
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
            self._add_faults(number, messages, "")
        return unpacker

    def _count(self, number: int, found: PacketsFound) -> None:
        counts = self._recording.counts
        counts.datagrams += len(found.start)
        counts.frames += len(found.start) + len(found.corrections) + found.empty
        counts.skip("no_stream", len(found.corrections))
        counts.skip("truncated", found.empty)
        if found.faults:
            self._add_faults(number, len(found.faults), found.faults[0][1])

    def _add_faults(self, number: int, messages: int, why: str) -> None:
        before, first = self._faulty.get(number, (0, why))
        self._faulty[number] = (before + messages, first)
        self._recording.counts.frames += messages
        self._recording.counts.skip("truncated", messages)

    def _stream(self, topic: Topic, found: PacketsFound) -> int:
        """Number of a topic's stream; a topic without packets has none, and gets 0."""
        if not len(found.start):
            return 0
        streams = self._recording.streams
        stream = streams.number(Stream(topic=topic.name))
        if found.untimed:
            streams.untimed.add(stream)
        most = int(np.bincount(found.message).max())
        streams.most_packets[stream] = max(most, streams.most_packets.get(stream, 0))
        return stream

    def _corrections(
        self, topic: Topic, found: PacketsFound, rows: I64Array, log_ns: I64Array
    ) -> list[tuple[int, Message]]:
        """Return calibrations among the packets as messages of `CORRECTION_TYPE`."""
        if topic.name not in self._recording.keep:
            return []
        own = Topic(topic.name, CORRECTION_TYPE, "bytes")
        return [
            (int(rows[message]), Message(own, int(log_ns[message]), data))
            for message, data in found.corrections
        ]


def _message(topic: Topic, portion: Portion, row: int, lends: bool) -> Message:
    data = portion.data[int(portion.begin[row]) : int(portion.end[row])]
    return Message(topic, int(portion.log_ns[row]), data.data if lends else data.tobytes())


def _joined(
    data: U8Array, parts: list[_TopicPackets], messages: tuple[Message, ...]
) -> PacketBatch:
    """Packets of several topics in the order of their messages."""
    if len(parts) == 1:
        found = parts[0].found
        stream = np.full(len(found.start), parts[0].stream, np.int64)
        return PacketBatch(data, found.start, found.size, stream, found.host_ns, messages)
    none = np.zeros(0, np.int64)
    streams = [np.full(len(part.row), part.stream, np.int64) for part in parts]
    order = np.argsort(np.concatenate([none, *(part.row for part in parts)]), kind="stable")
    return PacketBatch(
        data,
        np.concatenate([none, *(part.found.start for part in parts)])[order],
        np.concatenate([none, *(part.found.size for part in parts)])[order],
        np.concatenate([none, *streams])[order],
        np.concatenate([none, *(part.found.host_ns for part in parts)])[order],
        messages,
    )


def is_latched(qos: str) -> bool:
    """Whether a recorded QoS text says transient local: as a word, or 1 in older versions."""
    words = qos.replace("\\n", "\n").split()
    pairs = itertools.pairwise(words)
    return any(a.lstrip("-") == "durability:" and b in ("1", "transient_local") for a, b in pairs)
