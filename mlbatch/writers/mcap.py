"""One MCAP file with PointCloud2, Imu and /tf_static of ROS 2 (facts/outputs.md, section 4).

Messages are assembled in `_ros2_messages`; here they only get topics, times and their place.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, cast

import mlbatch
from mlbatch.errors import UsageError
from mlbatch.types import ImuSamples, RunInfo, Scan, Summary
from mlbatch.writers._atomic import (
    SCANS_CSV,
    export_errors,
    prepare,
    side_path,
    write_text,
)
from mlbatch.writers._layouts import CLOUD_LAYOUTS, Layout, points_of
from mlbatch.writers._options import ScanWriter, WriterOptions
from mlbatch.writers._ros2_messages import CloudMessage, imu_message, static_transforms
from mlbatch.writers._ros2_types import definition, qos

FORMAT = "mcap"
SUFFIX: str | None = ".mcap"

CHUNK_BYTES = 4 * 2**20
# IMU samples that may wait for the first scan: minutes at the rates of built-in IMUs.
WAITING_SAMPLES = 65536


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start an MCAP file."""
    layout = CLOUD_LAYOUTS.get(options.point_layout)
    if layout is None:
        raise UsageError(
            f"--point-layout: wanted one of {', '.join(CLOUD_LAYOUTS)}, got "
            f"{options.point_layout!r}; choose one"
        )
    return McapWriter(target, info, options, layout)


class McapWriter:
    """Writes a run; IMU samples wait for the first scan, since /tf_static precedes everything."""

    def __init__(self, target: Path, info: RunInfo, options: WriterOptions, layout: Layout) -> None:
        self._info = info
        self._cloud = CloudMessage(layout, info.frame_id)
        self._waiting: list[ImuSamples] = []
        self._begun = False
        self._topics: dict[int | None, str] = {None: "/points"}
        if options.split:
            self._topics |= {i: f"/{info.sensors[i].name}/points" for i in range(len(info.sensors))}
        self._output = prepare(target, options.overwrite, folder=False)
        with export_errors(self._output.partial):
            self._file = self._output.partial.open("wb")
            self._container = Container(self._file)

    def write(self, scan: Scan, sensor: int | None = None) -> None:
        """Write one scan as a PointCloud2, after what waited for it."""
        dense = scan.info.layout != "organized"
        with export_errors(self._output.partial):
            self._begin(scan.start_ns)
            message = self._cloud.assemble(points_of(scan), scan.start_ns, dense)
            topic = self._topics[sensor]
            self._container.send(topic, "sensor_msgs/PointCloud2", scan.start_ns, message)

    def write_imu(self, samples: ImuSamples) -> None:
        """Write IMU samples at their own stamps."""
        with export_errors(self._output.partial):
            if self._begun:
                self._send_imu(samples)
                return
            self._waiting.append(samples)
            if sum(len(waiting.stamp_ns) for waiting in self._waiting) >= WAITING_SAMPLES:
                self._begin(None)

    def finish(self, summary: Summary) -> None:
        """Add metadata and scans.csv, close the file and give it its final name."""
        with export_errors(self._output.partial):
            self._begin(summary.t_init_ns)
            self._container.note("mlbatch.grid", self._grid(summary))
            self._container.note("mlbatch.report", {"json": summary.report_json})
            log_ns = summary.t_init_ns or 0
            self._container.attach(SCANS_CSV, "text/csv", log_ns, summary.scans_csv)
            self._container.finish()
            self._file.close()
        self._output.publish()
        write_text(side_path(self._output.target, SCANS_CSV), summary.scans_csv)

    def abandon(self) -> None:
        """Close the file; it has no index and stays under `.partial`."""
        # Closing flushes once more, onto the disk that has just refused.
        with contextlib.suppress(OSError):
            self._file.close()

    def _begin(self, start_ns: int | None) -> None:
        """Write /tf_static at the earliest stamp known, then the samples that waited."""
        if self._begun:
            return
        self._begun = True
        stamps = [int(samples.stamp_ns.min()) for samples in self._waiting if len(samples.stamp_ns)]
        stamp_ns = min(stamps if start_ns is None else [*stamps, start_ns], default=0)
        transforms = static_transforms(self._info, stamp_ns)
        self._container.send("/tf_static", "tf2_msgs/TFMessage", stamp_ns, transforms, latched=True)
        for samples in self._waiting:
            self._send_imu(samples)
        self._waiting.clear()

    def _send_imu(self, samples: ImuSamples) -> None:
        name = self._info.sensors[samples.sensor].name
        for which in range(len(samples.stamp_ns)):
            message = imu_message(samples, which, f"{name}_imu")
            log_ns = int(samples.stamp_ns[which])
            self._container.send(f"/{name}/imu", "sensor_msgs/Imu", log_ns, message)

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


class Container:
    """The MCAP file itself: topics, numbers and chunks, by the reference library."""

    def __init__(self, file: BinaryIO) -> None:
        from mcap.writer import CompressionType, Writer

        self._writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library=f"mlbatch {mlbatch.__version__}")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sent: dict[str, int] = {}

    def send(
        self, topic: str, kind: str, log_ns: int, message: bytes | memoryview, latched: bool = False
    ) -> None:
        """Append a message of type `kind`; a topic is made at its first message."""
        if topic not in self._channels:
            self._open_topic(topic, kind, latched)
        # The library only copies what it is given into its chunk: any buffer will do.
        data = cast(bytes, message)
        self._writer.add_message(self._channels[topic], log_ns, data, log_ns, self._sent[topic])
        self._sent[topic] += 1

    def note(self, name: str, values: dict[str, str]) -> None:
        """Append a metadata record."""
        self._writer.add_metadata(name, values)

    def attach(self, name: str, media_type: str, log_ns: int, text: str) -> None:
        """Append a text as an attachment."""
        # Time 0 means unknown: files must not depend on when they were written.
        self._writer.add_attachment(0, log_ns, name, media_type, text.encode())

    def finish(self) -> None:
        """Append the index."""
        finish: Callable[[], None] = self._writer.finish
        finish()

    def _open_topic(self, topic: str, kind: str, latched: bool) -> None:
        if kind not in self._schemas:
            name = kind.replace("/", "/msg/")
            text = definition(kind).encode()
            self._schemas[kind] = self._writer.register_schema(name, "ros2msg", text)
        metadata = {"offered_qos_profiles": qos(latched)}
        self._channels[topic] = self._writer.register_channel(
            topic, "cdr", self._schemas[kind], metadata
        )
        self._sent[topic] = 0
