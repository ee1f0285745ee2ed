"""Output folders with one file a scan: names, scans.csv and the move at the end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from mlbatch.errors import ExportError, UsageError
from mlbatch.types import ImuSamples, Message, RunInfo, Scan, Summary
from mlbatch.writers.atomic import SCANS_CSV, export_errors, prepare
from mlbatch.writers.base import DEFAULT_POINT_LAYOUT, Checkpoint, ScanJob, WriterOptions
from mlbatch.writers.output_file import Bytes, WriteBehind, borrow, drop_from_cache, write_all


class Encoder(Protocol):
    """Encoder of one format; owns scratch, so each thread needs its own."""

    def encode(self, scan: Scan) -> Sequence[Bytes]:
        """Return the file of a scan in parts, valid until the next call."""
        ...


def scan_name(index: int, slice_: int, slices: int) -> str:
    """Return the file name of a scan without suffix: `000042`, slice `000042-3`, head `head`."""
    stem = "head" if index < 0 else f"{index:06d}"
    return stem if slices == 1 else f"{stem}-{slice_}"


class FolderWriter:
    """Writes each scan to a file of its own."""

    def __init__(
        self,
        target: Path,
        info: RunInfo,
        options: WriterOptions,
        name: str,
        encoder: Callable[[], Encoder],
    ) -> None:
        """name: of the format, the suffix of its files; encoder: creates one for a thread."""
        if options.point_layout != DEFAULT_POINT_LAYOUT:
            raise UsageError(
                f"--point-layout: expected {DEFAULT_POINT_LAYOUT} for {name}, found "
                f"{options.point_layout}; write a .mcap, since presets are fields of PointCloud2"
            )
        keep = options.kept_bytes is not None
        self._output = prepare(
            target, options.overwrite, folder=True, keep=keep, fsync=options.fsync
        )
        self._name = name
        self._encoder = encoder
        self._idle: list[Encoder] = []
        self._committed = 0
        self._behind = WriteBehind()
        self._folders: dict[int | None, Path] = {None: self._output.partial}
        if options.split:
            self._folders |= self._sensor_folders(info)

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that writes a scan to a file of its own."""
        return _SaveJob(self, scan, self._path(scan, sensor))

    def skip(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that keeps the file of a scan."""
        return _KeepJob(self, self._path(scan, sensor))

    def flush(self) -> ScanJob:
        """Return a job without work: only scans are written."""
        return ScanJob()

    def checkpoint(self) -> Checkpoint:
        """Return the scans whose files are closed."""
        return Checkpoint(self._committed)

    def write_imu(self, samples: ImuSamples) -> None:
        """Ignore IMU samples."""

    def write_message(self, message: Message) -> None:
        """Ignore messages."""

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Add scans.csv and move the folder to its final path."""
        path = self._output.partial / SCANS_CSV
        with export_errors(path):
            path.write_text(summary.scans_csv, encoding="utf-8", newline="\n")
        self._output.sync()
        if last is not None:
            last(self._output.partial)
        self._output.publish()

    def abandon(self) -> None:
        """Do nothing: no file is open between jobs."""

    def save(self, scan: Scan, path: Path) -> int:
        """Write the file of a scan; returns its size in bytes. Any thread."""
        encoder = borrow(self._idle, self._encoder)
        with export_errors(path), path.open("wb", buffering=0) as file:
            write_all(file, encoder.encode(scan))
            size = file.tell()
            drop_from_cache(file.fileno(), 0, size)
        self._idle.append(encoder)
        return size

    def count(self, path: Path, size: int) -> None:
        """Count the file of a scan as complete; size: bytes to drop from the cache. In order."""
        self._committed += 1
        if size:
            self._behind.add(path, size)

    def _path(self, scan: Scan, sensor: int | None) -> Path:
        stem = scan_name(scan.index, scan.slice, scan.slices)
        return self._folders[sensor] / f"{stem}.{self._name}"

    def _sensor_folders(self, info: RunInfo) -> dict[int | None, Path]:
        folders: dict[int | None, Path] = {}
        for number, sensor in enumerate(info.sensors):
            folder = self._output.partial / sensor.name
            with export_errors(folder):
                folder.mkdir(exist_ok=True)
            folders[number] = folder
        return folders


class _SaveJob(ScanJob):
    """Writes the file of one scan; files are independent, so any thread may do all of it."""

    def __init__(self, writer: FolderWriter, scan: Scan, path: Path) -> None:
        self._writer = writer
        self._scan = scan
        self._path = path
        self._size = 0

    def pack(self) -> None:
        self._size = self._writer.save(self._scan, self._path)

    def commit(self) -> None:
        self._writer.count(self._path, self._size)


class _KeepJob(ScanJob):
    """Keeps the file of one scan that the interrupted run has written."""

    def __init__(self, writer: FolderWriter, path: Path) -> None:
        self._writer = writer
        self._path = path

    def commit(self) -> None:
        if not self._path.is_file():
            raise ExportError(
                f"{self._path}: expected a scan of the interrupted run, found no file; leave out "
                "--resume to start over"
            )
        self._writer.count(self._path, 0)
