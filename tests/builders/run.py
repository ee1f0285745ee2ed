"""Whole conversions in-process: the command line, or the pipeline with a writer that remembers."""

from __future__ import annotations

import contextlib
import hashlib
import io
import sys
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import typer.main
from typer.core import TyperGroup

from mlbatch import readers
from mlbatch.arrays import BoolArray, F32Array, I64Array, U8Array, U16Array, U32Array
from mlbatch.cli import app, main
from mlbatch.cli.app import command_line
from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.run import convert
from mlbatch.readers import open_recording
from mlbatch.readers.capture.recording import CaptureRecording
from mlbatch.reports.report import RunReport
from mlbatch.types import (
    EXTRAS,
    IMU,
    ImuSamples,
    Message,
    Recording,
    RunInfo,
    Scan,
    StreamTable,
    Summary,
)
from mlbatch.writers import extras, open_writer
from mlbatch.writers.base import ScanJob, ScanWriter, WriterOptions

ROOT = Path(__file__).resolve().parents[2]
RECORDINGS = ROOT / ".." / "shared" / "recordings"
TWO_LIDARS = ROOT / "fixtures" / "two_lidars"
FOUR_MAKERS = ROOT / "fixtures" / "four_makers"

Arrays = dict[str, npt.NDArray[np.generic]]

# The two lidars of the fixture, head and tail included.
FIXTURE = Job(
    recordings=(TWO_LIDARS / "two_lidars.pcap",),
    selection=SensorSelection(rig=TWO_LIDARS / "rig.yaml"),
    keep_partial=True,
)
BY_HOST = replace(FIXTURE, selection=replace(FIXTURE.selection, host_clock=True))


@dataclass(frozen=True, slots=True)
class Outcome:
    """Exit code of a command, and what it printed."""

    code: int
    out: str
    err: str

    @property
    def warnings(self) -> list[str]:
        """Codes of the warnings on stderr."""
        mark = "mlbatch: warning: "
        lines = [line for line in self.err.splitlines() if line.startswith(mark)]
        return [line.removeprefix(mark).split(":")[0] for line in lines]


@cache
def _parser(first: str = "") -> TyperGroup:
    """In the place of `app.command_line`, which makes one for each command: that takes 10 ms."""
    made = typer.main.get_command(command_line(first))
    assert isinstance(made, TyperGroup)
    return made


def command(*words: str | Path, together: bool = False) -> Outcome:
    """Run `mlbatch` with these words in this process; together: both outputs are `out`."""
    out = io.StringIO()
    err = out if together else io.StringIO()
    before = sys.argv
    sys.argv = ["mlbatch", *map(str, words)]
    code: object = 0
    try:
        with (
            patch.object(app, "command_line", _parser),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            main()
    except SystemExit as leave:
        code = leave.code
    finally:
        sys.argv = before
    return Outcome(code if isinstance(code, int) else 0, out.getvalue(), err.getvalue())


@dataclass(slots=True)
class Memory:
    """A writer that keeps copies of all it is given."""

    info: RunInfo
    scans: list[tuple[Scan, int | None]] = field(default_factory=list)
    imu: list[ImuSamples] = field(default_factory=list)
    messages: list[Message] = field(default_factory=list)
    summary: Summary | None = None
    abandoned: bool = False

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Keep a scan."""
        return _Keep(self, scan, sensor)

    def keep(self, scan: Scan, sensor: int | None) -> None:
        """Copy a scan, in order."""
        self.scans.append((deepcopy(scan), sensor))

    def flush(self) -> ScanJob:
        """Nothing: all is kept at once."""
        return ScanJob()

    def write_imu(self, samples: ImuSamples) -> None:
        """Keep IMU samples."""
        self.imu.append(samples)

    def write_message(self, message: Message) -> None:
        """Keep recorded messages."""
        self.messages.append(message)

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Keep the end."""
        self.summary = summary
        if last is not None:
            last(Path())

    def abandon(self) -> None:
        """Remember that the run failed."""
        self.abandoned = True


@dataclass(slots=True)
class _Keep(ScanJob):
    memory: Memory
    scan: Scan
    sensor: int | None

    def append(self) -> None:
        self.memory.keep(self.scan, self.sensor)


@dataclass(frozen=True, slots=True)
class Result:
    """A conversion that ended well; `memory` is None where the output went to a file."""

    run: Conversion
    report: RunReport
    memory: Memory | None = None

    @property
    def scans(self) -> list[Scan]:
        """The scans of a run in memory."""
        return [] if self.memory is None else [scan for scan, _ in self.memory.scans]


def in_memory(job: Job) -> Result:
    """Convert and keep everything."""
    kept: list[Memory] = []

    def start(info: RunInfo) -> ScanWriter:
        kept.append(Memory(info))
        return kept[0]

    run, report = convert(replace(job, extras=EXTRAS | {IMU}), start)
    return Result(run, report, kept[0])


def to_file(job: Job, target: Path, name: str) -> Result:
    """Convert to the format called `name`."""
    options = WriterOptions(split=job.split)

    def start(info: RunInfo) -> ScanWriter:
        return open_writer(name, target, info, options)

    return Result(*convert(replace(job, extras=extras(name, options)), start))


Values = tuple[str | int | bool | tuple[int, ...], ...]


def print_of(scan: Scan) -> Values:
    """All of a scan but the receive time of the packet that closed it; arrays as digests."""
    values: list[str | int | bool | tuple[int, ...]] = []
    for part in fields(scan):
        value = getattr(scan, part.name)
        if part.name not in ("info", "ready_host_ns"):
            values.append(digest(value) if isinstance(value, np.ndarray) else value)
    return tuple(values)


def prints(result: Result) -> list[Values]:
    """All that identity covers, of a run in memory."""
    assert result.memory is not None
    assert result.memory.summary is not None
    table = csv_without_arrival(result.memory.summary.scans_csv)
    samples = sorted(
        (imu.sensor, stamp_ns, digest(imu.acceleration[row]), digest(imu.angular_velocity[row]))
        for imu in result.memory.imu
        for row, stamp_ns in enumerate(imu.stamp_ns.tolist())
    )
    return [(repr(result.memory.info),), *map(print_of, result.scans), *samples, (table,)]


def csv_without_arrival(text: str) -> str:
    """scans.csv without `ready_host_ns`, the one column that depends on arrival."""
    rows = [line.rsplit(",", 1) for line in text.splitlines()]
    assert rows[0][1] == "ready_host_ns"
    return "".join(f"{row[0]}\n" for row in rows)


@contextlib.contextmanager
def buffers_of(size: int) -> Iterator[None]:
    """Recordings are read through buffers of `size` bytes."""

    def opened(path: Path, streams: StreamTable) -> Recording:
        recording = open_recording(path, streams)
        if isinstance(recording, CaptureRecording):
            recording.buffer_bytes = size
        return recording

    with patch.object(readers, "open_recording", opened):
        yield


# -- content of a folder of npz files -------------------------------------------------------------


def scan_files(folder: Path) -> list[Path]:
    """Files of a run in the order of time: the head, then by index and slice."""
    return sorted(folder.glob("*.npz"), key=_when)


def _when(path: Path) -> tuple[int, int]:
    index, _, part = path.stem.partition("-")
    return -1 if index == "head" else int(index), int(part or 0)


def load(path: Path) -> Arrays:
    """All arrays of an npz; pickles are refused."""
    with np.load(path, allow_pickle=False) as archive:
        return {key: archive[key] for key in archive.files}


def digest(array: npt.NDArray[np.generic]) -> str:
    """SHA-256 of type, shape and values."""
    head = f"{array.dtype.str} {array.shape} ".encode()
    return hashlib.sha256(head + np.ascontiguousarray(array).tobytes()).hexdigest()


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points and columns of one or several dense scans, typed.

    (p,) each, but xyz (p, 3); stamp_ns: int64, of the point's column; at_ns: int64, of the point;
    reflectivity: None where the run has none; column_stamp_ns, column_lidar_id: (n,).
    """

    xyz: F32Array
    intensity: F32Array
    reflectivity: U16Array | None
    range_m: F32Array
    stamp_ns: I64Array
    at_ns: I64Array
    ring: U16Array
    return_type: U8Array
    lidar_id: U8Array
    column: U32Array
    column_stamp_ns: I64Array
    column_lidar_id: U8Array

    @classmethod
    def of(cls, path: Path) -> Cloud:
        """The scan in one npz file."""
        with np.load(path, allow_pickle=False) as npz:
            stamps = npz["column_stamp_ns"]
            return cls(
                xyz=npz["xyz"],
                intensity=npz["intensity"],
                reflectivity=npz["reflectivity"] if "reflectivity" in npz.files else None,
                range_m=npz["range_m"],
                stamp_ns=stamps[npz["column"]],
                at_ns=npz["time_ns"].astype(np.int64) + npz["start_ns"],
                ring=npz["ring"],
                return_type=npz["return_type"],
                lidar_id=npz["lidar_id"],
                column=npz["column"],
                column_stamp_ns=stamps,
                column_lidar_id=npz["column_lidar_id"],
            )

    @classmethod
    def of_all(cls, folder: Path) -> Cloud:
        """All scans of a folder, one after the other; `column` counts through."""
        clouds = [cls.of(path) for path in scan_files(folder)]
        first = np.cumsum([0, *(len(cloud.column_stamp_ns) for cloud in clouds)])
        parts = [
            replace(cloud, column=(cloud.column + base).astype(np.uint32))
            for cloud, base in zip(clouds, first[:-1].tolist(), strict=True)
        ]
        names = [part.name for part in fields(cls)]
        joined = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in names
            if getattr(parts[0], name) is not None
        }
        return replace(parts[0], **joined)

    def of_sensor(self, lidar_id: int) -> Cloud:
        """Points and columns of one sensor; `column` keeps its numbers."""
        points: BoolArray = self.lidar_id == lidar_id
        columns: BoolArray = self.column_lidar_id == lidar_id
        chosen = {
            part.name: value[columns if part.name.startswith("column_") else points]
            for part in fields(self)
            if (value := getattr(self, part.name)) is not None
        }
        return replace(self, **chosen)
