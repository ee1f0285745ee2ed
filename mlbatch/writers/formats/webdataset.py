"""A folder of tar files as WebDataset reads: of each scan an npz and a JSON (docs/formats.md).

Source: https://github.com/webdataset/webdataset, tariterators.py: files of a sample follow each
other, and its key is their name up to the first dot. Headers are ustar (POSIX.1-1988) by `tarfile`.
A file has the scans of `WINDOWS_PER_FILE` windows: by their number, so that runs that make a part
of an output cut at the same places.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tarfile import BLOCKSIZE, NUL, RECORDSIZE, USTAR_FORMAT, TarInfo
from typing import NamedTuple

from isal.isal_zlib import crc32

from mlbatch.types import EXTRAS, RunInfo, Scan, Summary
from mlbatch.writers.atomic import export_errors
from mlbatch.writers.base import CHECKSUMS, ScanJob, ScanWriter, WriterOptions, fixed
from mlbatch.writers.npz_encoder import NpzEncoder
from mlbatch.writers.output_file import Bytes, OutputFile, take_scratch
from mlbatch.writers.scan_folder import FolderWriter, name_of_windows, scan_name

FORMAT = "webdataset"
SUFFIX: str | None = None
COMPRESSES = False
FILE_SUFFIXES = ("tar",)
WINDOWS_PER_FILE = 500
extras = fixed(EXTRAS)


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of tar files."""
    return TarWriter(target, info, options)


class TarWriter(FolderWriter):
    """Writes the scans of several windows to a file."""

    def __init__(self, target: Path, info: RunInfo, options: WriterOptions) -> None:
        self._split = options.split
        self.new_encoder = partial(NpzEncoder, info, split=options.split)
        self.idle: list[NpzEncoder] = []
        self._tars: dict[int | None, _Tar] = {}
        super().__init__(target, info, options, FORMAT, self.new_encoder)

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that writes a scan to the file of its window."""
        return _SampleJob(self, scan, sensor)

    def skip(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job of a scan in a file of another run, which ends the file before it."""
        return _SkippedJob(self, scan, sensor)

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Complete the last files, add scans.csv, and move the folder to its final path."""
        for sensor in list(self._tars):
            self._end(sensor)
        super().finish(summary, last)

    def abandon(self) -> None:
        """Close the incomplete files, and leave the folder to other runs."""
        for tar in self._tars.values():
            tar.file.close()
        super().abandon()

    def add(
        self, scan: Scan, sensor: int | None, files: Mapping[str, tuple[Sequence[Bytes], int]]
    ) -> None:
        """Append the files of a scan by suffix, with their CRC-32. In order."""
        path = self.end_before(scan.index, sensor)
        with export_errors(path):
            tar = self._tars.get(sensor)
            if tar is None:
                tar = self._tars[sensor] = _Tar(path, scan.index, OutputFile(path))
            key = scan_name(scan.index, scan.slice, scan.slices)
            for suffix, (parts, crc) in files.items():
                tar.add(f"{key}.{suffix}", parts, crc)

    def end_before(self, index: int, sensor: int | None) -> Path:
        """Complete the file before that of a window, whose path it returns. In order."""
        path = self._folders[sensor] / f"{name_of_windows(index, WINDOWS_PER_FILE)}.tar"
        if sensor in self._tars and self._tars[sensor].path != path:
            self._end(sensor)
        return path

    def about(self, scan: Scan) -> bytes:
        """Return a JSON object: cells of the scan in scans.csv, and the metadata of the run.

        fill is null where it is not known.
        """
        info = scan.info
        numbers = scan.column_lidar_id[:1].tolist() if self._split else range(len(info.sensors))
        fill = [None if math.isnan(one) else float(str(one)) for one in scan.fill]
        columns = {info.sensors[at].name: scan.columns_per_sensor[at] for at in numbers}
        found = {
            "index": scan.index,
            "slice": scan.slice,
            "start_ns": scan.start_ns,
            "end_ns": scan.end_ns,
            "points": scan.points,
            "columns": len(scan.column_stamp_ns),
            **{f"columns_{name}": count for name, count in columns.items()},
            "complete": bool(scan.complete),
            **{f"fill_{info.sensors[at].name}": fill[at] for at in numbers},
            "frame_id": info.frame_id,
            "rate_hz": info.rate_hz,
            "timescale": info.timescale,
        }
        return json.dumps(found).encode()

    def _end(self, sensor: int | None) -> None:
        tar = self._tars.pop(sensor)
        with export_errors(tar.path):
            tar.complete()
        if self._files is not None:
            name = tar.path.relative_to(self._output.partial).as_posix()
            self._files.made({name: tar.file.crc}, tar.window, 0, sensor)


class _Tar(NamedTuple):
    """A file under construction; window: one in it."""

    path: Path
    window: int
    file: OutputFile

    def add(self, name: str, parts: Sequence[Bytes], crc: int) -> None:
        """Append a file; the header has neither time nor user, so that equal runs are equal."""
        head = TarInfo(name)
        head.size = sum(map(len, parts))
        self.file.put(head.tobuf(USTAR_FORMAT))
        self.file.put(*parts, crc=crc)
        self.file.put(NUL * (-head.size % BLOCKSIZE))

    def complete(self) -> None:
        """Append the end: two blocks of zeros, and more up to a whole record."""
        self.file.put(NUL * 2 * BLOCKSIZE)
        self.file.put(NUL * (-self.file.position_bytes % RECORDSIZE))
        self.file.complete()


class _SampleJob(ScanJob):
    """Appends a scan to the file of its window."""

    def __init__(self, writer: TarWriter, scan: Scan, sensor: int | None) -> None:
        self._writer = writer
        self._scan = scan
        self._sensor = sensor
        self._files: dict[str, tuple[Sequence[Bytes], int]] = {}

    def pack(self) -> None:
        # Its buffers have the bytes until they are written.
        self._encoder = take_scratch(self._writer.idle, self._writer.new_encoder)
        contents: dict[str, Sequence[Bytes]] = {
            "npz": self._encoder.encode(self._scan),
            "json": [self._writer.about(self._scan)],
        }
        for suffix, parts in contents.items():
            crc = 0
            for part in parts:
                crc = crc32(part, crc)
            self._files[suffix] = parts, crc
        self.checksum = sum(crc for _, crc in self._files.values()) % CHECKSUMS

    def commit(self) -> None:
        self._writer.add(self._scan, self._sensor, self._files)
        self._writer.idle.append(self._encoder)


class _SkippedJob(ScanJob):
    """Ends the file before a scan that another run writes."""

    def __init__(self, writer: TarWriter, scan: Scan, sensor: int | None) -> None:
        self._writer = writer
        self._place = scan.index, sensor

    def commit(self) -> None:
        self._writer.end_before(*self._place)
