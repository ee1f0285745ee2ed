"""The trick for decoded clouds: their points are re-packed as packets of an own format.

The rest of the pipeline then batches them like raw packets: each packet is one column, i.e. points
that share a timestamp (`ros.point_packets`), of one size per topic, received at the log time of its
message. `CloudRecording` wraps a recording and adds these packets. Message types:
docs/sources/messages.md, section 8.
Counts: a packet is a frame with a datagram; an unreadable cloud is one frame, `truncated`.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.ros.encoding import ENCODINGS
from mlbatch.ros.point_packets import CloudError, Layout, Points, layout_of, pack
from mlbatch.ros.pointcloud2 import CLOUD_TYPES, Cloud, read_cloud
from mlbatch.types import (
    Message,
    PacketBatch,
    Recording,
    Stream,
    StreamTable,
    Topic,
    WrappedRecording,
)

# A batch ends when this many bytes of packets have been made.
_BATCH_BYTES = 8 << 20


def cloud_topics(topics: Iterable[Topic]) -> tuple[Topic, ...]:
    """The topics of decoded clouds, in order."""
    return tuple(
        topic for topic in topics if topic.type in CLOUD_TYPES and topic.encoding in ENCODINGS
    )


@dataclass(slots=True)
class _TopicCounts:
    """Clouds and points of a topic; points: of all clouds that could be read."""

    # How the times of points are encoded; empty before the first cloud.
    time_meaning: str = ""
    points: int = 0
    # Points with coordinates that are NaN or zero.
    without_place: int = 0
    # Points with a time that is not usable.
    without_time: int = 0
    # Points with a ring that the first cloud did not have.
    beyond_rings: int = 0
    # Clouds that could not be read.
    faults: int = 0
    # Reason of the first of them.
    first_fault: str = ""

    def add(self, cloud: Cloud) -> None:
        """Count a cloud that was read."""
        self.time_meaning = self.time_meaning or cloud.time_meaning
        self.points += len(cloud.points) + cloud.without_place + cloud.without_time
        self.without_place += cloud.without_place
        self.without_time += cloud.without_time

    def add_fault(self, why: str) -> None:
        """Count a cloud that could not be read."""
        self.faults += 1
        self.first_fault = self.first_fault or why

    def verdict(self, layout: Layout | None) -> str:
        """Meaning of the time field, layout of the packets, points left out; "" without points."""
        if not self.points:
            return ""
        reasons = (
            (self.without_place, "without a place (NaN or zero)"),
            (self.without_time, "without a time"),
            (self.beyond_rings, "on rings beyond those of the first cloud"),
        )
        left_out = ", ".join(f"{count} {why}" for count, why in reasons if count) or "none"
        start = f"times of points from {self.time_meaning}; {layout}; " if self.time_meaning else ""
        return f"{start}left out of {self.points} points: {left_out}"


@dataclass(slots=True)
class _Packed:
    """Packets (n, size) of one message."""

    message: Message
    packets: U8Array


class CloudRecording(WrappedRecording):
    """A recording whose decoded clouds come as packets, too.

    topics_of_clouds: as given by `cloud_topics`; layouts: of the packets of each topic, shared by
    the recordings of a session, since a topic may be spread over several; frames: frame_id of the
    first cloud of each topic. Messages of cloud topics are passed on only if `keep` names them.
    """

    __slots__ = ("_counts", "frames", "layouts", "streams", "topics_of_clouds")

    def __init__(
        self,
        inner: Recording,
        streams: StreamTable,
        topics_of_clouds: Sequence[Topic],
        layouts: dict[str, Layout] | None = None,
    ) -> None:
        super().__init__(inner)
        self.streams = streams
        self.topics_of_clouds = topics_of_clouds
        self.layouts = {} if layouts is None else layouts
        self.frames: dict[str, str] = {}
        self._counts: dict[str, _TopicCounts] = {}

    @property
    def verdicts(self) -> list[str]:
        """Per topic: the meaning of its time field, and the points left out; one line each."""
        texts = (
            (name, counts.verdict(self.layouts.get(name))) for name, counts in self._counts.items()
        )
        return [f"{name}: {text}" for name, text in texts if text]

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield all packets from the start, those of clouds among them; each call is a new pass."""
        self._counts = {topic.name: _TopicCounts() for topic in self.topics_of_clouds}
        self.inner.keep = self.keep | self._counts.keys()
        batches = self.inner.packets()
        try:
            for batch in batches:
                for part in self._with_clouds(batch):
                    if len(part) or part.messages:
                        yield part
        finally:
            batches.close()
            self.inner.notes += [
                f"{name}: {counts.faults} clouds could not be read; the first: {counts.first_fault}"
                for name, counts in self._counts.items()
                if counts.faults
            ]

    def _with_clouds(self, batch: PacketBatch) -> Iterator[PacketBatch]:
        """The batch with the packets of its clouds, in parts where these are large."""
        messages = tuple(m for m in batch.messages if m.topic.name in self.keep)
        clouds = [m for m in batch.messages if m.topic.name in self._counts]
        if not clouds:
            yield replace(batch, messages=messages)
            return
        receive_ns = np.maximum.accumulate(batch.host_ns)
        packed: list[_Packed] = []
        done = 0
        latest_ns = 0
        for message in clouds:
            latest_ns = max(latest_ns, message.host_ns)
            packets = self._packets_of(message)
            if packets is not None:
                packed.append(_Packed(message, packets))
            if sum(one.packets.nbytes for one in packed) >= _BATCH_BYTES:
                stop = int(np.searchsorted(receive_ns, latest_ns, side="right"))
                part = self._joined(batch.take(slice(done, stop)), packed)
                yield replace(part, messages=messages)
                done = max(done, stop)
                packed = []
                messages = ()
        yield replace(self._joined(batch.take(slice(done, None)), packed), messages=messages)

    def _packets_of(self, message: Message) -> U8Array | None:
        """The packets (n, size) of a cloud; None where it has none or cannot be read."""
        name = message.topic.name
        counts = self.inner.counts
        try:
            cloud = read_cloud(message)
            packets = self._pack(message, cloud.points) if len(cloud.points) else None
        except CloudError as err:
            self._counts[name].add_fault(str(err))
            counts.frames += 1
            counts.skip("truncated")
            return None
        self._counts[name].add(cloud)
        self.frames.setdefault(name, cloud.frame)
        if packets is not None:
            counts.frames += len(packets)
            counts.datagrams += len(packets)
        return packets

    def _pack(self, message: Message, points: Points) -> U8Array | None:
        """The packets of points that all have a place and a time."""
        name = message.topic.name
        layout = self.layouts.get(name)
        if layout is None:
            layout = self.layouts[name] = layout_of(points, CLOUD_TYPES[message.topic.type])
        if layout.by_ring:
            if points.ring is None:
                raise CloudError("expected rings as in the first cloud, found none")
            known = points.ring < layout.slots
            self._counts[name].beyond_rings += len(points) - int(np.count_nonzero(known))
            points = points.take(known)
        return pack(points, layout, len(message.data)) if len(points) else None

    def _joined(self, batch: PacketBatch, packed: Sequence[_Packed]) -> PacketBatch:
        """Packets of the recording and of its clouds, in receive order."""
        if not packed:
            return batch
        # The bytes of the recording's own packets are copied only where there are any.
        data = [batch.data] if len(batch) else []
        end = len(batch.data) if len(batch) else 0
        receive_ns = np.maximum.accumulate(batch.host_ns)
        # Rows: start, size, stream, host_ns, and the key of the order.
        parts = [np.stack([batch.start, batch.size, batch.stream, batch.host_ns, receive_ns])]
        for one in packed:
            count, size = one.packets.shape
            part = np.empty((5, count), np.int64)
            part[0] = end + np.arange(count) * size
            part[1] = size
            part[2] = self._stream(one.message.topic)
            part[3:] = one.message.host_ns
            parts.append(part)
            data.append(one.packets.reshape(-1))
            end += count * size
        columns = np.concatenate(parts, axis=1)
        columns = columns[:, np.argsort(columns[4], kind="stable")]
        return PacketBatch(np.concatenate(data), columns[0], columns[1], columns[2], columns[3])

    def _stream(self, topic: Topic) -> int:
        """Number of a topic's stream; its packets have no receive time of their own."""
        number = self.streams.number(Stream(topic=topic.name))
        self.streams.untimed.add(number)
        return number
