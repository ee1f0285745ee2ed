"""Folders of float32 rows: kitti and nuscenes. They have no header: the rest is in the report.

The format: docs/formats.md.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array
from mlbatch.bounded import read_text
from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.folders import ScanFile, ScanReader, scan_files
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.outputs.stored_scan import StoredScan, seconds_to_ns

KITTI_SUFFIX = ".bin"
NUSCENES_SUFFIX = ".pcd.bin"
TIME_SUFFIX = ".time.bin"
TIMES_TXT = "times.txt"
_TIME = re.compile(r"(\d{1,10})\.(\d{9})", re.ASCII)
_NS = 10**9
_BYTES = 4

_COMMON = {
    "columns": "first and last column of a scan, by scans.csv; rows have no column stamps",
    "geometry": "rows have no ranges",
    "stamps": "rows have no log times",
    "duplicates": "rows have no columns",
    "returns": "rows have no return types",
    "metadata": "report only: rows have no header",
    "tf_static": "rows have no transforms",
    "imu": "rows have no IMU samples",
    "messages": "rows have no messages",
}
KITTI_LIMITS = _COMMON | {
    "order": "rows have no times",
    "times": "rows have no times",
    "sensors": "rows have no sensors",
    "rings": "rows have no rings",
}
NUSCENES_LIMITS = _COMMON | {
    "order": "points step back by less than a column's duration; rows have no columns",
}


def _rows(data: bytes, columns: int) -> F32Array:
    if len(data) % (columns * _BYTES):
        raise DamageError(f"rows of {columns} float32", f"{len(data)} bytes")
    rows: F32Array = np.frombuffer(data, "<f4").reshape(-1, columns)
    return rows


def _read_times(folder: Path, files: list[ScanFile]) -> list[int]:
    """Starts of the scans of a folder, ns, in the order of their names."""
    path = folder / TIMES_TXT
    try:
        lines = read_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise DamageError(f"a readable {TIMES_TXT} next to the scans", str(err)) from err
    if len(lines) != len(files):
        raise DamageError(f"{len(files)} lines in {TIMES_TXT}", str(len(lines)))
    starts = []
    for number, line in enumerate(lines, 1):
        found = _TIME.fullmatch(line)
        if found is None:
            raise DamageError(f"seconds with 9 decimals in {TIMES_TXT} line {number}", repr(line))
        starts.append(int(found[1]) * _NS + int(found[2]))
    return starts


@dataclass(slots=True)
class RowReader(ScanReader):
    """Reads the files of one folder."""

    _slices: int = 1
    _starts: dict[Path, dict[Path, int]] = field(default_factory=dict)

    def begin(self, file: ScanFile) -> RunMetadata:
        """Nothing: rows have no header."""
        return RunMetadata()

    def know(self, metadata: RunMetadata) -> None:
        """Take over what the report has."""
        self.sensors = metadata.sensors or ()
        self._slices = metadata.slices or 1

    def scan(self, file: ScanFile) -> StoredScan:
        """Return the scan of a file, whose name is checked; times.txt has its start."""
        is_kitti = file.suffix == KITTI_SUFFIX
        rows = _rows(file.read(), 4 if is_kitti else 5)
        times = None if is_kitti else self._times(file, len(rows))
        self.log.ok("layout")
        part = file.slice or 0
        file.check_name(self.log, file.index, part, self._slices)
        scan = StoredScan(
            where=file.where,
            start_ns=self._start_of(file),
            index=file.index,
            slice=part,
            xyz=rows[:, :3],
            organized=False,
            sensor=file.sensor_index(self.log, self.sensors),
            intensity=rows[:, 3],
        )
        if times is not None:
            self._label(scan, rows[:, 4], times[:, 0], times[:, 1])
        return scan

    def _times(self, file: ScanFile, count: int) -> F32Array:
        """The second file of a scan of nuscenes: s after the start, and sensor, (p, 2)."""
        path = file.path.with_name(file.path.name.removesuffix(NUSCENES_SUFFIX) + TIME_SUFFIX)
        times = _rows(file.read(path), 2)
        if len(times) != count:
            raise DamageError(f"{count} rows in {path.name}", str(len(times)))
        return times

    def _start_of(self, file: ScanFile) -> int:
        """The start of a scan in the times.txt of its folder, ns."""
        folder = file.path.parent
        if folder not in self._starts:
            inside = [
                one
                for one in scan_files(CheckLog(), folder, file.suffix)
                if one.path.parent == folder
            ]
            inside.sort(key=lambda one: (one.index < 0, one.index, one.slice or 0))
            starts = _read_times(folder, inside)
            self._starts[folder] = {
                one.path: start for one, start in zip(inside, starts, strict=True)
            }
        return self._starts[folder][file.path]

    def _label(self, scan: StoredScan, ring: F32Array, time_s: F32Array, lidar: F32Array) -> None:
        """Add what only nuscenes has."""
        finite: BoolArray = np.isfinite(time_s)
        bad: BoolArray = np.logical_not(finite)
        self.log.none("times", scan.point, bad, "a finite number", time_s.item)
        scan.time_ns, scan.time_step_ns = seconds_to_ns(time_s)
        scan.time_s = time_s
        scan.ring = self._whole("rings", scan, ring, 65535)
        scan.lidar_id = self._whole("sensors", scan, lidar, 255).astype(np.uint8)

    def _whole(self, check: str, scan: StoredScan, values: F32Array, most: int) -> I64Array:
        exact: F64Array = np.nan_to_num(values, nan=-1.0).astype(np.float64)
        cut: I64Array = np.clip(np.rint(exact), 0, most).astype(np.int64)
        bad: BoolArray = cut != exact
        expected = f"a whole number from 0 to {most}"
        self.log.none(check, scan.point, bad, expected, values.item)
        return cut
