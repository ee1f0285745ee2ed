"""An output of `convert` as a recording: its points become packets once more.

Points are in the body frame and stay there. A packet is a column of one lidar (`ros.point_packets`,
version 2). npz stores the columns; of others the points of one time are a column, and points after
the end of their window, which began before it, are of its last nanosecond: a label of each point
states its own time. Receive times are those of the columns, so that all lidars come in order.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterable, Iterator
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
from mlbatch.outputs import containers
from mlbatch.outputs.kinds import kind_of
from mlbatch.outputs.read import MessageScans, read
from mlbatch.outputs.run_files import RunFiles
from mlbatch.outputs.scan import Scan
from mlbatch.readers import open_recording
from mlbatch.report.report import RunReport, report_of
from mlbatch.rig.rig import Rig, RigSensor, StreamSelector
from mlbatch.ros.point_packets import HEAD, Layout, Points, layout_of, pack
from mlbatch.types import (
    Message,
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
    times; coverage: what the scans of the current pass cover, None with partial windows.
    """

    __slots__ = (
        *("coverage", "lidars", "path", "rig", "timescale", "topics"),
        *("_files", "_layouts", "_left_out", "_messages", "_streams"),
    )

    def __init__(self, path: Path, streams: StreamTable) -> None:
        kind = kind_of(path)
        self._files = 0
        if kind.form is None:
            super().__init__(open_recording(path, streams))
            self._messages: MessageScans | None = MessageScans.of_output(path)
        else:
            files = [one for one in (path, *path.rglob("*")) if one.is_file()]
            self._files = len(files)
            size_bytes = sum(one.stat().st_size for one in files)
            super().__init__(Recording(path, kind.form.name, size_bytes))
            self._messages = None
        self.path = path
        names = {} if self._messages is None else self._messages.topics
        self.topics = tuple(topic for topic in self.inner.topics if topic.name not in names)
        self._layouts: dict[int, Layout] = {}
        self._streams: list[int] = []
        self.coverage: Coverage | None = Coverage()
        text = RunFiles.of(path).texts()[0]
        report = None if text is None else report_of(path, text)
        if report is None or (report.identity or {}).get("keep partial") == "True":
            self.coverage = None
        self._left_out = "" if report is None else _left_out(report)
        first = self._first()
        self._refuse(first)
        info = first.info
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
        self._choose_layouts(first, len(info.sensors))
        self.lidars = []
        for number, one in enumerate(info.sensors):
            lidar = _lidar(self._layouts[number], selectors[number].topic)
            lidar.model = one.model or lidar.model
            lidar.mode = f"scans at {info.rate_hz} Hz"
            lidar.calibration = str(path)
            self.lidars.append(lidar)

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
        if self.coverage is not None:
            self.coverage.begin()
        with contextlib.closing(self._parts()) as parts:
            for batch, scans in parts:
                if batch is not None and batch.messages:
                    yield batch
                for scan in scans:
                    if self.coverage is not None:
                        self.coverage.add(scan.start_ns, scan.end_ns, is_complete=scan.complete)
                    packets = self._packets(scan)
                    self.inner.counts.frames += len(packets)
                    self.inner.counts.datagrams += len(packets)
                    yield packets

    def _parts(self) -> Generator[tuple[PacketBatch | None, Iterator[Scan]], None, None]:
        """Batches of the container without packets, each with its scans."""
        if self._messages is None:
            self.inner.position_bytes = 0
            self.inner.counts = type(self.inner.counts)()
            for number, scan in enumerate(read(self.path, by_window=True), 1):
                done = min(number, self._files)
                self.inner.position_bytes = self.size_bytes * done // self._files
                yield None, iter((scan,))
            return
        names = frozenset(self._messages.topics)
        self.inner.keep = self.keep | names
        self.inner.lend = names - self.keep
        batches = self.inner.packets()
        try:
            for batch in batches:
                kept = tuple(one for one in batch.messages if one.topic.name in self.keep)
                others = (one for one in batch.messages if one.topic.name in names)
                empty = replace(batch.take(slice(0, 0)), messages=kept)
                yield empty, _scans_of(self._messages, others)
        finally:
            batches.close()

    def _first(self) -> Scan:
        """The first scan with points, else the first one; RecordingError without any."""
        empty: Scan | None = None
        with contextlib.closing(self._parts()) as parts:
            for _, scans in parts:
                for scan in scans:
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

    def _choose_layouts(self, scan: Scan, lidars: int) -> None:
        """Choose the slots of the packets of each lidar, by a scan."""
        found = {
            number: layout_of(replace(points, ring=None), 0)
            for number, points in self._points(scan)
        }
        most = max((one.slots for one in found.values()), default=1)
        for number in range(lidars):
            slots = found[number].slots if number in found else most
            self._layouts[number] = Layout(0, slots, has_labels=True)

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


def _scans_of(scans: MessageScans, messages: Iterable[Message]) -> Iterator[Scan]:
    for message in messages:
        topic = message.topic
        own = containers.Message(
            topic.name, topic.name, topic.type, topic.encoding, message.host_ns, 0, message.data
        )
        scan = scans.scan(own)
        if scan is not None:
            yield scan


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
