"""An output of `convert` as a recording: its points become packets once more.

Points are in the body frame and stay there. A packet is a column of one lidar (`ros.point_packets`,
version 2). npz stores the columns; in other formats the points of one time are a column. Points
after the end of their window, which began before it, get its last nanosecond, and a label of each
point states its own time. Receive times are those of the columns, so that all lidars come in order.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch import sensors
from mlbatch.arrays import U8Array
from mlbatch.batching.windows import Coverage
from mlbatch.errors import RecordingError
from mlbatch.lidar.interface import Evidence, Lidar
from mlbatch.outputs.kinds import kind_of
from mlbatch.outputs.read import read
from mlbatch.outputs.run_files import RunFiles
from mlbatch.outputs.scan import Scan
from mlbatch.readers import open_recording
from mlbatch.reports.report import RunReport, report_of
from mlbatch.rig.rig import Rig, RigSensor, StreamSelector
from mlbatch.ros.point_packets import HEAD, Layout, Points, layout_of, pack
from mlbatch.types import (
    CaptureCounts,
    PacketBatch,
    Recording,
    Stream,
    StreamTable,
    WrappedRecording,
)
from mlbatch.units import parse_rate

# Fields without which points cannot be batched, by their arrays.
_NEEDED = {"time_ns": "time", "ring": "ring", "lidar_id": "lidar_id"}
_RING_BIT = 32
_TYPE_BIT = 48
# Bytes of a point in memory, of which packets may take a multiple.
_POINT_BYTES = 64


class OutputRecording(WrappedRecording):
    """The scans of an output as packets, and its messages.

    rig: lidars, body frame and rate of its run; lidars: in the same order; timescale: of all
    times; coverage: what the scans of the current pass cover; has_partial: with partial windows.
    """

    __slots__ = (
        *("coverage", "has_partial", "lidars", "path", "rig", "timescale", "topics"),
        *("_layouts", "_left_out", "_scans", "_streams"),
    )

    def __init__(self, path: Path, streams: StreamTable) -> None:
        form = kind_of(path).form
        if form is None:
            super().__init__(open_recording(path, streams))
        else:
            files = [one for one in (path, *path.rglob("*")) if one.is_file()]
            size_bytes = sum(one.stat().st_size for one in files)
            super().__init__(Recording(path, form.name, size_bytes))
        self.path = path
        self.coverage = Coverage()
        text, table = RunFiles.of(path).texts()
        report = None if text is None else report_of(path, text)
        self._scans = 0 if table is None else table.count("\n") - 1
        self.has_partial = report is None or (report.identity or {}).get("keep partial") == "True"
        self._left_out = "" if report is None else _left_out(report)
        first = self._first()
        self._refuse(first)
        info = first.info
        scans = {"/points", *(f"/{one.name}/points" for one in info.sensors)}
        self.topics = tuple(topic for topic in self.inner.topics if topic.name not in scans)
        self.timescale = info.timescale
        selectors = [StreamSelector(topic=f"/{one.name}/points") for one in info.sensors]
        self._streams = [streams.number(Stream(topic=one.topic)) for one in selectors]
        streams.untimed.update(self._streams)
        self.rig = Rig(
            tuple(
                RigSensor(one.name, stream=selector, extrinsics=one.body_from_sensor, optional=True)
                for one, selector in zip(info.sensors, selectors, strict=True)
            ),
            first.frame_id,
            parse_rate(info.rate_hz),
        )
        found = {number: layout_of(points, 0).slots for number, points in self._points(first)}
        most = max(found.values(), default=1)
        self._layouts = [
            Layout(0, found.get(number, most), has_labels=True)
            for number in range(len(info.sensors))
        ]
        self.lidars = []
        for number, one in enumerate(info.sensors):
            lidar = _lidar(self._layouts[number], selectors[number].topic)
            lidar.model = one.model or lidar.model
            lidar.mode = f"scans at {info.rate_hz} Hz"
            lidar.calibration = str(path)
            self.lidars.append(lidar)

    @property
    def as_output(self) -> OutputRecording:
        """Itself, also for recordings that wrap it."""
        return self

    def describe(self) -> str:
        """How the output is read, in a line."""
        rate = self.rig.rate
        return (
            f"{self.path.name}: an output of mlbatch convert ({rate} Hz); its points stay where "
            f"they are, in {self.rig.body_frame}, at their times; its run left out: "
            f"{self._left_out or 'nothing'}"
        )

    # -- scans --------------------------------------------------------------------------------

    def packets(self) -> Generator[PacketBatch, None, None]:
        """Yield the columns of all scans, and the messages to keep; each call is a new pass."""
        self.coverage.begin()
        self.inner.counts = CaptureCounts()
        with contextlib.closing(self._messages()) as messages:
            waiting = next(messages, None)
            for number, scan in enumerate(read(self.path, by_window=True), 1):
                while waiting is not None and waiting.messages[0].host_ns < scan.end_ns:
                    yield waiting
                    waiting = next(messages, None)
                self.coverage.add(scan.start_ns, scan.end_ns, is_complete=scan.complete)
                packets = self._packets(scan)
                self.inner.counts.frames += len(packets)
                self.inner.counts.datagrams += len(packets)
                if self._scans:
                    self.inner.position_bytes = self.size_bytes * number // self._scans
                yield packets
            if waiting is not None:
                yield waiting
            yield from messages

    def _messages(self) -> Generator[PacketBatch, None, None]:
        """Batches of messages to keep, without packets."""
        if self.keep:
            self.inner.keep = self.keep
            with contextlib.closing(self.inner.packets()) as batches:
                for batch in batches:
                    if batch.messages:
                        yield replace(batch.take(slice(0, 0)), messages=batch.messages)

    def _first(self) -> Scan:
        """The first scan with points, else the first one; RecordingError without any."""
        empty: Scan | None = None
        for scan in read(self.path, by_window=True):
            if scan.point_count:
                return scan
            empty = empty or scan
        if empty is None:
            raise RecordingError(f"{self.path}: expected scans, found none; convert again")
        return empty

    # -- packets ------------------------------------------------------------------------------

    def _refuse(self, scan: Scan) -> None:
        """Raise RecordingError for scans that cannot be batched again."""
        variants = dict(scan.info.variants)
        if "deskew" in variants:
            raise RecordingError(
                f"{self.path}: expected points where they were measured, found points moved to one "
                f"time (--deskew {variants['deskew']}); give the recording that was converted"
            )
        if "batching" in variants:
            raise RecordingError(
                f"{self.path}: expected windows, found sets of sweeps (--batching "
                f"{variants['batching']}), which have columns twice; give the recording that was "
                "converted"
            )
        unstored = set(scan.absent)
        if len(scan.info.sensors) == 1:
            unstored.discard("lidar_id")
        missing = [name for key, name in _NEEDED.items() if key in unstored]
        if missing:
            raise RecordingError(
                f"{self.path}: expected time, ring and lidar_id of each point, found an output "
                f"without {', '.join(missing)}; give the recording that was converted, or convert "
                "it to npz or a message with the point layout standard"
            )

    def _points(self, scan: Scan) -> Iterator[tuple[int, Points]]:
        """The points of each lidar that has some; rings are in their labels."""
        where = scan.is_valid.reshape(-1)
        shape = scan.xyz.shape[:-1]

        def of(values: npt.NDArray[Any] | None) -> npt.NDArray[Any]:
            """Values of the points; zeros where the output has none."""
            if values is None or values.shape != shape:
                return np.zeros(int(np.count_nonzero(where)), np.int64)
            return values.reshape(-1)[where]

        times_ns = scan.start_ns + of(scan.time_ns).astype(np.int64)
        stamps_ns = np.minimum(times_ns, scan.end_ns - 1)
        if len(scan.column_stamp_ns):
            rows = scan.column
            if rows is None:
                rows = np.broadcast_to(np.arange(shape[0])[:, None], shape).astype(np.uint32)
            stamps_ns = scan.column_stamp_ns[of(rows)]
        labels = times_ns - stamps_ns
        labels |= of(scan.ring).astype(np.int64) << _RING_BIT
        labels |= of(scan.return_type).astype(np.int64) << _TYPE_BIT
        reals = np.empty((4, len(labels)), np.float32)
        reals[:3] = scan.xyz.reshape(-1, 3)[where].T
        reals[3] = of(scan.intensity)
        owners = of(scan.lidar_id)
        none = np.zeros(len(labels), np.uint8)
        points = Points(stamps_ns, reals, None, none, none, labels)
        if len(shape) > 1:
            # Points of a column are in the order of their slots, not of their times.
            order = np.lexsort((of(scan.ring), times_ns))
            points = points.take(order)
            owners = owners[order]
        for number in np.unique(owners).tolist():
            if number >= len(scan.info.sensors):
                raise RecordingError(
                    f"{self.path}: expected points of {len(scan.info.sensors)} lidars, found "
                    f"lidar_id {number}; see `mlbatch verify`"
                )
            yield number, points.take(owners == number)

    def _packets(self, scan: Scan) -> PacketBatch:
        """The columns of a scan in order of time, then lidar."""
        data: list[U8Array] = [np.zeros(0, np.uint8)]
        parts = [np.zeros((4, 0), np.int64)]
        end = 0
        for number, points in self._points(scan):
            packets = pack(points, self._layouts[number], _POINT_BYTES * len(points))
            count, size = packets.shape
            part = np.empty((4, count), np.int64)
            part[0] = end + np.arange(count) * size
            part[1] = size
            part[2] = self._streams[number]
            heads = np.ascontiguousarray(packets[:, : HEAD.itemsize]).view(HEAD)
            part[3] = heads["stamp_ns"][:, 0]
            parts.append(part)
            data.append(packets.reshape(-1))
            end += packets.size
        rows = np.concatenate(parts, axis=1)
        start, size_bytes, stream, host_ns = rows[:, np.argsort(rows[3], kind="stable")]
        return PacketBatch(np.concatenate(data), start, size_bytes, stream, host_ns)


def _lidar(layout: Layout, topic: str) -> Lidar:
    """The decoder of packets of a layout, as it would be found by one of them."""
    sample = np.zeros((1, layout.size), np.uint8)
    sample[:, : HEAD.itemsize] = layout.begin.view(np.uint8)
    evidence = Evidence(Stream(topic=topic), layout.size, sample, np.zeros(1, np.int64))
    calibrations = sensors.built_in(set(sensors.senders(layout.size, sample)))
    best = max(calibrations, key=lambda calibration: calibration.match_score(evidence))
    return best.lidar({}, evidence)


def _left_out(report: RunReport) -> str:
    """Columns and points that a run did not write, by lidar and reason; "" for none."""
    found = []
    for sensor in report.sensors:
        points = asdict(sensor.ledger.points)
        filtered = {name: points[name] for name in ("range", "box", "repeated")}
        for what, counts in (("columns", sensor.ledger.columns.dropped), ("points", filtered)):
            reasons = [f"{name} {count}" for name, count in counts.items() if count]
            if reasons:
                found.append(f"{what} of {sensor.name} ({', '.join(reasons)})")
    return ", ".join(found)
