"""The trick for decoded clouds: their points are re-packed as packets of mlbatch's own format.

The rest of the pipeline then batches them like raw packets: each packet is one column, i.e. points
that share a timestamp (`ros.point_packets`), of one size per topic, received at the log time of its
message. `CloudRecording` wraps a recording and adds these packets. Message types:
docs/sources/messages.md, section 8.
Counts: a packet is a frame with a datagram; an unreadable cloud is one frame, `truncated`.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.lidar.headers import hash_factors
from mlbatch.native.arena import PacketArena
from mlbatch.readers.bag.cloud_topics import CloudTopics
from mlbatch.ros.point_packets import HEAD, CloudError, Points, layout_of, pack
from mlbatch.ros.point_rows import PackedRows, RowPacker
from mlbatch.ros.point_times import stamps
from mlbatch.ros.pointcloud2 import CLOUD_TYPES, Cloud, raw_cloud, read_cloud
from mlbatch.types import (
    Message,
    PacketBatch,
    Recording,
    Stream,
    StreamTable,
    WrappedRecording,
)

# A batch ends when this many bytes of packets have been made.
_BATCH_BYTES = 8 << 20
# Points of a cloud that show its sensor; two columns and more.
_FIRST_POINTS = 512


@dataclass(slots=True)
class _TopicCounts:
    """Clouds and points of a topic; points: of all clouds that could be read."""

    # How the times of points are encoded.
    time_meanings: dict[str, None] = field(default_factory=dict)
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
        if cloud.time_meaning:
            self.time_meanings.setdefault(cloud.time_meaning)
        self.points += len(cloud.points) + cloud.without_place + cloud.without_time
        self.without_place += cloud.without_place
        self.without_time += cloud.without_time

    def add_packed(self, rows: int, packed: PackedRows) -> None:
        """Count a cloud of so many rows that was packed at once."""
        self.time_meanings.setdefault(packed.time_meaning)
        self.points += rows
        self.without_place += rows - packed.placed
        self.without_time += packed.placed - packed.points

    def add_fault(self, why: str) -> None:
        """Count a cloud that could not be read."""
        self.faults += 1
        self.first_fault = self.first_fault or why

    def verdict(self, layouts: str) -> str:
        """Meaning of the time field, layouts of the packets, points left out; "" without points."""
        if not self.points:
            return ""
        reasons = (
            (self.without_place, "without a place (NaN or zero)"),
            (self.without_time, "without a time"),
            (self.beyond_rings, "on rings beyond those of the first cloud"),
        )
        left_out = ", ".join(f"{count} {why}" for count, why in reasons if count) or "none"
        meanings = " or ".join(self.time_meanings)
        start = f"times of points from {meanings}; {layouts}; " if meanings else ""
        return f"{start}left out of {self.points} points: {left_out}"


class _Room:
    """Memory for the packets of a cloud: in an arena, at `place`."""

    def __init__(self, arena: PacketArena) -> None:
        self.place: int | None = None
        self._arena = arena

    def __call__(self, packets: int, size: int) -> U8Array:
        """Memory (packets, size) with any content."""
        region, self.place = self._arena.reserve(packets * size)
        return region.reshape(packets, size)


@dataclass(slots=True)
class _Packed:
    """Packets (n, size) of one lidar in a message; place, content_key: as in `PacketBatch`."""

    message: Message
    stream: Stream
    packets: U8Array
    place: int | None = None
    content_key: I64Array | None = None


class CloudRecording(WrappedRecording):
    """A recording whose decoded clouds come as packets, too.

    clouds: shared by the recordings of a session. Messages of cloud topics are passed on only if
    `keep` names them.
    """

    __slots__ = (
        *("_arena", "_counts", "_next_arena", "_pack_rows", "_scratch"),
        *("clouds", "streams"),
    )

    def __init__(self, inner: Recording, streams: StreamTable, clouds: CloudTopics) -> None:
        super().__init__(inner)
        self.streams = streams
        self.clouds = clouds
        self._counts: dict[str, _TopicCounts] = {}
        self._pack_rows = RowPacker()
        # For packets of this pass, and of the next one; `_scratch`: where none is given.
        self._scratch = PacketArena()
        self._arena = self._scratch
        self._next_arena: PacketArena | None = None

    def use_arena(self, arena: PacketArena) -> bool:
        """Pack the clouds of the next pass into an arena."""
        self._next_arena = arena
        return True

    @property
    def verdicts(self) -> list[str]:
        """Per topic: the meaning of its time field, and the points left out; one line each."""
        texts = (
            (name, counts.verdict(self._layouts_of(name))) for name, counts in self._counts.items()
        )
        return [f"{name}: {text}" for name, text in texts if text]

    def _layouts_of(self, topic: str) -> str:
        """Layouts of the packets of a topic, by lidar if there are several."""
        found = {s: layout for s, layout in self.clouds.layouts.items() if s.topic == topic}
        if len(found) < 2:
            return "".join(map(str, found.values()))
        return ", ".join(f"{stream}: {layout}" for stream, layout in found.items())

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield all packets from the start, including clouds; each call is a new pass."""
        self._counts = {topic.name: _TopicCounts() for topic in self.clouds.topics}
        arena = self._next_arena
        self._next_arena = None
        self._scratch = PacketArena()
        self._arena = self._scratch if arena is None else arena
        self.inner.keep = self.keep | self._counts.keys()
        # Clouds are read before the next batch.
        self.inner.lend = frozenset(self._counts.keys() - self.keep)
        batches = self.inner.packets()
        try:
            for batch in batches:
                # The last one is not in use any more.
                self._scratch.keep_from(None)
                for part in self._with_clouds(batch):
                    if len(part) or part.messages:
                        yield part
        finally:
            batches.close()
            self.inner.lend = frozenset()
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
            packed += self._packets_of(message)
            if sum(one.packets.nbytes for one in packed) >= _BATCH_BYTES:
                stop = int(np.searchsorted(receive_ns, latest_ns, side="right"))
                part = self._joined(batch.take(slice(done, stop)), packed)
                yield replace(part, messages=messages)
                done = max(done, stop)
                packed = []
                messages = ()
        yield replace(self._joined(batch.take(slice(done, None)), packed), messages=messages)

    def _packets_of(self, message: Message) -> list[_Packed]:
        """The packets of a cloud, by lidar; none where it has none or cannot be read."""
        name = message.topic.name
        counts = self.inner.counts
        try:
            at_once = self._packed_at_once(message)
            if at_once is not None:
                return [at_once]
            cloud = read_cloud(message, lambda frame: self.clouds.rule(name, frame))
            packed = [
                _Packed(message, stream, packets)
                for stream, points in self._by_lidar(name, cloud)
                if (packets := self._pack(message, stream, points)) is not None
            ]
        except CloudError as err:
            self._counts[name].add_fault(str(err))
            counts.frames += 1
            counts.skip("truncated")
            return []
        self._counts[name].add(cloud)
        for one in packed:
            self.clouds.frames.setdefault(one.stream, cloud.frame)
            counts.frames += len(one.packets)
            counts.datagrams += len(one.packets)
        return packed

    def _packed_at_once(self, message: Message) -> _Packed | None:
        """The packets of a usual cloud of one lidar that has a layout; None for others."""
        name = message.topic.name
        lidars = self.clouds.lidars[name]
        if not lidars.frames:
            return None
        raw = raw_cloud(message, lambda frame: self.clouds.rule(name, frame))
        if raw.lidar_id is not None:
            return None
        stream = lidars.stream(name, raw.frame, None)
        layout = self.clouds.layouts.get(stream)
        if layout is None:
            return None
        rule = self.clouds.rule(name, raw.frame)
        room = _Room(self._arena)
        rows = raw.rows[:_FIRST_POINTS] if self.clouds.first_points_only else raw.rows
        packed = self._pack_rows.pack(
            rows,
            lambda times: stamps(times, raw.zero, rule, raw.rows["time"]),
            layout,
            len(message.data),
            room,
            None if self._arena is self._scratch else hash_factors(layout.size // 8),
        )
        if packed is None:
            return None
        self._counts[name].add_packed(len(rows), packed)
        self.clouds.frames.setdefault(stream, raw.frame)
        self.inner.counts.frames += len(packed.packets)
        self.inner.counts.datagrams += len(packed.packets)
        # Places in the scratch memory are of this pass alone.
        place = None if self._arena is self._scratch else room.place
        return _Packed(message, stream, packed.packets, place, packed.content_key)

    def _by_lidar(self, topic: str, cloud: Cloud) -> Iterator[tuple[Stream, Points]]:
        """The points of each lidar, and its stream; none without points."""
        lidars = self.clouds.lidars[topic]
        ids = cloud.lidar_id
        if not len(cloud.points):
            return
        if ids is None or bool((ids == ids[0]).all()):
            yield (
                lidars.stream(topic, cloud.frame, None if ids is None else int(ids[0])),
                cloud.points,
            )
            return
        # Whichever of several lidars comes first in the points.
        for lidar_id in np.unique(ids).tolist():
            yield lidars.stream(topic, cloud.frame, lidar_id), cloud.points.take(ids == lidar_id)

    def _pack(self, message: Message, stream: Stream, points: Points) -> U8Array | None:
        """The packets of points that all have a place and a time."""
        layouts = self.clouds.layouts
        layout = layouts.get(stream)
        if layout is None:
            layout = layouts[stream] = layout_of(points, CLOUD_TYPES[message.topic.type])
        if layout.by_ring:
            if points.ring is None:
                raise CloudError("expected rings as in the first cloud, found none")
            if len(points) and int(points.ring.max()) >= layout.slots:
                known = points.ring < layout.slots
                beyond = len(points) - int(np.count_nonzero(known))
                self._counts[stream.topic].beyond_rings += beyond
                points = points.take(known)
        return pack(points, layout, len(message.data)) if len(points) else None

    def _joined(self, batch: PacketBatch, packed: Sequence[_Packed]) -> PacketBatch:
        """Packets of the recording and of its clouds, in receive order."""
        if not packed:
            return batch
        if len(packed) == 1 and not len(batch):
            return self._alone(packed[0])
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
            part[2] = self._number(one)
            part[3:] = one.message.host_ns
            parts.append(part)
            data.append(one.packets.reshape(-1))
            end += count * size
        columns = np.concatenate(parts, axis=1)
        columns = columns[:, np.argsort(columns[4], kind="stable")]
        joined = np.concatenate(data)
        start, size, stream, host_ns, _ = columns
        return PacketBatch(joined, start, size, stream, host_ns)

    def _alone(self, one: _Packed) -> PacketBatch:
        """The packets of a single cloud, where they are."""
        count, size = one.packets.shape
        return PacketBatch(
            one.packets.reshape(-1),
            np.arange(count) * size,
            np.full(count, size),
            np.full(count, self._number(one)),
            np.full(count, one.message.host_ns),
            place=one.place,
            content_key=one.content_key,
        )

    def _number(self, one: _Packed) -> int:
        """Number of the stream of a cloud; its packets have no receive time of their own."""
        number = self.streams.number(one.stream)
        self.streams.untimed.add(number)
        ends = np.ascontiguousarray(one.packets[[0, -1], : HEAD.itemsize]).view(HEAD)["stamp_ns"]
        span_ns = abs(int(ends[1, 0]) - int(ends[0, 0]))
        self.streams.message_ns[number] = max(span_ns, self.streams.message_ns.get(number, 0))
        return number
