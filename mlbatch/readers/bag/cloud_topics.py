"""Clouds of a session by their first messages: which lidars share a topic, how times are read.

The first messages of every topic are read once before all others, since neither unit nor zero of
times follows from one message, nor whether several lidars send on the topic.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from mlbatch.errors import RigError
from mlbatch.readers.merge import merge
from mlbatch.rig.rig import RigSensor
from mlbatch.ros.encoding import ENCODINGS
from mlbatch.ros.point_packets import CloudError, Layout
from mlbatch.ros.point_times import (
    CONVENTION,
    CloudSample,
    PointRule,
    ahead_ns,
    checked_rule,
    origin_as_read,
)
from mlbatch.ros.pointcloud2 import CLOUD_TYPES, FieldError, read_cloud, sample_cloud
from mlbatch.types import Message, Recording, Stream, Topic
from mlbatch.units import NS_PER_S

# Messages of a topic that are examined, and for how long others are waited for.
_EXAMINED = 8
_EXAMINED_NS = 10 * NS_PER_S
# Words in the names of topics whose points were corrected for the motion of the vehicle:
# `points_undistorted` of GrandTour, `rectified/pointcloud` of Autoware.
_MOVED = re.compile(r"undist\w*|deskew\w*|rectified|motion_?comp\w*", re.IGNORECASE)
# A stream needs a word for an empty frame_id.
_NO_FRAME = "(empty)"


def cloud_topics(topics: Iterable[Topic]) -> tuple[Topic, ...]:
    """The topics of decoded clouds, in order."""
    return tuple(
        topic for topic in topics if topic.type in CLOUD_TYPES and topic.encoding in ENCODINGS
    )


@dataclass(slots=True)
class TopicLidars:
    """The lidars of a topic; frames, ids: seen in its first messages."""

    frames: set[str] = field(default_factory=set)
    ids: set[int] = field(default_factory=set)
    # True where the rig names one of several.
    by_frame: bool = False
    by_id: bool = False

    def stream(self, topic: str, frame: str, lidar_id: int | None) -> Stream:
        """The stream of points; a lidar that was not seen at first gets one of its own."""
        self.frames = self.frames or {frame}
        by_frame = self.by_frame or len(self.frames | {frame}) > 1
        ids = self.ids if lidar_id is None else self.ids | {lidar_id}
        by_id = lidar_id is not None and (self.by_id or len(ids) > 1)
        return Stream(
            topic=topic,
            frame_id=(frame or _NO_FRAME) if by_frame else "",
            lidar_id=lidar_id if by_id else None,
        )


@dataclass(slots=True)
class CloudTopics:
    """The clouds of a session, shared by its recordings, since a topic may be spread over several.

    rules: by topic and frame_id; lidars: by topic; layouts: of the packets of each stream; frames:
    frame_id of each stream; first_points_only: whether all but the first cloud of a stream may be
    cut after their first points; refused: why topics cannot be used; ahead_ns: by topic
    and frame_id, the last points minus the log times; origins: by topic and frame_id, as of
    `origin_as_read`; warnings: topic and text; stamps_ns: of the headers of the first messages, by
    topic.
    """

    topics: tuple[Topic, ...]
    rig: tuple[RigSensor, ...] = ()
    rules: dict[tuple[str, str], PointRule] = field(default_factory=dict)
    lidars: dict[str, TopicLidars] = field(default_factory=dict)
    layouts: dict[Stream, Layout] = field(default_factory=dict)
    frames: dict[Stream, str] = field(default_factory=dict)
    # Set for a pass that only looks for sensors.
    first_points_only: bool = False
    refused: dict[str, str] = field(default_factory=dict)
    ahead_ns: dict[tuple[str, str], int | None] = field(default_factory=dict)
    origins: dict[tuple[str, str], str] = field(default_factory=dict)
    warnings: list[tuple[str, str]] = field(default_factory=list)
    stamps_ns: dict[str, set[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.stamps_ns = {topic.name: set() for topic in self.topics}
        self.lidars = {topic.name: TopicLidars() for topic in self.topics}
        for sensor in self.rig:
            if sensor.stream is not None and sensor.stream.topic in self.lidars:
                lidars = self.lidars[sensor.stream.topic]
                lidars.by_frame |= bool(sensor.stream.frame_id)
                lidars.by_id |= sensor.stream.lidar_id is not None

    def rule(self, topic: str, frame: str) -> PointRule:
        """How the points of a frame are read."""
        known = self.rules.get((topic, frame))
        return self._given(topic, frame) if known is None else known

    def _given(self, topic: str, frame: str) -> PointRule:
        """How the rig says that the points of a frame are read."""
        sensor = self._sensor(topic, frame)
        return CONVENTION if sensor is None else sensor.points or CONVENTION

    def _sensor(self, topic: str, frame: str) -> RigSensor | None:
        """The sensor of the rig on a frame; RigError where the `points` of two differ."""
        found: RigSensor | None = None
        for sensor in self.rig:
            stream = sensor.stream
            if stream is None or stream.topic != topic or stream.frame_id not in ("", frame):
                continue
            if found is not None and found.points != sensor.points:
                raise RigError(
                    f"sensor {sensor.name}: expected the `points` of {found.name}, whose clouds "
                    f"come on {topic} as well, found others; give both the same"
                )
            found = sensor
        return found

    def _offset_ns(self, topic: str, frame: str) -> int | None:
        """Offset that the rig adds to the times of a lidar; None where it converts their epoch."""
        sensor = self._sensor(topic, frame)
        if sensor is None:
            return 0
        return sensor.offset_ns if sensor.epoch is None else None

    def _is_stated(self, topic: str) -> bool:
        """Return whether the rig says how the points of a topic are read."""
        sensors = (one for one in self.rig if one.stream is not None and one.stream.topic == topic)
        return any(sensor.points is not None for sensor in sensors)

    def examine(self, recordings: Sequence[Recording]) -> None:
        """Find lidars and rules by the first messages; topics that cannot be used are removed."""
        found = {topic.name: _Examined() for topic in self.topics}
        for recording in recordings:
            recording.keep = frozenset(found)
        end_ns: int | None = None
        with contextlib.closing(merge(recordings)) as batches:
            for batch in batches:
                for message in batch.messages:
                    end_ns = message.host_ns + _EXAMINED_NS if end_ns is None else end_ns
                    one = found[message.topic.name]
                    if one.messages < _EXAMINED:
                        self._examine(message, one)
                last_ns = max((m.host_ns for m in batch.messages), default=0)
                last_ns = max(last_ns, int(batch.host_ns[-1]) if len(batch) else 0)
                is_over = end_ns is not None and last_ns > end_ns
                if is_over or all(one.messages >= _EXAMINED for one in found.values()):
                    break
        for recording in recordings:
            recording.keep = frozenset()
        for name, one in found.items():
            self._decide(name, one)
        self.topics = tuple(topic for topic in self.topics if topic.name not in self.refused)

    def leave_out_copies(self, named: Collection[str]) -> None:
        """Leave out topics that the rig does not name and that are no lidar of their own.

        Those without a time for each point, as of depth cameras, and those made from the clouds of
        a topic in the rig: they have the stamps of its headers, in its frame or namespace.
        """
        for name in self.refused.keys() - named:
            del self.refused[name]
        known = [topic.name for topic in self.topics if topic.name in named]
        self.topics = tuple(
            topic
            for topic in self.topics
            if topic.name in named or not any(self._is_copy(topic.name, of) for of in known)
        )

    def _is_copy(self, name: str, of: str) -> bool:
        if not self.stamps_ns[name] & self.stamps_ns[of]:
            return False
        namespace = of.rpartition("/")[0]
        is_near = bool(namespace) and name.startswith(f"{namespace}/")
        return is_near or bool(self.lidars[name].frames & self.lidars[of].frames)

    def _examine(self, message: Message, examined: _Examined) -> None:
        name = message.topic.name
        examined.messages += 1
        try:
            head = sample_cloud(message, lambda frame: self._given(name, frame))
        except FieldError as err:
            raise RigError(str(err)) from err
        except CloudError as err:
            examined.fault = examined.fault or str(err)
            return
        self.stamps_ns[name].add(head.sample.stamp_ns)
        self.lidars[name].frames.add(head.frame)
        self.lidars[name].ids.update(head.lidar_ids)
        only_id = head.lidar_ids[0] if len(head.lidar_ids) == 1 else None
        examined.samples.setdefault((head.frame, only_id), []).append(head.sample)
        if head.sample.points:
            examined.clouds.setdefault(head.frame, message)

    def _decide(self, name: str, examined: _Examined) -> None:
        """Set the rules of a topic, or refuse it."""
        notes: dict[str, None] = {}
        moved = _MOVED.search(name)
        if moved is not None and not self._is_stated(name):
            self.refused[name] = (
                "expected points where they were measured, found a topic that by its name "
                f"({moved[0]}) has points moved to one time by the motion of the vehicle; choose "
                "the topic of the points as measured, or accept these with `points: {from: start}` "
                f"(or end) in the rig, or leave the topic out with --ignore {name}"
            )
            return
        if examined.fault and not examined.samples:
            self.refused[name] = examined.fault
            return
        try:
            for (frame, _), samples in examined.samples.items():
                offset_ns = self._offset_ns(name, frame)
                rule, texts = checked_rule(samples, self._given(name, frame), name, offset_ns)
                self.rules.setdefault((name, frame), rule)
                self.ahead_ns.setdefault((name, frame), ahead_ns(samples, rule))
                self.origins.setdefault((name, frame), origin_as_read(samples, rule))
                notes |= dict.fromkeys(texts)
            for message in examined.clouds.values():
                read_cloud(message, lambda frame: self.rule(name, frame))
        except CloudError as err:
            self.refused[name] = str(err)
            return
        self.warnings += [(name, text) for text in notes]


@dataclass(slots=True)
class _Examined:
    """First messages of a topic.

    samples: by frame_id and the only lidar_id of a message; clouds: one with points of each frame;
    fault: why the first one that could not be read could not.
    """

    messages: int = 0
    samples: dict[tuple[str, int | None], list[CloudSample]] = field(default_factory=dict)
    clouds: dict[str, Message] = field(default_factory=dict)
    fault: str = ""
