"""One MCAP file with PointCloud2, Imu and /tf_static of ROS 2 (facts/outputs.md, section 4).

Messages are assembled in `_ros2_messages`; here they only get topics, times and their place.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from mlbatch.errors import UsageError
from mlbatch.types import IMU, ImuSamples, RunInfo, Scan, Summary
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

FORMAT = "mcap"
SUFFIX: str | None = ".mcap"

# IMU samples that may wait for the first scan: minutes at the rates of built-in IMUs.
WAITING_SAMPLES = 65536


def extras(options: WriterOptions) -> frozenset[str]:
    """What the fields of the point layout are made of, and IMU samples."""
    layout = CLOUD_LAYOUTS.get(options.point_layout)
    return frozenset({IMU}) if layout is None else layout.extras | {IMU}


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
        # The library comes in here, so that naming the format does not load it.
        from mlbatch.writers._mcap_file import Container

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
