"""Output folders with one file a scan: names, scans.csv and the move at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from mlbatch.errors import ExportError, UsageError
from mlbatch.types import ImuSamples, Message, RunInfo, Scan, Summary
from mlbatch.writers.atomic import SCANS_CSV, export_errors, prepare
from mlbatch.writers.base import (
    CHECKSUMS,
    DEFAULT_POINT_LAYOUT,
    Checkpoint,
    ScanJob,
    WriterOptions,
)
from mlbatch.writers.output_file import (
    Bytes,
    WriteBehind,
    borrow,
    changed_bytes,
    drop_from_cache,
    file_crc,
    write_summed,
)


class Encoder(Protocol):
    """Encoder of one format; owns scratch, so each thread needs its own."""

    def encode(self, scan: Scan) -> Sequence[Bytes]:
        """Return the file of a scan in parts, valid until the next call."""
        ...


def scan_name(index: int, slice_: int, slices: int) -> str:
    """Return the file name of a scan without suffix: `000042`, slice `000042-3`, head `head`."""
    stem = "head" if index < 0 else f"{index:06d}"
    return stem if slices == 1 else f"{stem}-{slice_}"


def check_dense(name: str, info: RunInfo) -> None:
    """Refuse organized scans; name: of a format without them."""
    if info.layout == "organized":
        raise UsageError(
            f"--layout organized: expected dense for {name}, found organized; write npz or mcap"
        )


def checksum_of(paths: Iterable[Path]) -> int:
    """Return the checksum of a scan from its files, see `ScanJob`; ExportError for other files."""
    crcs = []
    for path in paths:
        with export_errors(path):
            crcs.append(file_crc(path))
    return sum(crcs) % CHECKSUMS


@dataclass(frozen=True, slots=True)
class Entry:
    """A file of a scan; `key` sorts as the names of files: the head is last."""

    key: tuple[bool, int, int]  # is the head, index, slice
    start_ns: int


class FolderWriter:
    """Writes each scan to a file of its own."""

    def __init__(
        self,
        target: Path,
        info: RunInfo,
        options: WriterOptions,
        name: str,
        encoder: Callable[[], Encoder],
        *,
        suffix: str = "",
        others: Mapping[str, Callable[[], Encoder]] | None = None,
        lists: Mapping[str, Callable[[Sequence[Entry]], str]] | None = None,
    ) -> None:
        """name: of the format; encoder: creates one for a thread.

        suffix: of the file of a scan, without a dot; "": the name. others: encoders of further
        files of a scan, by suffix. lists: further files of a folder, by name; their text is made
        of its scans in the order of their names.
        """
        if options.point_layout != DEFAULT_POINT_LAYOUT:
            raise UsageError(
                f"--point-layout: expected {DEFAULT_POINT_LAYOUT} for {name}, found "
                f"{options.point_layout}; write a .mcap, since presets are fields of PointCloud2"
            )
        keep = options.kept_bytes is not None
        self._output = prepare(
            target, options.overwrite, folder=True, keep=keep, fsync=options.fsync
        )
        self._encoders = {suffix or name: encoder, **(others or {})}
        self._idle: dict[str, list[Encoder]] = {suffix: [] for suffix in self._encoders}
        self._lists = dict(lists or {})
        self._entries: dict[int | None, list[Entry]] = {}
        self._committed = 0
        self._behind = WriteBehind()
        self._folders: dict[int | None, Path] = {None: self._output.partial}
        if options.split:
            self._folders |= self._sensor_folders(info)

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that writes a scan to a file of its own."""
        return _SaveJob(self, scan, self._paths(scan, sensor))

    def skip(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that keeps the file of a scan."""
        return _KeepJob(self, self._paths(scan, sensor))

    def pass_over(self, scan: Scan) -> ScanJob:
        """Return the job of a scan that another shard writes: it has no file here."""
        return _KeepJob(self, {})

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
        """Add lists and scans.csv, and move the folder to its final path."""
        for sensor, entries in self._entries.items():
            entries.sort(key=lambda entry: entry.key)
            for name, text in self._lists.items():
                path = self._folders[sensor] / name
                with export_errors(path):
                    path.write_text(text(entries), encoding="utf-8", newline="\n")
        path = self._output.partial / SCANS_CSV
        with export_errors(path):
            path.write_text(summary.scans_csv, encoding="utf-8", newline="\n")
        self.finish_part(last)

    def finish_part(self, last: Callable[[Path], None] | None = None) -> None:
        """Move the folder to its final path with the files of scans alone; last: as in `finish`."""
        self._output.sync()
        if last is not None:
            last(self._output.partial)
        self._output.publish()

    def abandon(self) -> None:
        """Do nothing: no file is open between jobs."""

    def save(self, scan: Scan, paths: Mapping[str, Path]) -> tuple[dict[Path, int], int]:
        """Write the files of a scan; returns their sizes in bytes and checksum. Any thread."""
        sizes = {}
        crcs = []
        for suffix, path in paths.items():
            idle = self._idle[suffix]
            encoder = borrow(idle, self._encoders[suffix])
            with export_errors(path), path.open("wb", buffering=0) as file:
                crcs.append(write_summed(file, encoder.encode(scan)))
                sizes[path] = file.tell()
                drop_from_cache(file.fileno(), 0, sizes[path])
            idle.append(encoder)
        return sizes, sum(crcs) % CHECKSUMS

    def count(self, sizes: Mapping[Path, int]) -> None:
        """Count the files of a scan as complete; sizes: bytes to drop from the cache. In order."""
        self._committed += 1
        for path, size in sizes.items():
            self._behind.add(path, size)

    def _paths(self, scan: Scan, sensor: int | None) -> dict[str, Path]:
        """Return the files of a scan by suffix, and note it for the lists."""
        if self._lists:
            key = (scan.index < 0, scan.index, scan.slice)
            self._entries.setdefault(sensor, []).append(Entry(key, scan.start_ns))
        return self.files(scan, sensor)

    @property
    def bag_files(self) -> int:
        """Return 0: every scan has files of its own."""
        return 0

    @property
    def checksums(self) -> dict[str, int]:
        """Return nothing: no file has several scans."""
        return {}

    @property
    def folder(self) -> Path:
        """The folder under construction."""
        return self._output.partial

    def files(self, scan: Scan, sensor: int | None) -> dict[str, Path]:
        """Return the files of a scan by suffix, in the folder under construction."""
        stem = scan_name(scan.index, scan.slice, scan.slices)
        folder = self._folders[sensor]
        return {suffix: folder / f"{stem}.{suffix}" for suffix in self._encoders}

    def _sensor_folders(self, info: RunInfo) -> dict[int | None, Path]:
        folders: dict[int | None, Path] = {}
        for number, sensor in enumerate(info.sensors):
            folder = self._output.partial / sensor.name
            with export_errors(folder):
                folder.mkdir(exist_ok=True)
            folders[number] = folder
        return folders


class _SaveJob(ScanJob):
    """Writes the files of one scan; scans are independent, so any thread may do all of it."""

    def __init__(self, writer: FolderWriter, scan: Scan, paths: Mapping[str, Path]) -> None:
        self._writer = writer
        self._scan = scan
        self._paths = paths
        self._sizes: dict[Path, int] = {}

    def pack(self) -> None:
        self._sizes, self.checksum = self._writer.save(self._scan, self._paths)

    def commit(self) -> None:
        self._writer.count(self._sizes)


class _KeepJob(ScanJob):
    """Keeps the files of one scan that the interrupted run has written."""

    def __init__(self, writer: FolderWriter, paths: Mapping[str, Path]) -> None:
        self._writer = writer
        self._paths = paths

    def pack(self) -> None:
        paths = list(self._paths.values())
        # Of those that are missing `commit` says so.
        if self.checksum is None or not all(path.is_file() for path in paths):
            return
        if checksum_of(paths) != self.checksum:
            raise changed_bytes(paths[0])

    def commit(self) -> None:
        for path in self._paths.values():
            if not path.is_file():
                raise ExportError(
                    f"{path}: expected a scan of the interrupted run, found no file; leave out "
                    "--resume to start over"
                )
        self._writer.count({})
