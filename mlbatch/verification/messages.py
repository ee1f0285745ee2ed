"""Outputs of messages in any container: topics, clouds, transforms and IMU samples.

Sources: docs/sources/outputs.md sections 2 to 4; sensor_msgs of ROS.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.motion.se3 import rotations_of
from mlbatch.outputs.cloud_messages import CLOUD, PRESETS, read_cloud, stored_scan
from mlbatch.outputs.containers import Message
from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.encoding import MessageCursor
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.verification.examination import Examination
from mlbatch.verification.report_checks import Document, poses_of

IMU = "sensor_msgs/Imu"
TRANSFORMS = "tf2_msgs/TFMessage"
TF_STATIC = "/tf_static"
# Types of recorded messages that begin with a header; others may contain one elsewhere.
WITH_HEADER = frozenset(
    (
        IMU,
        CLOUD,
        *(
            f"sensor_msgs/{name}"
            for name in (
                *("CameraInfo", "CompressedImage", "FluidPressure", "Illuminance", "Image"),
                *("JointState", "LaserScan", "MagneticField", "NavSatFix", "PointCloud", "Range"),
                *("RelativeHumidity", "Temperature", "TimeReference"),
            )
        ),
        *(
            f"geometry_msgs/{name}Stamped"
            for name in (
                *("Accel", "AccelWithCovariance", "Point", "Pose", "PoseWithCovariance"),
                *("Quaternion", "Transform", "Twist", "TwistWithCovariance", "Vector3", "Wrench"),
            )
        ),
        *("nav_msgs/Odometry", "nav_msgs/Path"),
    )
)
_MOST_FRAMES = 16
# Stamps outside are never written.
_STAMP_LIMIT_NS = 2**31 * 10**9
_LARGEST_ERROR = 1e-6
_NS = 10**9
# Orientation, angular velocity and linear acceleration, each with a covariance.
_IMU_FLOATS = 4 + 9 + 3 + 9 + 3 + 9

LIMITS = {
    "columns": "first and last column of a scan, by scans.csv; messages have no column stamps",
    "order": "points step back by less than a column's duration; dense messages have no columns",
    "duplicates": "messages have no column stamps",
    "names": "one file",
}
_TIMES = ("time", "t", "timestamp", "time_stamp")
# Fields of point layouts, one of which a check needs.
_NEEDED = {
    "times": _TIMES,
    "order": _TIMES,
    "geometry": ("range", "distance"),
    "sensors": ("lidar_id",),
    "rings": ("ring",),
    "returns": ("return_type",),
}


def layout_limits(layout: str) -> dict[str, str]:
    """Why checks are impossible on clouds of a point layout; "": there is no cloud."""
    names = set(PRESETS[layout].dtype.names or ()) if layout else set()
    return {
        check: f"the point layout {layout} has no field for it"
        for check, fields in _NEEDED.items()
        if layout and names.isdisjoint(fields)
    }


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """A transform of /tf_static; rotation: quaternion x, y, z, w."""

    parent: str
    child: str
    translation_m: F64Array
    rotation: F64Array


class MessageSource(Protocol):
    """A file of messages."""

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file."""
        ...


# -- topics ---------------------------------------------------------------------------------------


@dataclass(slots=True)
class TopicChecks:
    """Takes the messages of an output one after the other."""

    log: CheckLog
    examination: Examination
    report: Document | None
    # Of the first cloud.
    layout: str = ""
    organized: bool = False
    # Messages by topic, in all files; files that were begun.
    counts: Counter[str] = field(default_factory=Counter)
    files: int = 0
    _is_first: bool = True
    _split: bool | None = None
    _last_ns: dict[str, int] = field(default_factory=dict)
    # Frames in /tf_static.
    tree: set[str] = field(default_factory=set)
    # Frames in other messages, by topic: own ones, and recorded ones.
    _named: dict[str, set[str]] = field(default_factory=dict)
    _recorded: dict[str, set[str]] = field(default_factory=dict)

    @property
    def metadata(self) -> RunMetadata:
        """Metadata of the run."""
        return self.examination.metadata

    @property
    def split(self) -> bool:
        """Whether every sensor has its own topic."""
        return bool(self._split)

    def check_files(self, files: Iterable[MessageSource], where: str) -> list[int]:
        """Check all messages of the files of an output, then its sums; the number in each file.

        where: name of the output.
        """
        counts = []
        for file in files:
            before = self.counts.total()
            self.files += 1
            self._is_first = True
            for message in file.messages():
                self.check(message)
            counts.append(self.counts.total() - before)
        self.finish(where)
        return counts

    def check(self, message: Message) -> None:
        """Check one message, in the order of the files."""
        is_first = self._is_first
        self._is_first = False
        self.counts[message.topic] += 1
        sensors = self.metadata.sensors or ()
        # `/<sensor>/points` or `/<sensor>/imu`
        head, _, tail = message.topic.rpartition("/")
        owner = head.removeprefix("/")
        try:
            if message.topic == TF_STATIC:
                self._check_transforms(message, is_first)
            elif message.topic == "/points":
                self._check_cloud(message, None)
            elif tail == "points" and owner in sensors:
                self._check_cloud(message, sensors.index(owner))
            elif tail == "imu" and owner in sensors:
                self._check_imu(message, f"{owner}_imu")
            elif message.type == IMU:
                self._check_imu(message, None)
            elif message.type == TRANSFORMS:
                self._add_moving_frames(message)
            if message.type in WITH_HEADER and message.topic not in self._named:
                self._add_recorded_frame(message)
        except DamageError as err:
            self.log.fail("layout", message.where, err.expected, err.found)

    def _check_cloud(self, message: Message, sensor: int | None) -> None:
        log = self.log
        where = message.where
        if not log.equal("layout", f"{where} type", CLOUD, message.type):
            return
        if self._split is None:
            self._split = sensor is not None
        log.equal("layout", f"{where} topic with --split", self._split, sensor is not None)
        cloud = read_cloud(MessageCursor.of_message(message.data, message.encoding))
        if not self.layout:
            self.layout = cloud.layout
            self.organized = not cloud.is_dense
        log.equal("layout", f"{where} point layout", self.layout, cloud.layout)
        log.equal("layout", f"{where} is_dense", not self.organized, cloud.is_dense)
        if cloud.is_dense:
            log.equal("layout", f"{where} height", 1, len(cloud.records))
        log.equal("stamps", f"{where} log time", cloud.stamp_ns, message.log_ns)
        log.equal("stamps", f"{where} publish time", cloud.stamp_ns, message.publish_ns)
        if self.metadata.frame_id is not None:
            log.equal("metadata", f"{where} frame_id", self.metadata.frame_id, cloud.frame_id)
        self._named.setdefault(message.topic, set()).add(cloud.frame_id)
        number = self.counts[message.topic] - 1
        window = self.examination.window_of_message(cloud.stamp_ns, number, where)
        scan = stored_scan(replace(cloud, stamp_ns=window.start_ns), where, sensor)
        scan.end_ns = window.end_ns
        scan.checksum = zlib.crc32(message.data)
        if window.place is not None:
            scan.index = window.place
            scan.slice = 0
        self.examination.scan(scan)

    def _check_imu(self, message: Message, frame_id: str | None) -> None:
        """Check an IMU message; frame_id: None for a recorded one."""
        log = self.log
        where = message.where
        if not log.equal("imu", f"{where} type", IMU, message.type):
            return
        cursor = MessageCursor.of_message(message.data, message.encoding)
        stamp_ns, frame = cursor.header()
        if not log.equal("imu", f"{where} log time", stamp_ns, message.log_ns):
            return
        if frame_id is None:
            return  # Frame, values and order of a recorded message are those of its publisher.
        log.equal("imu", f"{where} frame_id", frame_id, frame)
        self._named.setdefault(message.topic, set()).add(frame)
        log.equal("imu", f"{where} publish time", stamp_ns, message.publish_ns)
        values = cursor.floats(_IMU_FLOATS)
        cursor.finish("an Imu message")
        if not np.isfinite(values).all():
            log.fail("imu", where, "finite numbers", values)
        if not 0 <= stamp_ns < _STAMP_LIMIT_NS:
            log.fail("imu", where, f"a stamp in [0, {_STAMP_LIMIT_NS}) ns", stamp_ns)
        last_ns = self._last_ns.get(message.topic, 0)
        if stamp_ns < last_ns:
            log.fail("imu", where, f"a stamp of {last_ns} or later", stamp_ns)
        self._last_ns[message.topic] = max(stamp_ns, last_ns)

    def _check_transforms(self, message: Message, is_first: bool) -> None:
        log = self.log
        where = message.where
        place = "before all others" if is_first else "after others"
        log.equal("tf_static", f"{where} place", "before all others", place)
        if not log.equal("tf_static", f"{where} type", TRANSFORMS, message.type):
            return
        cursor = MessageCursor.of_message(message.data, message.encoding)
        transforms = []
        for _ in range(cursor.number("I")):
            stamp_ns, parent = cursor.header()
            log.equal("tf_static", f"{where} stamp", message.log_ns, stamp_ns)
            child = cursor.text()
            translation_m: F64Array = np.array(cursor.floats(3))
            rotation: F64Array = np.array(cursor.floats(4))
            if not abs(float(rotation @ rotation) - 1) < _LARGEST_ERROR:
                log.fail("tf_static", f"{where} {child}", "a unit quaternion", rotation)
            transforms.append(Transform(parent, child, translation_m, rotation))
        cursor.finish("a TFMessage")
        roots = self._check_tree(where, transforms)
        self._check_sensors(where, transforms, roots)

    def _check_tree(self, where: str, transforms: Sequence[Transform]) -> set[str]:
        """Check that all frames have one parent, and one root above them; gives the roots."""
        log = self.log
        children = [one.child for one in transforms]
        log.equal("tf_static", f"{where} frames with one parent", len(set(children)), len(children))
        below: dict[str, list[str]] = {}
        for one in transforms:
            below.setdefault(one.parent, []).append(one.child)
        roots = set(below) - set(children)
        if transforms and self.metadata.frame_id is not None:
            log.equal("tf_static", f"{where} root", [self.metadata.frame_id], sorted(roots))
        elif transforms:
            log.equal("tf_static", f"{where} number of roots", 1, len(roots))
        self.tree |= {*children, *roots}
        reached: set[str] = set()
        waiting = list(roots)
        while waiting:
            frame = waiting.pop()
            if frame not in reached:
                reached.add(frame)
                waiting += below.get(frame, ())
        circle = sorted(set(children) - reached)
        log.equal("tf_static", f"{where} frames without a root", [], circle)
        return roots

    def _check_sensors(
        self, where: str, transforms: Sequence[Transform], roots: Collection[str]
    ) -> None:
        """Check the transforms of the sensors, which are the first."""
        log = self.log
        names = self.metadata.sensors or ()
        body = self.metadata.frame_id
        if body is None:
            # Bags for ROS 1 have no metadata.
            body = next(iter(roots), names[0] if len(names) == 1 else None)
        # A single sensor without extrinsics is the body.
        sensors = [name for name in names if name != body]
        found = transforms[: len(sensors)]
        log.equal("tf_static", f"{where} child frames", sensors, [one.child for one in found])
        if body is not None:
            parents = [one.parent for one in found]
            log.equal("tf_static", f"{where} frames", [body] * len(found), parents)
        poses = None if self.report is None else poses_of(self.report)
        if poses is None or len(poses) != len(found):
            return
        for one, pose in zip(found, poses, strict=True):
            self._check_pose(f"{where} {one.child}", one.translation_m, one.rotation, pose)

    def _add_moving_frames(self, message: Message) -> None:
        """Add the frames of a recorded /tf."""
        cursor = MessageCursor.of_message(message.data, message.encoding)
        for _ in range(cursor.number("I")):
            _, parent = cursor.header()
            self.tree |= {_clean(parent), _clean(cursor.text())}
            cursor.floats(7)

    def _add_recorded_frame(self, message: Message) -> None:
        """Note the frame of a recorded message."""
        _, frame = MessageCursor.of_message(message.data, message.encoding).header()
        frames = self._recorded.setdefault(message.topic, set())
        if len(frames) < _MOST_FRAMES:
            frames.add(_clean(frame))

    @property
    def strange_frames(self) -> str:
        """Frames that only recorded messages name and that are not in the tree, as text, or ""."""
        found = [
            f"{frame or 'no frame'} of {topic}"
            for topic, frames in sorted(self._recorded.items())
            for frame in sorted(frames - self.tree)
        ]
        return ", ".join(found)

    def _check_frames(self, where: str) -> None:
        """Check that the frames of own messages are in the tree."""
        # The body frame alone is a tree without transforms.
        body = self.metadata.frame_id
        tree = self.tree or {body or frame for frames in self._named.values() for frame in frames}
        for topic, frames in sorted(self._named.items()):
            for frame in sorted(frames):
                found = frame if frame in tree else "none"
                self.log.equal("frames", f"{where} {topic} frame in /tf_static", frame, found)
        for frames in self._recorded.values():
            self.log.ok("frames", len(frames & self.tree))

    def _check_pose(
        self, where: str, translation_m: F64Array, rotation: F64Array, pose: F64Array
    ) -> None:
        """Check a transform against a pose (4, 4) of the report."""
        is_near = np.allclose(translation_m, pose[:3, 3], rtol=0, atol=_LARGEST_ERROR)
        is_near &= np.allclose(rotations_of(rotation[None])[0], pose[:3, :3], rtol=0, atol=1e-3)
        self.log.ok("tf_static")
        if not is_near:
            found = [*translation_m.tolist(), *rotation.tolist()]
            self.log.fail("tf_static", where, "the pose of the report", found)

    def finish(self, where: str) -> None:
        """Check the counts of messages, and the sums of scans."""
        log = self.log
        log.equal("tf_static", f"{where} messages", self.files, self.counts[TF_STATIC])
        self._check_frames(where)
        self.examination.finish(split=self.split)
        report = self.report
        if report is None:
            return
        sensors = self.metadata.sensors or ()
        said = {
            report.text("messages", i, "topic") or "": report.number("messages", i, "written")
            for i in range(report.length("messages"))
        }
        for i, name in enumerate(sensors):
            path = ("sensors", i, "imu_samples", "written")
            # Of an output that was converted again, they are forwarded messages.
            topic = f"/{name}/imu"
            count = 0 if topic in said else self.counts[topic]
            log.equal("imu", report.name(*path), count, report.number(*path))
        own = {TF_STATIC, "/points"}
        for name in sensors:
            own |= {f"/{name}/points", f"/{name}/imu"}
        for topic in sorted(set(said) | set(self.counts) - own):
            count = self.counts[topic]
            log.equal("messages", f"{where} {topic}", said.get(topic, 0), count)


def _clean(frame: str) -> str:
    """A frame without the leading slash that ROS 1 allowed."""
    return frame.lstrip("/")
