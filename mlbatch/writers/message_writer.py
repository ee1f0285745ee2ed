"""Outputs of ROS messages: topics, message order, /tf_static, IMU samples, PointCloud2 assembly.

The fields of the messages: docs/sources/messages.md and docs/sources/outputs.md. A format gives a
`MessageFile`, the container to which the messages are written, and a `Wire`, their encoding.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
from isal.isal_zlib import crc32

from mlbatch.arrays import F64Array
from mlbatch.errors import ExportError, UsageError
from mlbatch.frames.transforms import quaternion
from mlbatch.ros.definitions import FIELD_CODES
from mlbatch.ros.encoding import Wire
from mlbatch.types import (
    IMU,
    ImuSamples,
    Message,
    RecordLayout,
    RunInfo,
    Scan,
    Summary,
    instant_ns,
)
from mlbatch.units import NS_PER_S
from mlbatch.writers.atomic import SCANS_CSV, export_errors, prepare, side_path, write_text
from mlbatch.writers.base import ScanJob, WriterOptions
from mlbatch.writers.output_file import take_scratch
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS, Layout, ScanRecords

# Limits of what waits for the first scan. Samples: minutes at the rates of built-in IMUs.
WAITING_SAMPLES = 65536
WAITING_BYTES = 16 << 20
# Memory of a message in addition to its bytes.
_MESSAGE_BYTES = 400
TF_STATIC = "/tf_static"
TF_TYPE = "tf2_msgs/TFMessage"

# A header begins with the time, after four bytes: its kind in CDR, its number in ROS 1.
_STAMP_AT = 4
# sensor_msgs/Imu: -1 in the covariance means no orientation; a covariance of zeros is unknown.
_NO_ORIENTATION = (0.0, 0.0, 0.0, 1.0, -1.0, *[0.0] * 8)
_UNKNOWN_COVARIANCE = (0.0,) * 9


class PendingChunk(Protocol):
    """Messages of a file that are complete and not written yet."""

    def compress(self) -> None:
        """Compress the messages and compute checksums. Any thread."""
        ...

    def write(self) -> None:
        """Write the chunk; in the order of `take_chunks`."""
        ...


class MessageFile(Protocol):
    """A container of messages under construction; it collects messages to chunks."""

    def take_chunks(self) -> Sequence[PendingChunk]:
        """Return the chunks completed since the last call; none if they are written at once."""
        ...

    def send(
        self,
        topic: str,
        kind: str,
        log_ns: int,
        message: bytes | memoryview,
        latched: bool = False,
        crc: int | None = None,
    ) -> None:
        """Append a message of type `kind`, package/Type; the first one creates the topic.

        crc: CRC-32 of the message, if known.
        """
        ...

    def forward(self, message: Message) -> None:
        """Append a recorded message unchanged; ExportError if the file cannot contain it."""
        ...

    def finish(self, summary: Summary, grid: dict[str, str]) -> None:
        """Add metadata where the container has a place for them, complete and close the file."""
        ...

    def abandon(self) -> None:
        """Close the incomplete file."""
        ...


NewWire: TypeAlias = Callable[[], Wire]


def extras_of(encodings: tuple[str, ...], options: WriterOptions) -> frozenset[str]:
    """Return the inputs of the point layout, IMU samples, and messages in `encodings`."""
    layout = CLOUD_LAYOUTS.get(options.point_layout)
    return frozenset({IMU, *encodings}) | (frozenset() if layout is None else layout.extras)


def record_of(options: WriterOptions) -> RecordLayout | None:
    """Return the records of the point layout; None if only numpy can pack them."""
    layout = CLOUD_LAYOUTS.get(options.point_layout)
    return None if layout is None else layout.record


def _layout_of(options: WriterOptions) -> Layout:
    """Return the point layout of the options."""
    layout = CLOUD_LAYOUTS.get(options.point_layout)
    if layout is None:
        raise UsageError(
            f"--point-layout: expected one of {', '.join(CLOUD_LAYOUTS)}, found "
            f"{options.point_layout!r}; choose one"
        )
    return layout


class MessageWriter:
    """Writes a run as messages; those before the first scan wait, since /tf_static is first."""

    def __init__(
        self,
        target: Path,
        info: RunInfo,
        options: WriterOptions,
        opener: Callable[[Path], MessageFile] | None = None,
        wire: NewWire = Wire,
        *,
        folder: bool = False,
    ) -> None:
        """opener: opens the file at the path of the partial output; None: see `file_at`."""
        # Before anything is created, as it may be refused.
        self._layout = _layout_of(options)
        _refuse_same_frames(target, info)
        keep = options.files is not None and options.files.is_continued
        self._output = prepare(target, options.overwrite, folder, keep, options.fsync)
        self._info = info
        self._wire = wire
        self.idle: list[CloudMessage] = []  # buffers that no job uses
        self._waiting: list[ImuSamples | Message] = []
        self._waiting_samples = 0
        self._waiting_bytes = 0
        self._begun = False
        self._topics: dict[int | None, str] = {None: "/points"}
        if options.split:
            for number, sensor in enumerate(info.sensors):
                self._topics[number] = f"/{sensor.name}/points"
        self._imu = [ImuMessages(imu_frame(sensor.name), wire) for sensor in info.sensors]
        senders = (one for one in info.sensors if one.sensor_from_imu is not None)
        imu = (f"/{sensor.name}/imu" for sensor in senders)
        self._own = frozenset({TF_STATIC, *self._topics.values(), *imu})
        self._file: MessageFile | None = None
        if opener is not None:
            with self.errors():
                self._file = opener(self._output.partial)

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that writes a scan as a PointCloud2, after messages that wait for it."""
        return _CloudJob(self, scan, sensor)

    def flush(self) -> ScanJob:
        """Return the job that writes complete chunks."""
        return ChunkJob(self)

    def write_imu(self, samples: ImuSamples) -> None:
        """Write IMU samples at their own timestamps."""
        self._send_or_wait(samples)

    def write_message(self, message: Message) -> None:
        """Forward a recorded message at its log time."""
        topic = message.topic.name
        if topic in self._own:
            raise ExportError(
                f"{self._output.target}: expected recorded topics other than those of the scans, "
                f"found {topic}; do not pass it, or rename the sensor in the rig"
            )
        self._send_or_wait(message)

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Add metadata, close the file and move it to its final path."""
        output = self._output
        with self.errors():
            self._begin(summary.t_init_ns)
            self._finish_files(summary, grid_of(self._info, summary.t_init_ns))
        output.sync()
        if last is not None:
            last(output.partial)
        # Only after all that may fail: until now the table of an older output is in place.
        inside = output.partial.is_dir()
        table = output.partial / SCANS_CSV if inside else side_path(output.target, SCANS_CSV)
        write_text(table, summary.scans_csv, output.fsync)
        output.publish()

    def abandon(self) -> None:
        """Close the file; it has no index and stays under `.partial`."""
        self._abandon_files()
        self._output.close()

    # -- files --------------------------------------------------------------------------------

    def file_at(self, log_ns: int) -> MessageFile | None:
        """Return the file of a message of this log time; None: another run writes it. In order."""
        return self._file

    def take_chunks(self) -> Sequence[PendingChunk]:
        """Return the chunks completed since the last call."""
        return () if self._file is None else self._file.take_chunks()

    def _finish_files(self, summary: Summary, grid: dict[str, str]) -> None:
        if self._file is not None:
            self._file.finish(summary, grid)

    def _abandon_files(self) -> None:
        if self._file is not None:
            self._file.abandon()

    def _put(
        self,
        topic: str,
        kind: str,
        log_ns: int,
        message: bytes | memoryview,
        latched: bool = False,
        crc: int | None = None,
    ) -> None:
        file = self.file_at(log_ns)
        if file is not None:
            file.send(topic, kind, log_ns, message, latched, crc)

    # -- for the stages of jobs ---------------------------------------------------------------

    def errors(self) -> AbstractContextManager[None]:
        """Errors of the file as ExportErrors."""
        return export_errors(self._output.partial)

    def start_window(self, index: int) -> None:
        """Prepare for the window of a scan. In order."""

    def pack_scan(self, scan: Scan) -> tuple[CloudMessage, memoryview]:
        """Return the message of a scan and the buffer that contains it. Any thread."""
        dense = scan.info.layout != "organized"
        cloud = take_scratch(self.idle, self._new_cloud)
        return cloud, cloud.message(scan, stamp_ns(scan), dense)

    def send_scan(
        self, scan: Scan, sensor: int | None, message: memoryview, crc: int | None
    ) -> None:
        """Add the message of a scan to its chunk; crc: its CRC-32. In order."""
        self.place_scan(scan)
        with self.errors():
            topic = self._topics[sensor]
            self._put(topic, "sensor_msgs/PointCloud2", stamp_ns(scan), message, crc=crc)

    def place_scan(self, scan: Scan) -> None:
        """Write what precedes a scan. In order."""
        with self.errors():
            self._begin(stamp_ns(scan))

    # -- messages -----------------------------------------------------------------------------

    def _new_cloud(self) -> CloudMessage:
        return CloudMessage(self._layout, self._info.frame_id, self._wire)

    def _send_or_wait(self, item: ImuSamples | Message) -> None:
        with self.errors():
            if self._begun:
                self._send(item)
                return
            self._waiting.append(item)
            if isinstance(item, Message):
                self._waiting_bytes += len(item.data) + _MESSAGE_BYTES
            else:
                self._waiting_samples += len(item.stamp_ns)
            if self._waiting_samples >= WAITING_SAMPLES or self._waiting_bytes >= WAITING_BYTES:
                self._begin(None)

    def _begin(self, start_ns: int | None) -> None:
        """Write /tf_static at the earliest known timestamp, then what waited; once."""
        if self._begun:
            return
        self._begun = True
        stamps = [] if start_ns is None else [start_ns]
        for item in self._waiting:
            if isinstance(item, Message):
                stamps.append(item.host_ns)
            else:
                stamps += item.stamp_ns.tolist()
        stamp_ns = min(stamps, default=0)
        transforms = static_transforms(self._info, stamp_ns, self._wire)
        self._put(TF_STATIC, TF_TYPE, stamp_ns, transforms, latched=True)
        for item in self._waiting:
            self._send(item)
        self._waiting.clear()

    def _send(self, item: ImuSamples | Message) -> None:
        if isinstance(item, Message):
            file = self.file_at(item.host_ns)
            if file is not None:
                file.forward(item)
            return
        messages = self._imu[item.sensor].of(item)
        topic = f"/{self._info.sensors[item.sensor].name}/imu"
        for stamp_ns, message in zip(item.stamp_ns.tolist(), messages, strict=True):
            self._put(topic, "sensor_msgs/Imu", stamp_ns, message)


def grid_of(info: RunInfo, t_init_ns: int | None) -> dict[str, str]:
    """Return the metadata record `mlbatch.grid` of a run."""
    return {
        "rate_hz": info.rate_hz,
        "t_init_ns": "" if t_init_ns is None else str(t_init_ns),
        "slices": str(info.slices),
        "sensors": json.dumps([sensor.name for sensor in info.sensors], ensure_ascii=False),
        "timescale": info.timescale,
        "frame_id": info.frame_id,
        "sort": info.sort,
        **dict(info.variants),
    }


def stamp_ns(scan: Scan) -> int:
    """Return the time of the message of a scan: an instant of its window, by `--stamp`."""
    return instant_ns(scan.info.variant("stamp", "start"), scan.start_ns, scan.end_ns)


class ChunkJob(ScanJob):
    """Writes the chunks that are complete at its `append`."""

    def __init__(self, writer: MessageWriter) -> None:
        self._writer = writer
        self._chunks: Sequence[PendingChunk] = ()

    def start(self, index: int) -> None:
        """Begin the window."""
        self._writer.start_window(index)

    def append(self) -> None:
        """Take the chunks."""
        with self._writer.errors():
            self._chunks = self._writer.take_chunks()

    def compress(self) -> None:
        """Compress them."""
        for chunk in self._chunks:
            chunk.compress()

    def commit(self) -> None:
        """Write them."""
        with self._writer.errors():
            for chunk in self._chunks:
                chunk.write()


class _CloudJob(ChunkJob):
    """Writes one scan, and the chunks that are complete with it."""

    def __init__(self, writer: MessageWriter, scan: Scan, sensor: int | None) -> None:
        super().__init__(writer)
        self._scan = scan
        self._sensor = sensor

    def pack(self) -> None:
        self._cloud, self._message = self._writer.pack_scan(self._scan)
        self.checksum = crc32(self._message, 0)

    def append(self) -> None:
        self._writer.send_scan(self._scan, self._sensor, self._message, self.checksum)
        super().append()

    def commit(self) -> None:
        super().commit()
        self._writer.idle.append(self._cloud)


class CloudMessage:
    """Assembles sensor_msgs/PointCloud2 around the records of scans."""

    def __init__(self, layout: Layout, frame_id: str, wire: NewWire) -> None:
        self._layout = layout
        self._frame_id = frame_id
        self._wire = wire
        self._records = ScanRecords(layout)
        self._describe()

    def message(self, scan: Scan, stamp_ns: int, dense: bool) -> memoryview:
        """Return the message of a scan, in the buffer of its records: valid as long as that is."""
        packed = self._records.of(scan)
        head = self._head(packed.shape, stamp_ns)
        buffer, start = packed.buffer, packed.begin - len(head)
        if start < 0:
            # A frame name of thousands of characters.
            return memoryview(
                bytes(head) + buffer[packed.begin : packed.end].tobytes() + bytes([dense])
            )
        buffer[start : packed.begin] = np.frombuffer(head, dtype=np.uint8)
        buffer[packed.end] = dense
        return buffer[start : packed.end + 1].data

    def _head(self, shape: tuple[int, ...], stamp_ns: int) -> bytearray:
        """Return the message up to its points; shape: (width,) or (height, width)."""
        step = self._layout.step
        height, width = shape if len(shape) == 2 else (1, shape[0])
        struct.pack_into("<iI", self._template, _STAMP_AT, *divmod(stamp_ns, NS_PER_S))
        struct.pack_into("<II", self._template, self._size_at, height, width)
        # The row and the data, at the end.
        size = len(self._template)
        struct.pack_into("<II", self._template, size - 8, step * width, step * width * height)
        return self._template

    def _describe(self) -> None:
        """Begin the template of `_head`; all heads have its length."""
        message = self._wire()
        message.header(0, self._frame_id)
        message.put("I", 0)
        self._size_at = len(message.data) - 4
        message.put("I", 0, len(self._layout.fields))
        for field in self._layout.fields:
            message.text(field.name)
            message.put("I", field.offset)
            message.put("B", FIELD_CODES[field.dtype])
            message.put("I", 1)
        message.put("B", 0)
        message.put("I", self._layout.step, 0, 0)
        self._template = message.data


class ImuMessages:
    """Makes sensor_msgs/Imu of a sensor, which differ in times and values alone."""

    def __init__(self, frame_id: str, wire: NewWire) -> None:
        message = wire()
        message.header(0, frame_id)
        message.put("d", *_NO_ORIENTATION)
        # Angular velocity and acceleration, each with its covariance: the end of the message.
        message.put("d", 0, 0, 0, *_UNKNOWN_COVARIANCE, 0, 0, 0, *_UNKNOWN_COVARIANCE)
        size = len(message.data)
        acceleration_at = size - 8 * (3 + len(_UNKNOWN_COVARIANCE))
        self._template = message.data
        self._layout = np.dtype(
            {
                "names": ["time", "angular_velocity", "acceleration"],
                "formats": [("<u4", 2), ("<f8", 3), ("<f8", 3)],
                "offsets": [_STAMP_AT, 2 * acceleration_at - size, acceleration_at],
                "itemsize": size,
            }
        )

    def of(self, samples: ImuSamples) -> list[bytes]:
        """Return the messages of all samples."""
        data = self._template * len(samples.stamp_ns)
        rows = np.frombuffer(data, self._layout)
        rows["time"][:, 0], rows["time"][:, 1] = np.divmod(samples.stamp_ns, NS_PER_S)
        rows["angular_velocity"] = samples.angular_velocity
        rows["acceleration"] = samples.acceleration
        size = self._layout.itemsize
        return [bytes(data[begin : begin + size]) for begin in range(0, len(data), size)]


def static_transforms(info: RunInfo, stamp_ns: int, wire: NewWire) -> bytes:
    """Return the tf2_msgs/TFMessage of the frames that messages may name.

    Sensors and frames of the recording in the body frame, IMUs in the frame of their sensor.
    """
    edges = static_edges(info)
    message = wire()
    message.put("I", len(edges))
    for parent, child, pose in edges:
        message.header(stamp_ns, parent)
        message.text(child)
        message.put("d", *pose[:3, 3].tolist(), *quaternion(pose[:3, :3]))
    return bytes(message.data)


def static_edges(info: RunInfo) -> list[tuple[str, str, F64Array]]:
    """Return parent, child and (4, 4) parent_from_child of all transforms, m.

    A sensor whose own frame is the body frame has no transform: no frame is its own child.
    """
    edges = [
        (info.frame_id, sensor.name, sensor.body_from_sensor)
        for sensor in info.sensors
        if sensor.name != info.frame_id
    ]
    edges += [
        (sensor.name, imu_frame(sensor.name), sensor.sensor_from_imu)
        for sensor in info.sensors
        if sensor.sensor_from_imu is not None
    ]
    # Own frames describe the scans; a recorded one of the same name is left out.
    own = {info.frame_id, *(child for _, child, _ in edges)}
    edges += [(info.frame_id, name, pose) for name, pose in info.frames if name not in own]
    return edges


def imu_frame(sensor: str) -> str:
    """Return the frame of a sensor's IMU messages."""
    return f"{sensor}_imu"


def _refuse_same_frames(target: Path, info: RunInfo) -> None:
    """Raise ExportError if two frames of the output have one name."""
    frames = Counter(child for _, child, _ in static_edges(info))
    frames[info.frame_id] += 1
    for frame, count in frames.items():
        if count > 1:
            raise ExportError(
                f"{target}: expected frames of different names, found {frame} for a sensor and for "
                "an IMU or the body; rename the sensor or body_frame in the rig"
            )
