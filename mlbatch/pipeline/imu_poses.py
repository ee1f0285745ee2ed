"""Poses that points are moved by: those of a file, or integrated from the samples of an IMU."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.clocks.timescale import format_difference
from mlbatch.errors import ClockError, RigError
from mlbatch.lidar.limits import FAR_POSE_M
from mlbatch.motion.gravity import STANDSTILL_NS
from mlbatch.motion.imu import Integrator
from mlbatch.motion.track import PoseLine, PoseTrack
from mlbatch.pipeline.passthrough import IMU_TYPE, NEAR_NS
from mlbatch.pipeline.sensor import Sensor
from mlbatch.types import ImuSamples, Message, Topic
from mlbatch.units import NS_PER_MS, NS_PER_S

IMU = "imu"
# Poses kept before the newest window; sets of sweeps begin less than this before it.
_KEPT_NS = 5 * NS_PER_S


class PoseSource:
    """Poses, all known from the start; name: for the report; line: the poses so far."""

    gyro_bias: tuple[float, ...] = ()

    def __init__(self, name: str, track: PoseTrack) -> None:
        self.name = name
        self.line = PoseLine(track)

    @property
    def ended(self) -> str:
        """Why no poses will be added, if they should; else an empty text."""
        return ""

    @property
    def integrated_s(self) -> float:
        """How long velocities were integrated, s."""
        return 0.0

    @property
    def is_complete(self) -> bool:
        """Whether no poses will be added."""
        return True

    def add(self, imu: Iterable[ImuSamples], messages: Iterable[Message]) -> None:
        """Add what a batch of the recording contains."""

    def advance(self, oldest_ns: int) -> None:
        """Compute poses from all that was added; those before a time are not needed."""


class ImuStreams:
    """Samples of the IMUs of a recording, by the number of their lidar or the name of their topic.

    Stamps of lidars are in the common clock, those of messages as their headers have them.
    """

    def __init__(self, sensors: Sequence[Sensor]) -> None:
        self._sensors = sensors
        self.waiting: dict[int | str, list[_Samples]] = {}
        self.frame_of: dict[str, str] = {}
        self.topics: dict[str, Topic] = {}

    def add(self, imu: Iterable[ImuSamples], messages: Iterable[Message]) -> None:
        """Keep the samples of a batch."""
        for samples in imu:
            stamp_ns = samples.stamp_ns + self._sensors[samples.sensor].clock.imu_offset_ns
            near = np.zeros(len(stamp_ns), np.int64)
            one = (stamp_ns, samples.acceleration, samples.angular_velocity, near)
            self._keep(samples.sensor, one)
        for message in messages:
            if message.topic.type == IMU_TYPE:
                found = _sample_of(message)
                if found is not None:
                    frame, sample = found
                    self.frame_of.setdefault(message.topic.name, frame)
                    self.topics.setdefault(message.topic.name, message.topic)
                    self._keep(message.topic.name, sample)

    def _keep(self, key: int | str, samples: _Samples) -> None:
        if len(samples[0]):
            self.waiting.setdefault(key, []).append(samples)

    def rates(self) -> Iterator[tuple[int | str, I64Array, F64Array]]:
        """Increasing stamps (n,) of each IMU and its angular velocity (n, 3), its frame, rad/s."""
        # Lidars before topics.
        for key in sorted(self.waiting, key=lambda key: (isinstance(key, str), str(key))):
            parts = self.waiting[key]
            stamp_ns, _, rate, _ = (np.concatenate(part) for part in zip(*parts, strict=True))
            stamp_ns, first = np.unique(stamp_ns, return_index=True)
            yield key, stamp_ns, rate[first]


class ImuPoses(PoseSource):
    """Poses integrated from the first IMU of a lidar, else from the first Imu topic."""

    def __init__(
        self,
        sensors: Sequence[Sensor],
        frames: dict[str, F64Array],
        offset_ns: Callable[[Topic], int | None],
    ) -> None:
        """frames: (4, 4) body_from_frame, m, by name, for recorded topics.

        offset_ns: once there are columns, scan clock minus receive time, by which messages of a
        topic are forwarded or dropped; None: all are dropped.
        """
        super().__init__(IMU, _NO_POSES)
        self._sensors = sensors
        self._frames = frames
        self._streams = ImuStreams(sensors)
        self._topic_offset_ns = offset_ns
        self._chosen: int | str | None = None
        self._integrator: Integrator | None = None
        self._newest_ns: int | None = None
        self._first_ns: int | None = None

    @property
    def integrated_s(self) -> float:
        """From the end of the standstill to the last sample."""
        if self._first_ns is None or self._newest_ns is None:
            return 0.0
        return max(0.0, (self._newest_ns - self._first_ns - STANDSTILL_NS) / NS_PER_S)

    @property
    def is_complete(self) -> bool:
        """After a gap of the IMU."""
        return self._integrator is not None and self._integrator.is_lost

    @property
    def ended(self) -> str:
        """The gap."""
        if self._integrator is None or not self._integrator.is_lost:
            return ""
        return f"none after a gap of its samples of {self._integrator.gap_ns / NS_PER_MS:.0f} ms"

    def add(self, imu: Iterable[ImuSamples], messages: Iterable[Message]) -> None:
        """Keep the samples of a batch."""
        self._streams.add(imu, messages)
        if self._chosen is not None:
            self._drop_others(self._chosen)

    def _drop_others(self, key: int | str) -> None:
        self._streams.waiting = {key: self._streams.waiting.get(key, [])}

    def advance(self, oldest_ns: int) -> None:
        """Integrate the samples that wait."""
        if self._chosen is None and not self._choose():
            return
        parts = self._streams.waiting.pop(self._chosen, []) if self._chosen is not None else []
        if not parts or self._integrator is None:
            return
        stamp_ns, force, rate, ahead_ns = (
            np.concatenate(part) for part in zip(*parts, strict=True)
        )
        if isinstance(self._chosen, str):
            near = self._near(self._streams.topics[self._chosen], ahead_ns)
            stamp_ns, force, rate = stamp_ns[near], force[near], rate[near]
            if not len(stamp_ns):
                return
        # Repeated samples, and samples received after later ones, add nothing.
        newest = np.maximum.accumulate(stamp_ns)
        before = np.concatenate([[self._newest_ns or -1], newest[:-1]])
        fresh = stamp_ns > before
        if not fresh.any():
            return
        self._newest_ns = int(newest[-1])
        self._first_ns = int(stamp_ns[0]) if self._first_ns is None else self._first_ns
        track = self._integrator.push(stamp_ns[fresh], force[fresh], rate[fresh])
        self.gyro_bias = self._integrator.gyro_bias
        if len(track.stamp_ns):
            self.line.extend(track, oldest_ns - _KEPT_NS)

    def _near(self, topic: Topic, ahead_ns: I64Array) -> BoolArray:
        """Which samples (n,) are on the clock of the scans; ClockError if the first is not.

        ahead_ns: their time minus that of their message. The others are not forwarded, either.
        """
        offset_ns = self._topic_offset_ns(topic)
        remedy = "set IMU and lidars to one time source, or give a trajectory (--deskew FILE.tum)"
        if offset_ns is None:
            raise ClockError(
                f"--deskew imu: {topic.name}: expected scans on the clock of its header, found "
                f"scans on no epoch clock (UTC, TAI); {remedy}"
            )
        near: BoolArray = np.abs(ahead_ns - offset_ns) <= NEAR_NS
        if self._newest_ns is None and not near[0]:
            raise ClockError(
                f"--deskew imu: {topic.name}: expected the clock of its header and that of the "
                "scans within 1 s of each other, found the scans "
                f"{format_difference(offset_ns - int(ahead_ns[0]))} from it; {remedy}"
            )
        return near

    def _choose(self) -> bool:
        """Choose the IMU; False while there are no samples."""
        numbers = sorted(key for key in self._streams.waiting if isinstance(key, int))
        topics = sorted(key for key in self._streams.waiting if isinstance(key, str))
        for number in numbers:
            sensor = self._sensors[number]
            sensor_from_imu = sensor.lidar.sensor_from_imu()
            if sensor_from_imu is not None:
                pose = sensor.body_from_sensor @ sensor_from_imu
                return self._use(number, pose, f"the IMU of {sensor.name}")
        for topic in topics:
            frame = self._streams.frame_of[topic].lstrip("/")
            if frame not in self._frames:
                raise RigError(
                    f"--deskew imu: {topic}: expected a static transform to the frame {frame!r}, "
                    "found none; record /tf_static, or give a trajectory (FILE.tum)"
                )
            return self._use(topic, self._frames[frame], f"the IMU {topic}")
        return False

    def _use(self, key: int | str, body_from_imu: F64Array, name: str) -> bool:
        away_m = float(np.linalg.norm(body_from_imu[:3, 3]))
        if not away_m <= FAR_POSE_M:
            raise RigError(
                f"--deskew imu: {name}: expected it within {FAR_POSE_M:g} m of the body origin, "
                f"found {away_m:g} m; give its static transform in metres, or a trajectory "
                "(FILE.tum)"
            )
        self._chosen = key
        self._drop_others(key)
        self.name = name
        self._integrator = Integrator(body_from_imu, name)
        return True


# Stamps (n,), specific force (n, 3) in m/s2, angular velocity (n, 3) in rad/s, stamps minus times
# of messages (n,).
_Samples = tuple[I64Array, F64Array, F64Array, I64Array]
_NO_POSES = PoseTrack(np.zeros(0, np.int64), np.zeros((0, 3, 3)), np.zeros((0, 3)))


def _sample_of(message: Message) -> tuple[str, _Samples] | None:
    """Frame and sample of a sensor_msgs/Imu; None for a damaged one."""
    from mlbatch.outputs.damage import DamageError
    from mlbatch.outputs.encoding import MessageCursor

    try:
        cursor = MessageCursor.of_message(message.data, message.topic.encoding)
        stamp_ns, frame = cursor.header()
        values = np.array(cursor.floats(37))
    except DamageError:
        return None
    # Orientation and its covariance, angular velocity and its, acceleration and its.
    rate, force = values[13:16], values[25:28]
    if not np.isfinite(values[13:28]).all() or stamp_ns <= 0:
        return None
    ahead_ns = np.array([stamp_ns - message.host_ns])
    return frame, (np.array([stamp_ns]), force[None], rate[None], ahead_ns)
