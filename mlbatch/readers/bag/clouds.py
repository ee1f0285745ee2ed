"""Decoded clouds of a bag as packets, so that their points are batched by time like all others.

Source of the message types: facts/messages.md, section 8. A `CloudRecording` stands for a
recording and adds, for every cloud, packets of one size per topic (`_cloud_packets`) at its log
time. A packet is one column: frames and datagrams count them; a cloud that cannot be read is one
frame, `truncated`. What the times of a topic were taken for, and how many points had no place, is
a note.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mlbatch.ros.point_packets import (
    HEAD,
    KINDS,
    MAGIC,
    MOST_SLOTS,
    REALS,
    VERSION,
    CloudError,
    Layout,
    Points,
    layout_of,
    pack,
)
from mlbatch.ros.pointcloud2 import CLOUD_TYPES, Cloud, read_cloud
from mlbatch.types import (
    CaptureCounts,
    Message,
    PacketBatch,
    Recording,
    Stream,
    StreamTable,
    Topic,
    U8Array,
)

__all__ = [
    "CLOUD_TYPES",
    "HEAD",
    "KINDS",
    "MAGIC",
    "MOST_SLOTS",
    "REALS",
    "VERSION",
    "CloudRecording",
    "Layout",
    "cloud_topics",
]

_ENCODINGS = ("cdr", "ros1")
# Packets that are made before they are handed on.
_PART_BYTES = 8 << 20


def cloud_topics(topics: Iterable[Topic]) -> tuple[Topic, ...]:
    """The topics whose messages are decoded clouds, in their order."""
    return tuple(t for t in topics if t.type in CLOUD_TYPES and t.encoding in _ENCODINGS)


@dataclass(slots=True)
class _Tally:
    """What became of the clouds of a topic; points: of all that were read."""

    verdict: str = ""
    points: int = 0
    placeless: int = 0
    timeless: int = 0
    ringless: int = 0
    faults: int = 0
    first_fault: str = ""

    def add(self, cloud: Cloud) -> None:
        """Count a cloud that was read."""
        self.verdict = self.verdict or cloud.verdict
        self.points += len(cloud.points) + cloud.placeless + cloud.timeless
        self.placeless += cloud.placeless
        self.timeless += cloud.timeless

    def verdicts(self, layout: Layout | None) -> Iterator[str]:
        """What the times of a topic were taken for, and what had no place."""
        if self.points:
            left_out = [
                f"{count} {why}"
                for count, why in (
                    (self.placeless, "without a place (NaN or zero)"),
                    (self.timeless, "without a time"),
                    (self.ringless, "on rings beyond those of the first cloud"),
                )
                if count
            ]
            verdict = f"times of points from {self.verdict}; {layout}; " if self.verdict else ""
            yield f"{verdict}left out of {self.points} points: {', '.join(left_out) or 'none'}"

    def notes(self) -> Iterator[str]:
        """What is wrong with the clouds of a topic."""
        if self.faults:
            yield f"{self.faults} clouds could not be read; the first: {self.first_fault}"


@dataclass(slots=True)
class _Made:
    """Packets that were made of one message."""

    message: Message
    packets: U8Array


@dataclass(slots=True)
class CloudRecording:
    """A recording whose clouds come as packets, too; implements `Recording`.

    topics_of_clouds: as `cloud_topics` gives them; layouts: how the packets of each topic are made,
    shared by the recordings of a session, since a topic may be spread over several; frames: the
    frame_id of each topic's first cloud. Messages of cloud topics are handed over only if `keep`
    names them.
    """

    inner: Recording
    streams: StreamTable
    topics_of_clouds: Sequence[Topic]
    layouts: dict[str, Layout] = field(default_factory=dict)
    frames: dict[str, str] = field(default_factory=dict)
    keep: frozenset[str] = frozenset()
    notes: list[str] = field(default_factory=list)
    verdicts: list[str] = field(default_factory=list)
    counts: CaptureCounts = field(default_factory=CaptureCounts)
    topics: tuple[Topic, ...] = ()
    path: Path = Path()
    container: str = ""
    size_bytes: int = 0
    position_bytes: int = 0
    _tallies: dict[str, _Tally] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.path, self.container = self.inner.path, self.inner.container
        self.size_bytes = self.inner.size_bytes
        self._follow()

    def packets(self, until_ns: int | None = None) -> Iterator[PacketBatch]:
        """Yield all packets from the start, in file order; may be called again (counts restart).

        until_ns: stop once this much time (ns) has passed since the first packet's arrival.
        """
        self._tallies = {topic.name: _Tally() for topic in self.topics_of_clouds}
        self.inner.keep = self.keep | self._tallies.keys()
        # The recording knows no packet of a bag that holds clouds alone, hence no limit either.
        batches = self.inner.packets()
        first_ns: int | None = None
        try:
            for batch in batches:
                for part in self._parts(batch):
                    if first_ns is None and len(part):
                        first_ns = int(part.host_ns[0])
                    limit_ns = None if until_ns is None or first_ns is None else first_ns + until_ns
                    cut = part if limit_ns is None else self._until(part, limit_ns)
                    self._follow()
                    if len(cut) or cut.messages:
                        yield cut
                    if cut is not part:
                        return
        finally:
            if isinstance(batches, Generator):
                batches.close()
            self._follow()

    def _follow(self) -> None:
        """Take over what the inner recording says of itself, and add what was found here."""
        inner = self.inner
        self.topics, self.counts = inner.topics, inner.counts
        self.position_bytes = inner.position_bytes
        tallies = self._tallies.items()
        self.notes = inner.notes + [
            f"{name}: {n}" for name, tally in tallies for n in tally.notes()
        ]
        self.verdicts = [
            f"{name}: {verdict}"
            for name, tally in tallies
            for verdict in tally.verdicts(self.layouts.get(name))
        ]

    def _parts(self, batch: PacketBatch) -> Iterator[PacketBatch]:
        """A batch with the packets of its clouds, cut where these grow large."""
        messages = tuple(m for m in batch.messages if m.topic.name in self.keep)
        clouds = [m for m in batch.messages if m.topic.name in self._tallies]
        if not clouds:
            yield replace(batch, messages=messages)
            return
        arrival_ns = np.maximum.accumulate(batch.host_ns)
        made: list[_Made] = []
        done, latest_ns = 0, 0
        for message in clouds:
            latest_ns = max(latest_ns, message.host_ns)
            packets = self._made(message)
            if packets is not None:
                made.append(_Made(message, packets))
            if sum(one.packets.nbytes for one in made) >= _PART_BYTES:
                upto = int(np.searchsorted(arrival_ns, latest_ns, side="right"))
                yield replace(self._joined(batch.take(slice(done, upto)), made), messages=messages)
                done, made, messages = max(done, upto), [], ()
        yield replace(self._joined(batch.take(slice(done, None)), made), messages=messages)

    def _made(self, message: Message) -> U8Array | None:
        """The packets of a cloud; None where it has none, which is counted."""
        name = message.topic.name
        tally, counts = self._tallies[name], self.inner.counts
        try:
            cloud = read_cloud(message)
            packets = self._packed(message, cloud.points) if len(cloud.points) else None
        except CloudError as err:
            tally.faults += 1
            tally.first_fault = tally.first_fault or str(err)
            counts.frames += 1
            counts.skip("truncated")
            return None
        tally.add(cloud)
        self.frames.setdefault(name, cloud.frame)
        if packets is not None:
            counts.frames += len(packets)
            counts.datagrams += len(packets)
        return packets

    def _packed(self, message: Message, points: Points) -> U8Array | None:
        """The packets of points that all have a place and a time."""
        name = message.topic.name
        layout = self.layouts.get(name)
        if layout is None:
            layout = self.layouts[name] = layout_of(points, CLOUD_TYPES[message.topic.type])
        if layout.by_ring:
            if points.ring is None:
                raise CloudError("wanted rings as in the first cloud, got none")
            known = points.ring < layout.slots
            self._tallies[name].ringless += len(points) - int(np.count_nonzero(known))
            points = points.take(known)
        return pack(points, layout, len(message.data)) if len(points) else None

    def _joined(self, batch: PacketBatch, made: Sequence[_Made]) -> PacketBatch:
        """Packets of a recording and those made of clouds, in the order of their arrival."""
        if not made:
            return batch
        # The bytes of the recording's own packets are copied only where there are any.
        data = [batch.data] if len(batch) else []
        end = len(batch.data) if len(batch) else 0
        arrival_ns = np.maximum.accumulate(batch.host_ns)
        rows = [np.stack([batch.start, batch.size, batch.stream, batch.host_ns, arrival_ns])]
        for one in made:
            count, width = one.packets.shape
            row = np.empty((5, count), np.int64)
            row[0] = end + np.arange(count) * width
            row[1], row[2] = width, self._number(one.message.topic)
            row[3:] = one.message.host_ns
            rows.append(row)
            data.append(one.packets.reshape(-1))
            end += count * width
        whole = np.concatenate(rows, axis=1)
        whole = whole[:, np.argsort(whole[4], kind="stable")]
        return PacketBatch(np.concatenate(data), whole[0], whole[1], whole[2], whole[3])

    def _number(self, topic: Topic) -> int:
        """Number of a topic's stream, whose packets have no arrival time of their own."""
        number = self.streams.number(Stream(topic=topic.name))
        self.streams.untimed.add(number)
        return number

    def _until(self, batch: PacketBatch, limit_ns: int) -> PacketBatch:
        """The batch itself, or its front part up to the first packet beyond the limit."""
        beyond = np.flatnonzero(batch.host_ns > limit_ns)
        if not len(beyond):
            return batch
        left_out = len(batch) - int(beyond[0])
        self.inner.counts.frames -= left_out
        self.inner.counts.datagrams -= left_out
        messages = tuple(m for m in batch.messages if m.host_ns <= limit_ns)
        return replace(batch.take(slice(0, int(beyond[0]))), messages=messages)
