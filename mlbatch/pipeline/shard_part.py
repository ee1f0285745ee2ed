"""The folder that a shard writes: its scans and shard.json, neither report.json nor scans.csv.

Scans are in files of their own, or in files of a bag.

shard.json has the account of the whole recording, which every shard makes, with the points of the
shard's own scans alone. From those of all shards the report and the table of scans follow.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

import mlbatch
from mlbatch.bounded import parse_json, read_text
from mlbatch.errors import RecordingError, UsageError
from mlbatch.pipeline.job_identity import identity_of_parts
from mlbatch.pipeline.resume import ResumeLog
from mlbatch.pipeline.shards import Shard
from mlbatch.report.json_records import from_json, to_json
from mlbatch.report.report import RunReport
from mlbatch.types import ImuSamples, Message, RunInfo, Scan, Summary
from mlbatch.writers import (
    SHARD_JSON,
    Checkpoint,
    PartWriter,
    ScanJob,
    ScanWriter,
    WriterOptions,
    partial_path,
    write_text,
)

SCHEMA = "mlbatch.shard/3"


@dataclass(frozen=True, slots=True)
class ShardScan:
    """A scan of a shard; the fields are those of `Scan`, but these.

    number: among all scans of the recording; only: with `--split` the index of its sensor;
    stamps_ns: of the first and the last column, none without a column; checksum: see `ScanJob`.
    """

    number: int
    only: int | None
    index: int
    slice: int
    start_ns: int
    end_ns: int
    stamps_ns: tuple[int, ...]
    complete: bool
    ready_host_ns: int
    columns_per_sensor: tuple[int, ...]
    points_per_sensor: tuple[int, ...]
    max_gap_ns: tuple[int, ...]
    coverage: tuple[float, ...]
    overlap: tuple[float, ...]
    fill: tuple[float, ...]
    is_partial: bool
    checksum: int | None = None

    def scan(self, info: RunInfo) -> Scan:
        """The scan without its points."""
        nothing = np.zeros(0, np.uint8)
        return Scan(
            info=info,
            index=self.index,
            slice=self.slice,
            start_ns=self.start_ns,
            end_ns=self.end_ns,
            complete=self.complete,
            ready_host_ns=self.ready_host_ns,
            xyz=np.zeros((0, 3), np.float32),
            intensity=np.zeros(0, np.float32),
            reflectivity=None,
            range_m=None,
            time_ns=np.zeros(0, np.uint32),
            ring=np.zeros(0, np.uint16),
            return_type=nothing,
            lidar_id=nothing,
            column=None,
            column_stamp_ns=np.array(self.stamps_ns, np.int64),
            column_lidar_id=nothing,
            points=sum(self.points_per_sensor),
            columns_per_sensor=self.columns_per_sensor,
            points_per_sensor=self.points_per_sensor,
            max_gap_ns=self.max_gap_ns,
            coverage=self.coverage,
            overlap=self.overlap,
            fill=np.array(self.fill, np.float32),
            is_partial=self.is_partial,
        )


def _figures(scan: Scan, number: int, only: int | None) -> ShardScan:
    """What the account keeps of a scan."""
    stamps = scan.column_stamp_ns
    return ShardScan(
        number,
        only,
        scan.index,
        scan.slice,
        scan.start_ns,
        scan.end_ns,
        (int(stamps[0]), int(stamps[-1])) if len(stamps) else (),
        bool(scan.complete),
        int(scan.ready_host_ns),
        tuple(map(int, scan.columns_per_sensor)),
        tuple(map(int, scan.points_per_sensor)),
        tuple(map(int, scan.max_gap_ns)),
        tuple(map(float, scan.coverage)),
        tuple(map(float, scan.overlap)),
        tuple(scan.fill.tolist()),
        bool(scan.is_partial),
    )


@dataclass(frozen=True, slots=True)
class Account:
    """Content of shard.json.

    identity: what all shards share, see `identity_of_parts`; content: checksum of what was read;
    max_bag_s: as of `Job`; notes_before_points: warnings of the report that precede those about
    points; total: number of scans of all shards; bag_files: of the files of a bag, 0 where scans
    have files of their own; figures: digest of all scans, without points; scans: of this shard;
    files: of this shard, bytes by path in the folder; checksums: CRC-32 of files of several scans.
    """

    shard: Shard
    identity: dict[str, str]
    content: int
    format: str
    ply_style: str
    is_split: bool
    is_strict: bool
    max_bag_s: float
    columns_per_s: tuple[float | None, ...]
    notes_before_points: int
    info: RunInfo
    report: RunReport
    total: int
    bag_files: int
    figures: str
    scans: tuple[ShardScan, ...]
    files: dict[str, int]
    checksums: dict[str, int]

    def shared(self) -> dict[str, Any]:
        """What must be the same in the accounts of all shards, as JSON values."""
        found = _fields(to_json(replace(self, scans=())))
        for name in ("shard", "scans", "files", "checksums"):
            del found[name]
        report = found["report"]
        for name in ("timing", "command"):
            del report[name]
        for one in report["inputs"]:
            one["path"] = Path(one["path"]).name
        for sensor in report["sensors"]:
            del sensor["ledger"]["points"]
        for name in ("points", "no_points", "empty_clouds"):
            del report["scans"][name]
        return found


# -- writing ----------------------------------------------------------------------------------


@dataclass(slots=True)
class ShardWriter:
    """Writes the scans of one shard to a folder, and notes them; see `ScanWriter`.

    info: of the run; total: number of scans of all shards; scans: of this one.
    """

    inner: PartWriter
    shard: Shard
    info: RunInfo
    total: int = 0
    scans: list[ShardScan] = field(default_factory=list)
    _digest: hashlib._Hash = field(default_factory=hashlib.sha256)

    @property
    def figures(self) -> str:
        """Digest of the figures of all scans."""
        return self._digest.hexdigest()

    def has(self, scan: Scan) -> bool:
        """Whether a scan is of this shard."""
        return self.shard.has(scan.index, scan.slice, scan.slices)

    def note(self, scan: Scan, sensor: int | None, checksum: int | None) -> None:
        """Note the next scan, of any shard."""
        figures = _figures(scan, self.total, sensor)
        # Points of other shards are unknown.
        known = to_json(replace(figures, points_per_sensor=()))
        self._digest.update(json.dumps(known).encode())
        self.total += 1
        if self.has(scan):
            self.scans.append(replace(figures, checksum=checksum))

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that writes a scan, or only notes another shard's."""
        return _NotedJob(self, scan, sensor, self.inner.write)

    def skip(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that keeps the files of a scan, or only notes another shard's."""
        return _NotedJob(self, scan, sensor, self.inner.skip)

    def flush(self) -> ScanJob:
        """Return the job of the folder."""
        return self.inner.flush()

    def checkpoint(self) -> Checkpoint:
        """Return the scans whose files are closed, and those of others before them."""
        return self.inner.checkpoint()

    def write_imu(self, samples: ImuSamples) -> None:
        """Write IMU samples if they are in a file of this shard."""
        self.inner.write_imu(samples)

    def write_message(self, message: Message) -> None:
        """Forward a recorded message if it is in a file of this shard."""
        self.inner.write_message(message)

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Move the folder to its final path, without a table of scans."""
        self.inner.finish_part(last)

    def abandon(self) -> None:
        """Close what is open."""
        self.inner.abandon()


Start = Callable[[Scan, int | None], ScanJob]


class _NotedJob(ScanJob):
    """Notes a scan, in order; has it written by another job if it is of this shard."""

    def __init__(self, writer: ShardWriter, scan: Scan, sensor: int | None, start: Start) -> None:
        self._writer = writer
        self._scan = scan
        self._sensor = sensor
        is_own = writer.has(scan)
        self._job = start(scan, sensor) if is_own else writer.inner.pass_over(scan)

    def pack(self) -> None:
        self._job.checksum = self.checksum
        self._job.pack()
        self.checksum = self._job.checksum

    def start(self, index: int) -> None:
        self._job.start(index)

    def append(self) -> None:
        self._writer.note(self._scan, self._sensor, self.checksum)
        self._job.append()

    def compress(self) -> None:
        self._job.compress()

    def commit(self) -> None:
        self._job.commit()


def _not_a_folder(name: str) -> str:
    if name == "rosbag2":
        return (
            "--shard: expected --max-bag-duration for rosbag2, since a shard writes whole files of "
            "the bag, found none; give --max-bag-duration 60"
        )
    return (
        f"--shard: expected a format with several files (npz, ply, pcd, las, laz, kitti, nuscenes; "
        f"rosbag2 with --max-bag-duration), found {name}, one file for all scans; give --format "
        "npz and a folder, or --format rosbag2 --max-bag-duration 60"
    )


def check_format(name: str, suffix: str | None, max_bag_s: float) -> None:
    """Raise UsageError for a format whose scans are in one file; suffix: of that file."""
    if suffix is not None or (name == "rosbag2" and not max_bag_s):
        raise UsageError(_not_a_folder(name))


class ShardOutput:
    """The output of a shard: its writer, and what `convert` calls last.

    account: content of shard.json, once it is written.
    """

    def __init__(self, shard: Shard, name: str, options: WriterOptions, log: ResumeLog) -> None:
        """name: of the format; log: of the run."""
        self.account: Account | None = None
        self._shard = shard
        self._name = name
        self._options = options
        self._log = log
        self._writer: ShardWriter | None = None

    def around(self, writer: ScanWriter, info: RunInfo) -> ShardWriter:
        """Return the writer of this shard; UsageError for a format that shards cannot write."""
        if not isinstance(writer, PartWriter):
            writer.abandon()
            raise UsageError(_not_a_folder(self._name))
        shard = self._shard.of_bag(self._options.max_bag_s, Fraction(info.rate_hz))
        self._writer = ShardWriter(writer, shard, info)
        return self._writer

    def complete(self, report: RunReport, folder: Path) -> None:
        """Write shard.json into the folder of the shard."""
        run = self._log.run
        writer = self._writer
        if run is None or writer is None:
            return
        options = self._options
        self.account = Account(
            shard=writer.shard,
            identity=identity_of_parts(self._log.identity),
            content=self._log.content,
            format=self._name,
            ply_style=options.ply_style,
            is_split=options.split,
            is_strict=run.job.strict,
            max_bag_s=options.max_bag_s,
            columns_per_s=tuple(sensor.columns_per_s for sensor in run.sensors),
            notes_before_points=run.notes_before_points,
            info=writer.info,
            report=report,
            total=writer.total,
            bag_files=writer.inner.bag_files,
            figures=writer.figures,
            scans=tuple(writer.scans),
            files=_sizes(folder),
            checksums=writer.inner.checksums,
        )
        head = {"schema": SCHEMA, "version": mlbatch.__version__}
        text = json.dumps(head | _fields(to_json(self.account)), separators=(",", ":"))
        write_text(folder / SHARD_JSON, text + "\n", options.fsync)


def _sizes(folder: Path) -> dict[str, int]:
    """Bytes of all files in a folder, by their paths in it."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}


# -- reading ----------------------------------------------------------------------------------


def read_account(part: Path) -> Account:
    """The account of a shard; UsageError if there is none, RecordingError if it is damaged."""
    path = part / SHARD_JSON
    try:
        content = _fields(parse_json(read_text(path), has_nan=True))
    except FileNotFoundError:
        raise UsageError(f"{part}: expected the folder of a shard, found {_found(part)}") from None
    except NotADirectoryError:
        raise UsageError(
            f"{part}: expected the folder of a shard, found a file; name what convert --shard wrote"
        ) from None
    except OSError as err:
        raise RecordingError(
            f"{path}: expected a readable file, found {err.strerror!r}; check the disk"
        ) from err
    except ValueError as err:
        raise _damaged(path, str(err)) from err
    schema = content.pop("schema", None)
    version = content.pop("version", None)
    if schema != SCHEMA:
        raise UsageError(
            f"{path}: expected schema {SCHEMA}, found {schema!r}; name what convert --shard wrote"
        )
    if version != mlbatch.__version__:
        raise UsageError(
            f"{path}: expected a shard of mlbatch {mlbatch.__version__}, found one of "
            f"{version}; merge with that version, or convert again"
        )
    try:
        account: Account = from_json(Account, content)
    except (ValueError, TypeError) as err:
        raise _damaged(path, str(err)) from err
    return account


def _damaged(path: Path, why: str) -> RecordingError:
    return RecordingError(
        f"{path}: expected the account of a shard, found damaged content ({why}); convert this "
        "shard again with --overwrite"
    )


def _found(part: Path) -> str:
    partial = partial_path(part)
    if partial.exists():
        return f"that of an interrupted run ({partial.name}); run this shard again with --resume"
    if part.is_dir():
        return f"a folder without {SHARD_JSON}; name what convert --shard wrote"
    return "nothing; run the conversion of this shard, or check the name"


def _fields(found: object) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise ValueError("no JSON object")
    return found
