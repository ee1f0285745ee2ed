"""Output folders with one file per scan: records, names, scans.csv, the move at the end."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

import mlbatch
from mlbatch.errors import UsageError, one_line
from mlbatch.types import RunInfo, Scan, Summary
from mlbatch.units import NS_PER_S
from mlbatch.writers.atomic import SCANS_CSV, export_errors, prepare
from mlbatch.writers.base import (
    CHECKSUMS,
    DEFAULT_POINT_LAYOUT,
    FilesWriter,
    ScanJob,
    WriterOptions,
)
from mlbatch.writers.output_file import (
    Bytes,
    WriteBehind,
    drop_from_cache,
    take_scratch,
    write_summed,
)
from mlbatch.writers.point_layouts import Layout, ScanRecords, record_bytes

# Fields in the units of all formats with seconds after the start of the scan.
UNITS = "x y z m; time s after start_ns; intensity as sent by the sensor"


class RecordEncoder:
    """Encodes scans as the records of a layout."""

    def __init__(self, layout: Layout, head: Callable[..., bytes] | None = None) -> None:
        """head: of comments, width and, of organized scans, height; None: there is none."""
        self._records = ScanRecords(layout)
        self._head = head

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the header and all points; an organized scan has a row for each slot."""
        packed = self._records.of(scan)
        *height, width = packed.shape
        head = () if self._head is None else [self._head(scan_comments(scan), width, *height)]
        return [*head, record_bytes(packed)]


def scan_comments(scan: Scan, units: str = UNITS) -> list[str]:
    """Return the lines: a name and its value each; units: of the fields."""
    info = scan.info
    names = " ".join(sensor.name for sensor in info.sensors)
    return [
        f"mlbatch {mlbatch.__version__}",
        f"start_ns {scan.start_ns}",
        f"end_ns {scan.end_ns}",
        f"index {scan.index} slice {scan.slice} of {scan.slices}",
        f"complete {str(scan.complete).lower()}",
        f"fill {' '.join(map(_share, scan.fill.tolist()))}",
        f"sort {info.sort}",
        *(f"{name} {value}" for name, value in info.variants),
        f"timescale {info.timescale}",
        f"rate_hz {info.rate_hz}",
        # Frame names come from recordings and may contain line ends.
        f"frame_id {one_line(info.frame_id)}",
        f"units: {units}",
        f"lidar_id from 0: {names}",
    ]


def _share(fill: float) -> str:
    """Return a fill as text, as in scans.csv."""
    return "unknown" if math.isnan(fill) else str(np.float32(fill))


TIMES_TXT = "times.txt"


class Encoder(Protocol):
    """Encoder of one format; owns scratch, so each thread needs its own."""

    def encode(self, scan: Scan) -> Sequence[Bytes]:
        """Return the file of a scan in parts, valid until the next call."""
        ...


def scan_name(index: int, slice_: int, slices: int) -> str:
    """Return the file name of a scan without suffix: `000042`, slice `000042-3`, head `head`."""
    stem = "head" if index < 0 else f"{index:06d}"
    return stem if slices == 1 else f"{stem}-{slice_}"


def name_of_windows(index: int, windows: int) -> str:
    """Return the name of the file of so many windows that has this one: that of the first one.

    The head is in the first file.
    """
    return scan_name(max(index, 0) // windows * windows, 0, 1)


def check_dense(name: str, info: RunInfo) -> None:
    """Refuse organized scans; name: of a format without them."""
    if info.layout == "organized":
        raise UsageError(
            f"--layout organized: expected dense for {name}, found organized; write npz or mcap"
        )


class Written(NamedTuple):
    """A file as it was written."""

    size: int
    crc: int  # CRC-32


@dataclass(frozen=True, slots=True)
class Entry:
    """A file of a scan; `key` sorts as the names of files: the head is last."""

    key: tuple[bool, int, int]  # is the head, index, slice
    start_ns: int


def times_text(entries: Sequence[Entry]) -> str:
    """Return one line per scan: its start in seconds of the common clock, with 9 decimals."""
    return "".join(
        f"{entry.start_ns // NS_PER_S}.{entry.start_ns % NS_PER_S:09d}\n" for entry in entries
    )


class FolderWriter(FilesWriter):
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
        keep = options.files is not None and options.files.is_continued
        self._output = prepare(
            target, options.overwrite, folder=True, keep=keep, fsync=options.fsync
        )
        self._encoders = {suffix or name: encoder, **(others or {})}
        self._idle: dict[str, list[Encoder]] = {suffix: [] for suffix in self._encoders}
        self._lists = dict(lists or {})
        self._entries: dict[int | None, list[Entry]] = {}
        self._files = options.files
        self._behind = WriteBehind()
        self._only = options.only
        self._has_scan = False
        self._folders: dict[int | None, Path] = {None: self._output.partial}
        if options.split:
            self._folders |= self._sensor_folders(info)

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that writes a scan to a file of its own."""
        if self._only is not None and self._has_scan:
            folder, name = self._only.with_suffix(""), next(iter(self._encoders))
            raise UsageError(
                f"-o {self._only}: expected one scan for one file, found more; select one with "
                f"--start and --end, or give -o {folder} --format {name} for a file of each"
            )
        self._has_scan = True
        return _SaveJob(self, scan, sensor, self._paths(scan, sensor))

    def skip(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return a job without work: another run has made the file, or makes it."""
        self._paths(scan, sensor)
        return ScanJob()

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
        self._output.sync()
        if last is not None:
            last(self._output.partial)
        self._output.publish()

    def abandon(self) -> None:
        """Leave the folder under construction to other runs."""
        self._output.close()

    def save(self, scan: Scan, paths: Mapping[str, Path]) -> dict[Path, Written]:
        """Write the files of a scan. Any thread."""
        written = {}
        for suffix, path in paths.items():
            idle = self._idle[suffix]
            encoder = take_scratch(idle, self._encoders[suffix])
            with export_errors(path), path.open("wb", buffering=0) as file:
                crc = write_summed(file, encoder.encode(scan))
                written[path] = Written(file.tell(), crc)
                drop_from_cache(file.fileno(), 0, written[path].size)
            idle.append(encoder)
        return written

    def made(self, scan: Scan, sensor: int | None, written: Mapping[Path, Written]) -> None:
        """Note the files of a scan, which are whole. In order."""
        for path, file in written.items():
            self._behind.add(path, file.size)
        if self._files is not None:
            folder = self._output.partial
            crcs = {path.relative_to(folder).as_posix(): file.crc for path, file in written.items()}
            self._files.made(crcs, scan.index, scan.slice, sensor)

    def _paths(self, scan: Scan, sensor: int | None) -> dict[str, Path]:
        """Return the files of a scan by suffix, and note it for the lists."""
        if self._lists:
            key = (scan.index < 0, scan.index, scan.slice)
            self._entries.setdefault(sensor, []).append(Entry(key, scan.start_ns))
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

    def __init__(
        self, writer: FolderWriter, scan: Scan, sensor: int | None, paths: Mapping[str, Path]
    ) -> None:
        self._writer = writer
        self._scan = scan
        self._sensor = sensor
        self._paths = paths
        self._written: Mapping[Path, Written] = {}

    def pack(self) -> None:
        self._written = self._writer.save(self._scan, self._paths)
        self.checksum = sum(file.crc for file in self._written.values()) % CHECKSUMS

    def commit(self) -> None:
        self._writer.made(self._scan, self._sensor, self._written)
