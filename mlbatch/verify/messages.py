"""Outputs of messages, whatever their container: which topics there are, and what is on them.

Source: facts/outputs.md section 4, CONTRACT.md section 3.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from mlbatch.types import F64Array
from mlbatch.verify.claims import Claims
from mlbatch.verify.clouds import held, read_cloud
from mlbatch.verify.document import Document
from mlbatch.verify.encoding import Cursor
from mlbatch.verify.examination import Examination
from mlbatch.verify.report import poses_of
from mlbatch.verify.verdict import DamageError, Judge

CLOUD, IMU, TRANSFORMS = "sensor_msgs/PointCloud2", "sensor_msgs/Imu", "tf2_msgs/TFMessage"
TF_STATIC = "/tf_static"
# Of the sensor's own stamps: outside, they are refused.
_STAMP_LIMIT_NS = 2**31 * 10**9
_LEAST_MESSAGE = 1e-6

LIMITS = {
    "columns": "first and last column of a scan, by scans.csv; messages have no column stamps",
    "order": "points step back by less than a column's duration; dense messages have no columns",
    "duplicates": "messages have no column stamps",
    "names": "one file",
}
# What a layout has no field for.
LAYOUT_LIMITS = {
    "times": ("minimal",),
    "order": ("minimal",),
    "geometry": ("standard", "velodyne", "hesai", "kiss-icp", "minimal"),
    "sensors": ("velodyne", "ouster", "hesai", "autoware", "kiss-icp", "minimal"),
    "rings": ("autoware", "kiss-icp", "minimal"),
    "returns": ("velodyne", "ouster", "hesai", "kiss-icp", "minimal"),
}


@dataclass(frozen=True, slots=True)
class Message:
    """A message and where it stands; type: package/Type; encoding: cdr or ros1."""

    where: str
    topic: str
    type: str
    encoding: str
    log_ns: int
    publish_ns: int
    data: memoryview


@dataclass(slots=True)
class Topics:
    """Takes the messages of an output one after the other."""

    judge: Judge
    claims: Claims
    examination: Examination
    report: Document | None
    layout: str = ""
    organized: bool = False
    counts: Counter[str] = field(default_factory=Counter)
    _split: bool | None = None
    _last_ns: dict[str, int] = field(default_factory=dict)
    _frames: set[str] = field(default_factory=set)

    @property
    def split(self) -> bool:
        """Whether every sensor has a topic of its own."""
        return bool(self._split)

    def take(self, message: Message) -> None:
        """One message, in the order of the file."""
        first = not self.counts
        self.counts[message.topic] += 1
        sensors = self.claims.sensors or ()
        owner = _owner(message.topic)
        try:
            if message.topic == TF_STATIC:
                self._transforms(message, first)
            elif message.topic == "/points":
                self._cloud(message, None)
            elif owner[1] == "points" and owner[0] in sensors:
                self._cloud(message, sensors.index(owner[0]))
            elif owner[1] == "imu" and owner[0] in sensors:
                self._imu(message, f"{owner[0]}_imu")
            elif message.type == IMU:
                self._imu(message, None)
        except DamageError as err:
            self.judge.blame("layout", message.where, err.wanted, err.got)

    def _cloud(self, message: Message, sensor: int | None) -> None:
        judge, where = self.judge, message.where
        if not judge.equal("layout", f"{where} type", CLOUD, message.type):
            return
        if self._split is None:
            self._split = sensor is not None
        judge.equal("layout", f"{where} topic with --split", self._split, sensor is not None)
        cloud = read_cloud(Cursor.of_message(message.data, message.encoding))
        if not self.layout:
            self.layout, self.organized = cloud.layout, not cloud.is_dense
        judge.equal("layout", f"{where} point layout", self.layout, cloud.layout)
        judge.equal("layout", f"{where} is_dense", not self.organized, cloud.is_dense)
        if cloud.is_dense:
            judge.equal("layout", f"{where} height", 1, len(cloud.records))
        judge.equal("stamps", f"{where} log time", cloud.stamp_ns, message.log_ns)
        judge.equal("stamps", f"{where} publish time", cloud.stamp_ns, message.publish_ns)
        if self.claims.frame_id is not None:
            judge.equal("metadata", f"{where} frame_id", self.claims.frame_id, cloud.frame_id)
        self.examination.scan(held(cloud, where, sensor))

    def _imu(self, message: Message, frame_id: str | None) -> None:
        judge, where = self.judge, message.where
        if not judge.equal("imu", f"{where} type", IMU, message.type):
            return
        cursor = Cursor.of_message(message.data, message.encoding)
        stamp_ns, frame = cursor.header()
        if not judge.equal("imu", f"{where} log time", stamp_ns, message.log_ns):
            return
        if frame_id is None:
            return  # A recorded message: its frame, values and order are its publisher's.
        judge.equal("imu", f"{where} frame_id", frame_id, frame)
        judge.equal("imu", f"{where} publish time", stamp_ns, message.publish_ns)
        values = cursor.reals(4 + 9 + 3 + 9 + 3 + 9)
        cursor.end("an Imu message")
        if not np.isfinite(values).all():
            judge.blame("imu", where, "numbers", values)
        if not 0 <= stamp_ns < _STAMP_LIMIT_NS:
            judge.blame("imu", where, f"a stamp in [0, {_STAMP_LIMIT_NS}) ns", stamp_ns)
        last_ns = self._last_ns.get(message.topic, 0)
        if stamp_ns < last_ns:
            judge.blame("imu", where, f"a stamp from {last_ns} on", stamp_ns)
        self._last_ns[message.topic] = max(stamp_ns, last_ns)

    def _transforms(self, message: Message, first: bool) -> None:
        judge, where = self.judge, message.where
        judge.equal("tf_static", f"{where} place", "before all others", _place(first))
        if not judge.equal("tf_static", f"{where} type", TRANSFORMS, message.type):
            return
        cursor = Cursor.of_message(message.data, message.encoding)
        names, poses = [], []
        for _ in range(cursor.whole("I")):
            stamp_ns, frame = cursor.header()
            judge.equal("tf_static", f"{where} stamp", message.log_ns, stamp_ns)
            self._frames.add(frame)
            names.append(cursor.text())
            poses.append((np.array(cursor.reals(3)), np.array(cursor.reals(4))))
        cursor.end("a TFMessage")
        if self.claims.frame_id is not None:
            judge.equal("tf_static", f"{where} frames", {self.claims.frame_id}, self._frames)
        if self.claims.sensors is not None:
            judge.equal("tf_static", f"{where} child frames", self.claims.sensors, tuple(names))
        for name, (_, turn) in zip(names, poses, strict=True):
            if not abs(float(turn @ turn) - 1) < _LEAST_MESSAGE:
                judge.blame("tf_static", f"{where} {name}", "a unit quaternion", turn)
        self._compare(where, names, poses)

    def _compare(
        self, where: str, names: list[str], poses: list[tuple[F64Array, F64Array]]
    ) -> None:
        """Poses against those of the report."""
        said = None if self.report is None else poses_of(self.report)
        if said is None or len(said) != len(poses):
            return
        for name, (place, turn), pose in zip(names, poses, said, strict=True):
            near = np.allclose(place, pose[:3, 3], rtol=0, atol=_LEAST_MESSAGE) and np.allclose(
                _rotation(turn), pose[:3, :3], rtol=0, atol=1e-3
            )
            self.judge.passed("tf_static")
            if not near:
                wanted = "the pose of the report"
                self.judge.blame("tf_static", f"{where} {name}", wanted, [*place, *turn])

    def finish(self, where: str) -> None:
        """Counts of messages; the sums of scans."""
        self.judge.equal("tf_static", f"{where} messages", 1, self.counts[TF_STATIC])
        self.examination.finish(split=self.split)
        if self.report is None:
            return
        report = self.report
        for i, name in enumerate(self.claims.sensors or ()):
            path = ("sensors", i, "imu_samples", "written")
            written = report.number(*path)
            self.judge.equal("imu", report.name(*path), self.counts[f"/{name}/imu"], written)
        own = {TF_STATIC, "/points"}
        own |= {f"/{s}/{end}" for s in self.claims.sensors or () for end in ("points", "imu")}
        said = {
            report.text("messages", i, "topic"): report.number("messages", i, "written")
            for i in range(report.length("messages"))
        }
        for topic in sorted({topic or "" for topic in said} | set(self.counts) - own):
            count = self.counts[topic]
            self.judge.equal("messages", f"{where} {topic}", said.get(topic, 0), count)


def _owner(topic: str) -> tuple[str, str]:
    """Sensor and last part of `/<sensor>/points` or `/<sensor>/imu`."""
    head, _, tail = topic.rpartition("/")
    return head.removeprefix("/"), tail


def _place(first: bool) -> str:
    return "before all others" if first else "after others"


def _rotation(quaternion: F64Array) -> F64Array:
    """Rotation (3, 3) of a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
