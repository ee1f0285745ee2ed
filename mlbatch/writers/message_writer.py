"""What all outputs of messages share: topics, times, and the order in which messages begin.

facts/outputs.md section 4, CONTRACT.md section 3. A `Sink` is the container they go to.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np

from mlbatch.errors import ExportError, UsageError
from mlbatch.types import IMU, F64Array, ImuSamples, Message, RunInfo, Scan, Summary
from mlbatch.workers import Steps
from mlbatch.writers._ros2_types import FIELD_CODES
from mlbatch.writers._wire import Wire
from mlbatch.writers.atomic import SCANS_CSV, Output, export_errors, side_path, write_text
from mlbatch.writers.base import Safe, WriterOptions
from mlbatch.writers.mcap_container import Chunk
from mlbatch.writers.output_file import taken
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS, Layout, Points, points_of

NewWire = Callable[[], Wire]

# sensor_msgs/Imu: -1 says that there is no orientation; all 0 says that a covariance is unknown.
_NO_ORIENTATION = (0.0, 0.0, 0.0, 1.0, -1.0, *[0.0] * 8)
_UNKNOWN_COVARIANCE = (0.0,) * 9


class CloudMessage:
    """Assembles sensor_msgs/PointCloud2 in one buffer that is used for every scan."""

    def __init__(self, layout: Layout, frame_id: str, wire: NewWire) -> None:
        self._wire = wire
        self._layout = layout
        self._frame_id = frame_id
        self._dtype = layout.dtype
        self._buffer = np.empty(0, dtype=np.uint8)

    def assemble(self, points: Points, stamp_ns: int, dense: bool) -> memoryview:
        """The message; it is valid until the next call."""
        head = self._head(points.time_ns.shape, stamp_ns)
        start, size = len(head), points.time_ns.size * self._layout.step
        total = start + size + 1
        self._fit(total)
        self._buffer[:start] = np.frombuffer(head, dtype=np.uint8)
        records = self._buffer[start : start + size].view(self._dtype)
        self._layout.pack(points, records.reshape(points.time_ns.shape))
        self._buffer[start + size] = dense
        return self._buffer[:total].data

    def blank(self, shape: tuple[int, ...], stamp_ns: int) -> memoryview:
        """A message as long as that of a cloud of this shape; it is valid until the next call."""
        total = len(self._head(shape, stamp_ns)) + math.prod(shape) * self._layout.step + 1
        self._fit(total)
        return self._buffer[:total].data

    def _fit(self, total: int) -> None:
        if len(self._buffer) < total:
            # Zeros: bytes between fields are never written.
            self._buffer = np.zeros(total * 5 // 4, dtype=np.uint8)

    def _head(self, shape: tuple[int, ...], stamp_ns: int) -> bytearray:
        """All that precedes the points; `shape`: (width,) or (height, width)."""
        step = self._layout.step
        height, width = shape if len(shape) == 2 else (1, shape[0])
        message = self._wire()
        message.header(stamp_ns, self._frame_id)
        message.put("I", height, width, len(self._layout.fields))
        for field in self._layout.fields:
            message.text(field.name)
            message.put("I", field.offset)
            message.put("B", FIELD_CODES[field.dtype])
            message.put("I", 1)
        message.put("B", 0)
        message.put("I", step, step * width, step * width * height)
        return message.data


def imu_message(samples: ImuSamples, which: int, frame_id: str, wire: NewWire) -> bytes:
    """sensor_msgs/Imu of one of the samples."""
    message = wire()
    message.header(int(samples.stamp_ns[which]), frame_id)
    message.put("d", *_NO_ORIENTATION)
    message.put("d", *samples.angular_velocity[which].tolist(), *_UNKNOWN_COVARIANCE)
    message.put("d", *samples.acceleration[which].tolist(), *_UNKNOWN_COVARIANCE)
    return bytes(message.data)


def static_transforms(info: RunInfo, stamp_ns: int, wire: NewWire) -> bytes:
    """tf2_msgs/TFMessage with the pose of every sensor in the body frame."""
    message = wire()
    message.put("I", len(info.sensors))
    for sensor in info.sensors:
        pose = sensor.body_from_sensor
        message.header(stamp_ns, info.frame_id)
        message.text(sensor.name)
        message.put("d", *pose[:3, 3].tolist(), *quaternion(pose[:3, :3]))
    return bytes(message.data)


def quaternion(rotation: F64Array) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w), w >= 0, of a rotation (3, 3).

    K = 4 q q^T is linear in the rotation; its row with the largest diagonal is q up to a factor
    and far from 0 (S. W. Shepperd, "Quaternion from rotation matrix", 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    product = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )
    row = product[int(np.argmax(np.diagonal(product)))]
    x, y, z, w = (row / np.sqrt((row * row).sum())).tolist()
    # Adding 0.0 turns -0.0 into 0.0, so that equal poses give equal bytes.
    sign = -1.0 if w < 0 else 1.0
    return sign * x + 0.0, sign * y + 0.0, sign * z + 0.0, sign * w + 0.0


# IMU samples that may wait for the first scan: minutes at the rates of built-in IMUs.
WAITING_SAMPLES = 65536
WAITING_BYTES = 16 << 20
_TF_STATIC = "/tf_static"


class Sink(Protocol):
    """A file of messages under construction, in chunks."""

    @property
    def ended(self) -> int:
        """Chunks that are complete."""
        ...

    def safe(self) -> tuple[int, int]:
        """How many chunks the system has, and the bytes up to their end; while others are made."""
        ...

    def take(self) -> list[Chunk]:
        """The chunks that are complete since the last call, if they are not written at once."""
        ...

    def seal(self, chunks: Sequence[Chunk]) -> None:
        """Make chunks ready to be written; by any thread."""
        ...

    def put(self, chunks: Sequence[Chunk]) -> None:
        """Write sealed chunks, in the order in which they were taken."""
        ...

    def send(
        self, topic: str, kind: str, log_ns: int, message: bytes | memoryview, latched: bool = False
    ) -> None:
        """Append a message of type `kind`, package/Type; a topic is made at its first message."""
        ...

    def forward(self, message: Message) -> None:
        """Append a message as it was recorded; ExportError if the file cannot hold it."""
        ...

    def finish(self, summary: Summary, grid: dict[str, str]) -> None:
        """Add what the container has a place for, complete and close the file."""
        ...

    def abandon(self) -> None:
        """Close the file as it is."""
        ...


# Path, and the bytes to keep of an existing file, None: begin a new one.
NewSink: TypeAlias = Callable[[Path, int | None], Sink]


def extras_of(options: WriterOptions, *encodings: str) -> frozenset[str]:
    """What the fields of the point layout are made of, IMU samples, messages in `encodings`."""
    layout = CLOUD_LAYOUTS.get(options.point_layout)
    return frozenset({IMU, *encodings}) | (frozenset() if layout is None else layout.extras)


def layout_of(options: WriterOptions) -> Layout:
    """The layout of points that was asked for."""
    layout = CLOUD_LAYOUTS.get(options.point_layout)
    if layout is None:
        raise UsageError(
            f"--point-layout: wanted one of {', '.join(CLOUD_LAYOUTS)}, got "
            f"{options.point_layout!r}; choose one"
        )
    return layout


class BagWriter:
    """Writes a run; what precedes the first scan waits, since /tf_static comes before all."""

    def __init__(
        self, output: Output, info: RunInfo, options: WriterOptions, wire: NewWire, sink: NewSink
    ) -> None:
        self._info = info
        self._wire = wire
        self._layout = layout_of(options)
        self._idle: list[CloudMessage] = []
        self._waiting: list[ImuSamples | Message] = []
        self._begun = False
        # The chunk that each scan lies in whose chunk is not written, and how many lie before.
        self._open_scans: deque[int] = deque()
        self._safe_scans = 0
        self._topics: dict[int | None, str] = {None: "/points"}
        if options.split:
            self._topics |= {i: f"/{info.sensors[i].name}/points" for i in range(len(info.sensors))}
        imu = (f"/{sensor.name}/imu" for sensor in info.sensors)
        self._own = frozenset({_TF_STATIC, *self._topics.values(), *imu})
        self._output = output
        with export_errors(output.partial):
            self._sink = sink(output.partial, options.kept_bytes)

    def write(self, scan: Scan, sensor: int | None = None) -> Steps:
        """Write one scan as a PointCloud2, after what waited for it."""
        dense = scan.info.layout != "organized"
        cloud = taken(self._idle, self._new_cloud)
        message = cloud.assemble(points_of(scan), scan.start_ns, dense)
        yield
        yield from self._send_scan(scan, sensor, message)
        self._idle.append(cloud)

    def pass_over(self, scan: Scan, sensor: int | None = None) -> Steps:
        """Send what is as long as the scan: it lies in what is kept of the file."""
        dense = scan.info.layout != "organized"
        shape = (scan.points,) if dense else scan.time_ns.T.shape
        cloud = taken(self._idle, self._new_cloud)
        message = cloud.blank(shape, scan.start_ns)
        yield
        yield from self._send_scan(scan, sensor, message)
        self._idle.append(cloud)

    def flush(self) -> Steps:
        """Write the chunks that messages alone have completed."""
        yield
        yield from self._write_chunks()

    def safe(self) -> Safe:
        """The scans in written chunks."""
        chunks, kept_bytes = self._sink.safe()
        while self._open_scans and self._open_scans[0] < chunks:
            self._open_scans.popleft()
            self._safe_scans += 1
        return Safe(self._safe_scans, kept_bytes)

    def write_imu(self, samples: ImuSamples) -> None:
        """Write IMU samples at their own stamps."""
        self._write_or_wait(samples)

    def write_message(self, message: Message) -> None:
        """Write a message as it was recorded, at its log time."""
        if message.topic.name in self._own:
            raise ExportError(
                f"{self._output.target}: wanted topics besides those of the scans, got a recorded "
                f"{message.topic.name} as well; leave it out of what is passed, or rename the "
                "sensor in the rig"
            )
        self._write_or_wait(message)

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Add what tells of the run, close the file and give it its final name."""
        output = self._output
        with export_errors(output.partial):
            self._begin(summary.t_init_ns)
            self._sink.finish(summary, self._grid(summary))
        if last is not None:
            last(output.partial)
        # What may fail is done: beside an older output its own table stands up to now.
        inside = output.partial.is_dir()
        table = output.partial / SCANS_CSV if inside else side_path(output.target, SCANS_CSV)
        write_text(table, summary.scans_csv)
        output.publish()

    def abandon(self) -> None:
        """Close the file; it has no index and stays under `.partial`."""
        self._sink.abandon()

    def _new_cloud(self) -> CloudMessage:
        return CloudMessage(self._layout, self._info.frame_id, self._wire)

    def _send_scan(self, scan: Scan, sensor: int | None, message: memoryview) -> Steps:
        """Lay a scan in its chunk, and write the chunks that are complete with it."""
        with export_errors(self._output.partial):
            self._begin(scan.start_ns)
            self._open_scans.append(self._sink.ended)
            topic = self._topics[sensor]
            self._sink.send(topic, "sensor_msgs/PointCloud2", scan.start_ns, message)
        yield from self._write_chunks()

    def _write_chunks(self) -> Steps:
        """Take the chunks that are complete; then seal and write them."""
        with export_errors(self._output.partial):
            chunks = self._sink.take()
        yield
        self._sink.seal(chunks)
        yield
        with export_errors(self._output.partial):
            self._sink.put(chunks)

    def _write_or_wait(self, item: ImuSamples | Message) -> None:
        with export_errors(self._output.partial):
            if self._begun:
                self._send(item)
                return
            self._waiting.append(item)
            samples = sum(len(i.stamp_ns) for i in self._waiting if isinstance(i, ImuSamples))
            size = sum(len(i.data) for i in self._waiting if isinstance(i, Message))
            if samples >= WAITING_SAMPLES or size >= WAITING_BYTES:
                self._begin(None)

    def _begin(self, start_ns: int | None) -> None:
        """Write /tf_static at the earliest stamp known, then what waited."""
        if self._begun:
            return
        self._begun = True
        stamps = [stamp_ns for item in self._waiting for stamp_ns in _first_stamp(item)]
        stamp_ns = min(stamps if start_ns is None else [*stamps, start_ns], default=0)
        transforms = static_transforms(self._info, stamp_ns, self._wire)
        self._sink.send(_TF_STATIC, "tf2_msgs/TFMessage", stamp_ns, transforms, latched=True)
        for item in self._waiting:
            self._send(item)
        self._waiting.clear()

    def _send(self, item: ImuSamples | Message) -> None:
        if isinstance(item, Message):
            self._sink.forward(item)
            return
        name = self._info.sensors[item.sensor].name
        for which in range(len(item.stamp_ns)):
            message = imu_message(item, which, f"{name}_imu", self._wire)
            log_ns = int(item.stamp_ns[which])
            self._sink.send(f"/{name}/imu", "sensor_msgs/Imu", log_ns, message)

    def _grid(self, summary: Summary) -> dict[str, str]:
        info = self._info
        return {
            "rate_hz": info.rate_hz,
            "t_init_ns": "" if summary.t_init_ns is None else str(summary.t_init_ns),
            "slices": str(info.slices),
            "sensors": json.dumps([sensor.name for sensor in info.sensors], ensure_ascii=False),
            "timescale": info.timescale,
            "frame_id": info.frame_id,
        }


def _first_stamp(item: ImuSamples | Message) -> list[int]:
    """Earliest log time of what waits; none of samples that are none."""
    if isinstance(item, Message):
        return [item.host_ns]
    return [int(item.stamp_ns.min())] if len(item.stamp_ns) else []
