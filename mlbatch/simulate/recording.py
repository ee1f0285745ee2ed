"""Writes a simulated recording: packets of all lidars in the order of arrival, and ground truth.

Time advances in steps; a step writes what is received before every later packet, so that memory
does not depend on the duration.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import UsageError
from mlbatch.frames.transforms import quaternion, rpy_deg
from mlbatch.ros.encoding import Wire
from mlbatch.ros.packet_writing import PacketMessages, Stamped
from mlbatch.simulate.lidar_stream import LidarStream, Received, SensorClock, with_errors
from mlbatch.simulate.scenario import Scenario
from mlbatch.simulate.trajectory import Poses
from mlbatch.types import Message, Topic
from mlbatch.units import NS_PER_S
from mlbatch.writers.atomic import Output, discard, export_errors, prepare
from mlbatch.writers.recordings import MCAP, PCAP, SQLITE, Bag, PcapFile, new_bag

SUFFIXES = (PCAP, MCAP, SQLITE)
_STEP_S = 0.1
_KEPT_BYTES = 24 << 20
# From an IMU sample to its message.
_IMU_LATENCY_NS = 500_000
# The streams of random numbers of lidars are numbered from 1.
_RANDOM_OF_IMU = 1_000_000
_RANK_OF_TRUTH = -2
_RANK_OF_IMU = -1
TF = "/tf"
TF_STATIC = "/tf_static"
_UNKNOWN = (-1.0, *(0.0,) * 8)


@dataclass(frozen=True, slots=True)
class LidarFigures:
    """Counts of a lidar in the recording; packets: including lost ones."""

    name: str
    shots: int
    returns: int
    packets: int
    lost: int


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of a recording; files: all that were written, the recording first."""

    lidars: tuple[LidarFigures, ...]
    imu_samples: int
    poses: int
    files: tuple[Path, ...]


def write_recording(scenario: Scenario, target: Path, *, overwrite: bool = False) -> Figures:
    """Write the recording and its files; nothing has its final name before all are complete."""
    if target.suffix not in SUFFIXES:
        raise UsageError(
            f"-o: expected a name that ends with {', '.join(SUFFIXES)}, found {target.name}; "
            "choose one of these"
        )
    _keep_freed_memory()
    streams = [LidarStream(scenario, index) for index in range(len(scenario.lidars))]
    texts = _side_files(scenario, streams, target)
    truth = _with_suffix(target, "truth.tum")
    samples = _with_suffix(target, "imu.csv")
    paths = [target, truth, *texts, *([samples] if scenario.imu else [])]
    outputs: list[Output] = []
    try:
        outputs.extend(prepare(path, overwrite, folder=False) for path in paths)
        places = {one.target: one.partial for one in outputs}
        with contextlib.ExitStack() as files, export_errors(target):
            for path, content in texts.items():
                places[path].write_bytes(content)
            lines = files.enter_context(_text_file(places[truth]))
            rows = files.enter_context(_text_file(places[samples])) if scenario.imu else None
            run = _Run(scenario, streams, places[target], lines, rows, target.suffix)
            run.write()
        # The recording last: with it the others are complete.
        for output in (*outputs[1:], outputs[0]):
            output.publish()
    except BaseException:
        for output in outputs:
            discard(output.target)
        raise
    return Figures(
        tuple(
            LidarFigures(one.plan.name, one.shots, one.returns, one.packets, one.lost)
            for one in streams
        ),
        run.imu_samples,
        run.poses,
        tuple(paths),
    )


def _keep_freed_memory() -> None:
    """Let glibc keep freed arrays, instead of returning and requesting their pages for each.

    Its threshold grows to the size of the largest array that was freed; a sixth of the CPU.
    """
    np.empty(_KEPT_BYTES, np.uint8)


def _text_file(path: Path) -> IO[str]:
    return path.open("w", encoding="utf-8", newline="\n")


def _with_suffix(target: Path, suffix: str) -> Path:
    return target.with_name(f"{target.stem}.{suffix}")


@dataclass(frozen=True, slots=True)
class _Event:
    """Something that is written when the host receives it; rank: order of equal times."""

    host_ns: int
    rank: int
    write: Callable[[], None]


class _Run:
    """Simulates and writes in the order of arrival."""

    def __init__(
        self,
        scenario: Scenario,
        streams: list[LidarStream],
        path: Path,
        truth: IO[str],
        samples: IO[str] | None,
        suffix: str,
    ) -> None:
        self._scenario = scenario
        self._streams = streams
        self._truth = truth
        self._samples = samples
        self._pcap = PcapFile(path) if suffix == PCAP else None
        self._bag: Bag | None = None if suffix == PCAP else new_bag(path, suffix)
        self._messages: dict[tuple[int, int], PacketMessages] = {}
        for index, stream in enumerate(streams):
            for port, topic in stream.lidar.topics.items():
                name = f"/{stream.plan.name}/{topic.name}"
                self._messages[index, port] = PacketMessages(
                    Topic(name, topic.message, "cdr"),
                    stream.plan.name,
                    of_device=topic.of_device,
                )
        self._last_ns = scenario.start_ns
        self.imu_samples = 0
        self.poses = 0

    def write(self) -> None:
        """Write the whole recording."""
        self._write_metadata()
        if self._samples is not None:
            self._samples.write("stamp_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n")
        waiting: list[_Event] = []
        duration_s = self._scenario.duration_s
        steps = max(1, math.ceil(round(duration_s / _STEP_S, 6)))
        for step in range(steps):
            is_last = step + 1 == steps
            end_s = duration_s if is_last else (step + 1) * _STEP_S
            for index, stream in enumerate(self._streams):
                while stream.next_s < end_s:
                    waiting += self._packets(index, stream)
            waiting += self._inertial(end_s)
            waiting += self._poses(end_s)
            waiting.sort(key=lambda one: (one.host_ns, one.rank))
            # Later steps receive nothing before their begin.
            end_ns = self._scenario.start_ns + math.floor(end_s * NS_PER_S)
            ready = sum(is_last or one.host_ns < end_ns for one in waiting)
            for event in waiting[:ready]:
                event.write()
                self._last_ns = event.host_ns
            del waiting[:ready]
        self._close()

    def _packets(self, index: int, stream: LidarStream) -> list[_Event]:
        """Return the packets of the next chunk of a lidar."""
        return [
            _Event(one.host_ns, index, partial(self._write_packet, index, one))
            for one in stream.receive()
        ]

    def _write_packet(self, index: int, one: Received) -> None:
        if self._pcap is not None:
            address = self._streams[index].plan.address
            self._pcap.packet(one.host_ns, address, one.port, one.payload)
        messages = self._messages.get((index, one.port))
        if self._bag is not None and messages is not None:
            for message in messages.add(Stamped(one.host_ns, one.payload)):
                self._bag.forward(message)

    def _send(
        self, topic: str, kind: str, host_ns: int, data: bytes, *, latched: bool = False
    ) -> None:
        """Write a message of type `kind`, package/Type, if the recording is a bag."""
        if self._bag is not None:
            self._bag.forward(Message(Topic(topic, kind, "cdr", latched=latched), host_ns, data))

    def _inertial(self, end_s: float) -> list[_Event]:
        """Return the samples of the body's IMU up to a time."""
        plan = self._scenario.imu
        if plan is None:
            return []
        until = math.ceil(round(end_s * plan.rate_hz, 6))
        number = np.arange(self.imu_samples, until)
        if not len(number):
            return []
        random = np.random.default_rng((self._scenario.seed, _RANDOM_OF_IMU, int(number[0])))
        self.imu_samples = until
        true_s = number / plan.rate_hz
        force, rate = self._scenario.trajectory.inertial(true_s, plan.body_from_imu)
        force, rate = with_errors(force, rate, plan.errors, random)
        stamps = SensorClock(self._scenario.start_ns, plan.clock).sensor_ns(true_s).tolist()
        host = self._scenario.start_ns + np.rint(true_s * NS_PER_S).astype(np.int64)
        return [
            _Event(
                int(host[row]) + _IMU_LATENCY_NS,
                _RANK_OF_IMU,
                partial(
                    self._write_sample,
                    int(host[row]) + _IMU_LATENCY_NS,
                    stamp,
                    force[row].tolist(),
                    rate[row].tolist(),
                ),
            )
            for row, stamp in enumerate(stamps)
        ]

    def _write_sample(
        self, host_ns: int, stamp_ns: int, force: list[float], rate: list[float]
    ) -> None:
        plan = self._scenario.imu
        if plan is None or self._samples is None:
            return
        values = ",".join(f"{value:.9g}" for value in (*rate, *force))
        self._samples.write(f"{stamp_ns},{values}\n")
        if self._bag is not None:
            data = imu_message(stamp_ns, plan.name, force, rate)
            self._send(plan.topic, "sensor_msgs/Imu", host_ns, data)

    def _poses(self, end_s: float) -> list[_Event]:
        """Return the poses of the ground truth up to a time; the last step includes its end."""
        plan = self._scenario.truth
        is_last = end_s >= self._scenario.duration_s
        until = (
            math.floor(round(end_s * plan.rate_hz, 6)) + 1
            if is_last
            else math.ceil(round(end_s * plan.rate_hz, 6))
        )
        number = np.arange(self.poses, until)
        if not len(number):
            return []
        self.poses = until
        true_s = number / plan.rate_hz
        poses = self._scenario.trajectory.poses(true_s)
        host = self._scenario.start_ns + np.rint(true_s * NS_PER_S).astype(np.int64)
        return [
            _Event(at, _RANK_OF_TRUTH, partial(self._write_pose, at, poses, row))
            for row, at in enumerate(host.tolist())
        ]

    def _write_pose(self, host_ns: int, poses: Poses, row: int) -> None:
        values = (*poses.position_m[row].tolist(), *quaternion(poses.rotation[row]))
        text = " ".join(f"{value:.9f}" for value in values)
        second, rest_ns = divmod(host_ns, NS_PER_S)
        self._truth.write(f"{second}.{rest_ns:09d} {text}\n")
        if self._bag is None:
            return
        plan = self._scenario.truth
        names = plan.frame, self._scenario.body_frame
        if plan.topic == TF:
            kind = "tf2_msgs/TFMessage"
            data = transform_message(host_ns, *names, poses.position_m[row], poses.rotation[row])
        else:
            kind = "nav_msgs/Odometry"
            data = odometry_message(host_ns, *names, poses, row)
        self._send(plan.topic, kind, host_ns, data)

    def _write_metadata(self) -> None:
        """Write the latched messages with the calibrations, and the place of the body's IMU."""
        if self._bag is None:
            return
        imu = self._scenario.imu
        start_ns = self._scenario.start_ns
        if imu is not None:
            body = self._scenario.body_frame
            pose = imu.body_from_imu
            data = transform_message(start_ns, body, imu.name, pose[:3, 3], pose[:3, :3])
            self._send(TF_STATIC, "tf2_msgs/TFMessage", start_ns, data, latched=True)
        for stream in self._streams:
            files = stream.lidar.files
            if files.topic:
                topic = f"/{stream.plan.name}/{files.topic}"
                data = text_message(files.content.decode())
                self._send(topic, "std_msgs/String", start_ns, data, latched=True)

    def _close(self) -> None:
        """Write the packets that wait for others, complete the file."""
        if self._pcap is not None:
            self._pcap.close()
        if self._bag is not None:
            for messages in self._messages.values():
                for message in messages.rest(self._last_ns):
                    self._bag.forward(message)
            self._bag.close()


def _side_files(scenario: Scenario, streams: list[LidarStream], target: Path) -> dict[Path, bytes]:
    """Return the rig file and the calibrations of the lidars."""
    found = {}
    sensors = []
    for plan, stream in zip(scenario.lidars, streams, strict=True):
        files = stream.lidar.files
        port = min(stream.lidar.topics)
        where = f"{{source_ip: {plan.address}, port: {port}}}"
        if target.suffix != PCAP:
            where = f"{{topic: /{plan.name}/{stream.lidar.topics[port].name}}}"
        lines = [f"  - name: {plan.name}", f"    stream: {where}"]
        if stream.lidar.rig_model:
            lines.append(f"    model: {stream.lidar.rig_model}")
        if files.name:
            path = _with_suffix(target, f"{plan.name}.{files.name}")
            found[path] = files.content
            lines.append(f"    metadata: {path.name}")
        translation = ", ".join(f"{value:.9g}" for value in plan.body_from_sensor[:3, 3])
        # Angles of 1e-16 degrees come from the matrix.
        angles = (round(value, 9) + 0.0 for value in rpy_deg(plan.body_from_sensor))
        rotation = ", ".join(f"{value:.9g}" for value in angles)
        lines.append(
            f"    extrinsics: {{translation_m: [{translation}], rotation_rpy_deg: [{rotation}]}}"
        )
        sensors += lines
    head = [
        f"# Rig of the simulated recording {target.name}.",
        f"body_frame: {scenario.body_frame}",
    ]
    text = "\n".join([*head, "sensors:", *sensors]) + "\n"
    return {_with_suffix(target, "rig.yaml"): text.encode(), **found}


# -- ROS 2 messages (CDR); types: docs/sources/messages.md, section 1 ------------------------------


def text_message(text: str) -> bytes:
    """Return a std_msgs/String."""
    message = Wire()
    message.text(text)
    return bytes(message.data)


def imu_message(stamp_ns: int, frame: str, force: Sequence[float], rate: Sequence[float]) -> bytes:
    """Return a sensor_msgs/Imu: m/s2 and rad/s, frame of the IMU, without orientation."""
    message = Wire()
    message.header(stamp_ns, frame)
    message.put("d", 0.0, 0.0, 0.0, 1.0, *_UNKNOWN)
    message.put("d", *rate, *(0.0,) * 9)
    message.put("d", *force, *(0.0,) * 9)
    return bytes(message.data)


def transform_message(
    stamp_ns: int, parent: str, child: str, place_m: F64Array, rotation: F64Array
) -> bytes:
    """Return a tf2_msgs/TFMessage of a pose: (3,) and (3, 3)."""
    message = Wire()
    message.put("I", 1)
    message.header(stamp_ns, parent)
    message.text(child)
    message.put("d", *place_m.tolist())
    message.put("d", *quaternion(rotation))
    return bytes(message.data)


def odometry_message(stamp_ns: int, parent: str, child: str, poses: Poses, row: int) -> bytes:
    """Return a nav_msgs/Odometry of the pose of the body; twist in the frame of the body."""
    message = Wire()
    message.header(stamp_ns, parent)
    message.text(child)
    message.put("d", *poses.position_m[row].tolist())
    message.put("d", *quaternion(poses.rotation[row]), *(0.0,) * 36)
    message.put("d", *(poses.rotation[row].T @ poses.velocity[row]).tolist())
    message.put("d", *poses.angular_velocity[row].tolist(), *(0.0,) * 36)
    return bytes(message.data)
