"""The first 10 s of a session, read once and asked by all that is decided before a run.

Which streams there are and what they send (`sampler`), calibrations and transforms (`metadata`),
decoded clouds and their times (`clouds`), and how far the clocks are ahead of receive times. A
capture of few bytes that ends within is kept, and the run starts from it. What is longer is read
again: reading goes 10 s ahead, which may be a gigabyte, and a capture cannot be continued from its
middle, where fragments may be open. Bags deliver other topics to a run.
"""

from __future__ import annotations

import contextlib
import difflib
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from mlbatch import sensors
from mlbatch.clocks.compare import COMPARABLE_NS
from mlbatch.discovery.calibrations import MetadataCollector, subscribe
from mlbatch.discovery.sampler import KindFilter, Sampler, split_by_kind
from mlbatch.discovery.types import DetectedSensor, Note, PacketKind
from mlbatch.errors import RigError
from mlbatch.native.capture import CaptureLoops
from mlbatch.readers import has_packets, merge
from mlbatch.readers.byte_records import SLACK
from mlbatch.readers.merge import Seen, never
from mlbatch.rig.rig import Rig, RigSensor
from mlbatch.types import PacketBatch, Recording, StreamTable
from mlbatch.units import NS_PER_MS, NS_PER_S

if TYPE_CHECKING:
    from mlbatch.readers.bag.cloud_topics import CloudTopics

ByLogTime: TypeAlias = Callable[[Recording], bool]
# Length of the part that is read.
FIRST_NS = 10 * NS_PER_S
# Bytes of packets that are kept for the run: as many as it reads at a time.
KEPT_BYTES = 8 << 20
# Packets of a kind that are checked for being a lidar's.
_CHECKED = 16
# Clouds farther apart by their log times need more than different delays of their drivers.
_CLOUDS_APART_NS = 150 * NS_PER_MS
# Topics that an error names.
_TOPICS = 6


class FirstSeconds:
    """All packets up to 10 s after the first lidar packet; a capture may start long before it.

    recordings: to read, decoded clouds are packets; clouds: these, or None; sampler: samples of
    all streams; metadata: messages with calibrations and transforms. The end does not depend on
    the size of batches.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        table: StreamTable,
        clouds: CloudTopics | None = None,
        *,
        cut_clouds: bool = False,
    ) -> None:
        """cut_clouds: the first points of each are enough; counts of packets are too small."""
        self.recordings = recordings
        self.clouds = clouds
        self.sampler = Sampler(table)
        self.metadata = MetadataCollector()
        self._is_all = False
        # None: too many, or not of a capture.
        self._kept: list[PacketBatch] | None = None
        if len(recordings) == 1 and not recordings[0].topics:
            self._kept = []
        subscribe(recordings)
        if clouds is not None:
            clouds.first_points_only = cut_clouds
        try:
            for batch in self._read():
                self._keep(batch)
                self.sampler.add(batch)
                self.metadata.add(batch)
        finally:
            if clouds is not None:
                clouds.first_points_only = False
        for recording in recordings:
            recording.keep = frozenset()

    def _keep(self, batch: PacketBatch) -> None:
        """Keep a copy of the packets of a batch, if all that are kept stay within KEPT_BYTES."""
        if self._kept is None or not len(batch):
            return
        end = np.cumsum(batch.size)
        if sum(len(kept.data) for kept in self._kept) + int(end[-1]) > KEPT_BYTES:
            self._kept = None
            return
        start = end - batch.size
        data = np.zeros(int(end[-1]) + SLACK, np.uint8)
        CaptureLoops().copy_runs(batch.data, batch.start, batch.size, data, start)
        self._kept.append(replace(batch, data=data, start=start, place=None))

    def _read(
        self, by_log_time: ByLogTime = never, seen: Seen | None = None
    ) -> Iterator[PacketBatch]:
        end_ns: int | None = None
        kind_filter, checked = KindFilter(), Counter[PacketKind]()
        with contextlib.closing(merge(self.recordings, by_log_time, seen)) as batches:
            for batch in batches:
                row = 0
                if end_ns is None:
                    first = _first_of_lidar(batch, kind_filter, checked)
                    if first is None:
                        yield batch
                        continue
                    row, end_ns = first, int(batch.host_ns[first]) + FIRST_NS
                later = np.flatnonzero(batch.host_ns[row:] > end_ns)
                if len(later):
                    taken = batch.take(slice(0, row + int(later[0])))
                    yield replace(taken, messages=batch.messages)
                    return
                yield batch
        self._is_all = True

    # -- packets ------------------------------------------------------------------------------

    @property
    def has_all(self) -> bool:
        """Whether all packets of the session are kept."""
        return self._is_all and self._kept is not None

    def again(self, by_log_time: ByLogTime, seen: Seen | None) -> Iterator[PacketBatch]:
        """Yield the packets of the first seconds once more, as `merge` does."""
        return self._read(by_log_time, seen) if self._kept is None else iter(self._kept)

    def whole(
        self, by_log_time: ByLogTime = never, seen: Seen | None = None
    ) -> Generator[PacketBatch, None, None]:
        """Yield all packets of the session, as `merge` does; kept packets are not read again."""
        if self._is_all and self._kept is not None:
            yield from self._kept
            return
        yield from merge(self.recordings, by_log_time, seen)

    # -- coarse offsets -----------------------------------------------------------------------

    def ahead_ns(self, sensor: DetectedSensor) -> int | None:
        """Newest points of a sensor minus the receive times, with the offset of the rig."""
        found: int | None = None
        if self.sampler.has_receive_times(sensor):
            found = self.sampler.clock_offset_ns(sensor)
        elif self.clouds is not None:
            streams = [self.sampler.table.streams[number] for number in sensor.streams]
            names = [(stream.topic, self.clouds.frames.get(stream, "")) for stream in streams]
            all_ns = [self.clouds.ahead_ns.get(name) for name in names]
            found = max((ns for ns in all_ns if ns is not None), default=None)
        return None if found is None else found + sensor.offset_ns

    def clouds_apart(self, chosen: Sequence[DetectedSensor]) -> Iterator[Note]:
        """A warning where clouds of two sensors are late against log times by other times.

        Differences that a run refuses have an error of their own.
        """
        cloudy = [sensor for sensor in chosen if not self.sampler.has_receive_times(sensor)]
        ahead_ns = {sensor.name: self.ahead_ns(sensor) for sensor in cloudy}
        known = {name: ns for name, ns in ahead_ns.items() if ns is not None}
        if self.clouds is None or len(known) < 2:
            return
        first = min(known, key=lambda name: known[name])
        last = max(known, key=lambda name: known[name])
        apart_ns = known[last] - known[first]
        if _CLOUDS_APART_NS < apart_ns <= COMPARABLE_NS:
            yield Note(
                "cloud_time",
                "",
                f"by the log times of their messages the points of {last} are "
                f"{apart_ns / NS_PER_MS:.0f} ms later than those of {first}: their clocks, or the "
                "zeros of their times, may differ; check that both see walls at one place in "
                "motion, and give clock.offset_s or points: {from: ...} in the rig",
            )

    def rig_offsets(self, chosen: Sequence[DetectedSensor]) -> str:
        """Text for a rig with the offsets of clouds, by the log times of their messages; or ""."""
        if self.clouds is None:
            return ""
        ahead_ns = {sensor.name: self.ahead_ns(sensor) for sensor in chosen}
        known = {name: ns for name, ns in ahead_ns.items() if ns is not None}
        unknown = [name for name in ahead_ns if name not in known]
        if unknown:
            return f"; the log times of {', '.join(unknown)} do not show the offset"
        reference = min(known, key=lambda name: abs(known[name]))
        lines = []
        for sensor in chosen:
            offset_ns = sensor.offset_ns + known[reference] - known[sensor.name]
            if abs(known[reference] - known[sensor.name]) > COMPARABLE_NS:
                seconds = round(offset_ns / NS_PER_MS) / (NS_PER_S // NS_PER_MS)
                lines.append(f"{sensor.name} clock: {{offset_s: {seconds:.3f}}}")
        return (
            f": {', '.join(lines)} (by log times of messages: coarse, to some 0.01 s, as the "
            "delays of the drivers differ)"
            if lines
            else ""
        )


def _first_of_lidar(
    batch: PacketBatch, kind_filter: KindFilter, checked: Counter[PacketKind]
) -> int | None:
    """Row of the first packet that is described as a lidar's, whatever the batches; None: none.

    Several packets of a kind are checked: device packets may come first on the same topic. checked:
    how many so far.
    """
    rows = []
    for kind, index in kind_filter.followed(batch, split_by_kind(batch)):
        for row in index[: _CHECKED - checked[kind]].tolist():
            checked[kind] += 1
            begin = int(batch.start[row])
            text = sensors.describe(kind.size, batch.data[None, begin : begin + kind.size])
            if text is not None and "lidar" in text:
                rows.append(row)
                break
    return min(rows, default=None)


# -- decoded clouds --------------------------------------------------------------------------------


def with_clouds(
    recordings: Sequence[Recording], table: StreamTable, rig: Rig | None, ignore: Collection[str]
) -> tuple[list[Recording], CloudTopics | None]:
    """The recordings, with decoded clouds as packets; and these clouds.

    All clouds, if the session contains no raw packets: those of lidars that the rig lacks are then
    counted as unassigned. Else those on topics in the rig, since the others may be made from the
    packets. ignore: topics to leave out.
    """
    recorded = [topic for recording in recordings for topic in recording.topics]
    if not recorded:
        return list(recordings), None
    # Not loaded for captures.
    from mlbatch.readers.bag.cloud_topics import CloudTopics, cloud_topics
    from mlbatch.readers.bag.clouds import CloudRecording

    sensors = () if rig is None else rig.sensors
    topics = {one.stream.topic for one in sensors if one.stream is not None} - {""}
    clouds = {topic.name: topic for topic in cloud_topics(recorded)}
    # A capture has no topics, only packets.
    has_captures = any(not recording.topics for recording in recordings)
    is_raw = has_captures or any(map(has_packets, recorded))
    chosen = [cloud for name, cloud in clouds.items() if name in topics or not is_raw]
    _refuse_points_of_packets(sensors, clouds, sorted({topic.name for topic in recorded}))
    chosen = [topic for topic in chosen if topic.name not in ignore]
    if not chosen:
        return list(recordings), None
    found = CloudTopics(tuple(chosen), tuple(sensors))
    found.examine(recordings)
    if topics:
        found.leave_out_copies(topics)
    if not found.topics:
        return list(recordings), found
    return [CloudRecording(recording, table, found) for recording in recordings], found


def _refuse_points_of_packets(
    sensors: Sequence[RigSensor], clouds: Collection[str], recorded: Sequence[str]
) -> None:
    """Raise RigError for `points` of a sensor whose topic has no clouds."""
    lacking = {
        sensor.stream.topic: sensor.points.places
        for sensor in sensors
        if sensor.points is not None
        and sensor.stream is not None
        and sensor.stream.topic not in clouds
    }
    for topic, places in lacking.items():
        place = next(iter(places.values()), "points")
        near = difflib.get_close_matches(topic, list(clouds), n=1, cutoff=0.0)
        if near:
            remedy = f"the nearest topic of clouds is {near[0]}"
        else:
            topics = ", ".join(recorded[:_TOPICS]) + ", ..." * (len(recorded) > _TOPICS)
            remedy = f"this recording has {topics}; give one of this rig, or remove points"
        others = [name for name in clouds if name not in near]
        also = f", others are {', '.join(others)}" if others else ""
        raise RigError(
            f"{place}: expected decoded clouds on {', '.join(lacking)}, found none; {remedy}{also}"
        )


def is_without_packets(recording: Recording) -> bool:
    """True if a recording has no packet topics, only messages."""
    if not recording.topics or any(map(has_packets, recording.topics)):
        return False
    # Not loaded for captures.
    from mlbatch.readers.bag.clouds import CloudRecording

    clouds = recording.clouds.topics if isinstance(recording, CloudRecording) else ()
    return not {topic.name for topic in clouds} & {topic.name for topic in recording.topics}
