"""An opened recording: its sensors, and iterators over scans, packets and IMU samples.

Everything is read when it is asked for. Each iterator is a pass of its own over the files.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from operator import index as whole_number
from pathlib import Path
from typing import TYPE_CHECKING, SupportsIndex, overload

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.batching.grid import Grid
from mlbatch.batching.windows import Limit
from mlbatch.discovery.discover import Discovery, discover
from mlbatch.discovery.types import Note
from mlbatch.errors import NoScanError, RecordingError, UsageError
from mlbatch.native import require_library
from mlbatch.outputs.inputs import open_inputs
from mlbatch.outputs.scan import Scan, preformatted
from mlbatch.outputs.table import Rows, read_table
from mlbatch.pipeline.conversion import Conversion, SkippedWindow
from mlbatch.pipeline.ingest import Ingest
from mlbatch.pipeline.job import DEFAULT_RATE, Job
from mlbatch.pipeline.session import Session
from mlbatch.pipeline.time_limits import time_limit
from mlbatch.python.options import (
    Moment,
    Rate,
    WindowOptions,
    check_names,
    documented,
    window_job,
)
from mlbatch.readers import merge
from mlbatch.types import ImuSamples, StreamTable
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    # In `typing` from Python 3.11 on.
    from typing_extensions import Unpack

# `print` reads recordings up to this size to their end, for their duration.
_MEASURED_BYTES = 256 << 20


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSensor:
    """A lidar of a recording."""

    name: str
    model: str
    mode: str
    serial: str  # "" if unknown
    channels: int
    returns: int
    streams: tuple[str, ...]  # in the first 10 s
    calibration: str
    extrinsics: F64Array | None  # (4, 4) body_from_sensor, m; None: unknown
    extrinsics_source: str  # rig, tf_static, metadata, ...; "" if unknown


@dataclass(frozen=True, slots=True)
class RawPacket:
    """A UDP payload of a lidar as it was recorded."""

    host_ns: int  # receive time at the capture host
    data: bytes
    stream: str


class Recording:
    """One session: recordings that belong together, and the sensors found in them.

    job: its options, shared with the command line.
    """

    def __init__(self, job: Job) -> None:
        """Read the first 10 s; MlbatchError where `convert` would refuse the recording.

        Missing extrinsics are an error of `scans` only.
        """
        self.job = job
        self._duration_s: float | None = None
        self._scans: int | None = None
        self._pass: _Pass | None = None
        found = self._discover()
        self.frame_id = found.frame_id
        rig_rate = None if found.rig is None else found.rig.rate
        self._rate = job.rate or rig_rate or DEFAULT_RATE
        self.size_bytes = sum(one.size_bytes for one in found.recordings)
        self.containers = tuple(one.container for one in found.recordings)
        self.warnings = tuple(note.message for note in found.notes)
        streams = found.sampler.table.streams
        self.sensors: Mapping[str, RecordedSensor] = {
            sensor.name: RecordedSensor(
                name=sensor.name,
                model=sensor.lidar.model,
                mode=sensor.lidar.mode,
                serial=sensor.lidar.serial,
                channels=sensor.lidar.channels,
                returns=sensor.lidar.returns,
                streams=tuple(str(streams[number]) for number in sorted(sensor.streams)),
                calibration=Path(sensor.lidar.calibration).name,
                extrinsics=sensor.pose.body_from_sensor.copy() if sensor.pose.is_known else None,
                extrinsics_source=sensor.pose.describe() if sensor.pose.is_known else "",
            )
            for sensor in found.sensors
        }

    @property
    def paths(self) -> tuple[Path, ...]:
        """The recordings."""
        return self.job.recordings

    def _discover(self) -> Discovery:
        require_library()
        table = StreamTable()
        opened = open_inputs(self.job.recordings, table, self.job.selection.rig)
        return discover(opened, table, replace(self.job.selection, identity_extrinsics=True))

    # -- description --------------------------------------------------------------------------

    @property
    def duration_s(self) -> float:
        """Time between the first and the last packet by the capture host, s; reads all files."""
        if self._duration_s is None:
            first_ns: int | None = None
            last_ns = 0
            with contextlib.closing(merge(self._discover().recordings)) as batches:
                for batch in batches:
                    if len(batch):
                        first_ns = int(batch.host_ns[0]) if first_ns is None else first_ns
                        last_ns = int(batch.host_ns[-1])
            self._duration_s = 0.0 if first_ns is None else (last_ns - first_ns) / NS_PER_S
        return self._duration_s

    def __repr__(self) -> str:
        """Names of files and sensors, in a line."""
        files = ", ".join(path.name for path in self.paths)
        return f"<Recording {files}: {', '.join(self.sensors) or 'no sensor'}>"

    def __str__(self) -> str:
        """Files, duration, and a table of the sensors.

        The duration of recordings over 256 MB is shown once `duration_s` has measured it.
        """
        if self._duration_s is None and self.size_bytes > _MEASURED_BYTES:
            duration = "duration_s not measured yet"
        else:
            duration = f"{self.duration_s:.3f} s"
        files = ", ".join(map(str, self.paths))
        kinds = ", ".join(dict.fromkeys(self.containers))
        rows = [("sensor", "model", "mode", "streams", "calibration", "extrinsics")]
        for one in self.sensors.values():
            source = one.extrinsics_source or "unknown"
            streams = ", ".join(one.streams)
            rows.append((one.name, one.model, one.mode, streams, one.calibration, source))
        widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
        lines = [f"{files}: {kinds}, {self.size_bytes / 1e6:.1f} MB, {duration}"]
        for row in rows:
            cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            lines.append("  ".join(cells).rstrip())
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return preformatted(self)

    # -- scans --------------------------------------------------------------------------------

    @documented(WindowOptions)
    def scans(self, rate: Rate | None = None, **options: Unpack[WindowOptions]) -> Iterator[Scan]:
        """Yield the scans that `convert` would write, each with arrays of its own.

        Options are those of `mlbatch convert`; start, end: ns of the common clock, or a
        text (ISO time, epoch seconds, "+5s" after the first scan). Raises MlbatchError where the
        command ends with an error, at the latest after the last scan.
        """
        check_names("Recording.scans", options, WindowOptions)
        return scans_of(window_job(self.job, {**options, "rate": rate}))

    def __iter__(self) -> Iterator[Scan]:
        """All scans, at the rate of the rig, else at 10 Hz."""
        return self.scans()

    def __len__(self) -> int:
        """Number of scans; the recording is read once, and nothing is decoded."""
        if self._scans is None:
            whole = _Pass(self.job)
            whole.scan(sys.maxsize)
            self._scans = whole.next
        return self._scans

    def __bool__(self) -> bool:
        """True, without reading the recording."""
        return True

    @overload
    def __getitem__(self, index: SupportsIndex) -> Scan: ...

    @overload
    def __getitem__(self, index: slice) -> list[Scan]: ...

    def __getitem__(self, index: SupportsIndex | slice) -> Scan | list[Scan]:
        """A scan by its number in `scans()`, or those of a slice.

        Higher numbers than the last continue where that was read; for others the recording is read
        from its start. Negative numbers and slices need `len`. IndexError without such a scan.
        """
        if isinstance(index, slice):
            numbers = range(len(self))[index]
            found = {number: self[number] for number in sorted(numbers)}
            return [found[number] for number in numbers]
        number = whole_number(index)
        number = number if number >= 0 else number + len(self)
        scan = self._scan(number) if number >= 0 else None
        if scan is None:
            raise IndexError(f"scan {whole_number(index)}: no such scan in {self!r}")
        return scan

    def _scan(self, number: int) -> Scan | None:
        # File positions are shared with a forked process.
        current = self._pass
        if current is None or number < current.next or current.process != os.getpid():
            current = self._pass = _Pass(self.job)
        return current.scan(number)

    def __getstate__(self) -> dict[str, object]:
        """All but the open files."""
        return {**self.__dict__, "_pass": None}

    def at(self, moment: Moment, rate: Rate | None = None) -> Scan:
        """The scan whose window contains a time; the recording is read up to it.

        moment: as `start` of `scans`. Raises RecordingError if there is no such scan.
        """
        limit, is_date = time_limit("at", moment)
        if limit is None:
            raise UsageError("at: expected a time, found None; give ns or an ISO time")
        job = window_job(self.job, {"rate": rate})
        grid = Grid(job.rate or self._rate)
        if limit.from_t_init:
            # The only window of two that contains the time is not known before t_init is.
            first = Limit(max(0, limit.ns - grid.bound(1)), from_t_init=True)
        else:
            first = Limit(grid.floor_bound(limit.ns))
        end = Limit(limit.ns + 1, limit.from_t_init)
        limited = replace(job, start=first, end=end, limits_are_dates=is_date)
        found = _last_of(limited)
        time_ns = limit.ns
        if found is not None and limit.from_t_init:
            time_ns += grid.bound(grid.index_of(found.start_ns) - found.index)
        if found is None or not found.start_ns <= time_ns < found.end_ns:
            raise RecordingError(
                f"{self!r}: expected a scan at {moment!r}, found none; see the times in rec.table()"
            )
        return found

    def table(self, rate: Rate | None = None) -> Rows:
        """scans.csv of a run as an array of rows; reads and decodes all, keeps no scan.

        `pandas.DataFrame(rec.table())` is a table of pandas. Empty cells: -1, or NaN.
        """
        run = Conversion(window_job(self.job, {"rate": rate}))
        for _ in run.scans():
            pass
        if run.table is None:
            raise RecordingError(f"{self!r}: expected a table of scans, found none; please report")
        return read_table(run.table.text(), "scans.csv")

    # -- packets ------------------------------------------------------------------------------

    def packets(self, sensor: str) -> Iterator[RawPacket]:
        """Yield the lidar packets of a sensor in receive order, as they are.

        Not included: packets of another size, and IMU packets.
        """
        number = self._number(sensor)
        session = Session(self._without_poses())
        lidar = session.sensors[number].lidar
        size = lidar.packet_size
        streams = session.setup.sampler.table.streams
        with contextlib.closing(session.packets()) as batches:
            for batch in batches:
                owner = session.setup.router.owners(batch)
                # Some sources append a byte, which the lidar does not send.
                is_lidar = (batch.size == size) | (batch.size == size + 1)
                rows = np.flatnonzero((owner == number) & is_lidar)
                for row in rows.tolist():
                    begin = int(batch.start[row])
                    data = batch.data[begin : begin + int(batch.size[row])].tobytes()
                    stream = streams[int(batch.stream[row])]
                    yield RawPacket(int(batch.host_ns[row]), data, str(stream))

    def imu(self, sensor: str) -> Iterator[ImuSamples]:
        """Yield the samples of a sensor's own IMU packets, some at a time, in its IMU frame.

        Timestamps are on the clock of the scans; duplicates are left out.
        """
        number = self._number(sensor)
        session = Session(self._without_poses())
        ingest: Ingest = session.ingest
        offset_ns = session.sensors[number].clock.imu_offset_ns
        with contextlib.closing(session.packets()) as batches:
            for batch in batches:
                session.keep_from(None)
                for samples in ingest.columns(batch).imu:
                    if samples.sensor == number and len(samples.stamp_ns):
                        samples.stamp_ns = samples.stamp_ns + offset_ns
                        yield samples

    def _number(self, sensor: str) -> int:
        names = list(self.sensors)
        if sensor not in names:
            raise UsageError(
                f"sensor: expected one of {', '.join(names) or 'none'}, found {sensor!r}; "
                "choose one"
            )
        return names.index(sensor)

    def _without_poses(self) -> Job:
        """The job, for what needs no extrinsics."""
        selection = replace(self.job.selection, identity_extrinsics=True)
        return replace(self.job, selection=selection)


class _Pass:
    """A pass over the scans of a job, of which some are decoded; next: number of the next scan."""

    def __init__(self, job: Job) -> None:
        self.process = os.getpid()
        self.next = 0
        self._run = Conversion(replace(job, checks_poses=False))
        self._tasks = self._run.tasks()

    def scan(self, number: int) -> Scan | None:
        """The scan with a number from `next` on; None after the last."""
        for task in self._tasks:
            if isinstance(task, SkippedWindow):
                continue
            self.next += 1
            if self.next > number:
                return Scan.copied(self._run.pool.workers[0].decode(task).scan)
            task.is_decoded = True
        return None


def scans_of(job: Job, warn: Callable[[Note], None] | None = None) -> Iterator[Scan]:
    """Yield the scans of a job, each with arrays of its own; the first 10 s are read at once.

    warn: called with each warning, after the last scan.
    """
    return _copied(Conversion(job), warn)


def _copied(run: Conversion, warn: Callable[[Note], None] | None) -> Iterator[Scan]:
    for scan, only in run.scans():
        found = Scan.copied(scan)
        if only is not None:
            found.sensor = found.sensors[only]
        yield found
    if warn is not None:
        for note in run.notes:
            warn(note)


def _last_of(job: Job) -> Scan | None:
    """The last scan of a job; None without a scan."""
    found = None
    try:
        for scan in scans_of(job):
            found = scan
    except NoScanError:
        return None
    return found
