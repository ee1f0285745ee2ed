"""A map: the points of all scans in one file, placed by the poses of the scans, in constant memory.

With voxels only the first point in each is kept, in the order of the scans.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.errors import ExportError
from mlbatch.report.map_figures import MapFigures
from mlbatch.types import ImuSamples, Message, RunInfo, Scan, Summary
from mlbatch.writers.atomic import export_errors, prepare
from mlbatch.writers.base import ScanJob
from mlbatch.writers.map_crs import MapCrs
from mlbatch.writers.map_files import (
    UNITS_PER_M,
    MapState,
    Records,
    first_head,
    is_second,
    map_format,
)
from mlbatch.writers.voxel_filter import MOST_VOXELS, VoxelFilter

# The offset is the first pose, rounded to so many m: 0 in local frames.
_OFFSET_STEP_M = 1000.0
_BUFFER_BYTES = 1 << 20


class MapRequest(NamedTuple):
    """A map as options ask for it; voxel_m: a whole number of mm, 0: no voxels."""

    path: Path
    voxel_m: float = 0.0
    crs: str = ""
    overwrite: bool = False
    fsync: bool = True


class MapWriter:
    """Writes the map of a run; see `ScanWriter`."""

    def __init__(self, request: MapRequest, info: RunInfo) -> None:
        self._path = request.path
        crs = MapCrs(request.crs) if request.crs else None
        has_reflectivity = any(sensor.has_reflectivity for sensor in info.sensors)
        self._format = map_format(request.path, has_reflectivity)
        self._state = MapState(info, crs, request.voxel_m)
        self._thinned = 0
        self._voxels: VoxelFilter | None = None
        edge = round(request.voxel_m * UNITS_PER_M)
        self._farthest = int(self._format.farthest_m * UNITS_PER_M)
        self._output = prepare(request.path, request.overwrite, folder=False, fsync=request.fsync)
        self._disk = _Disk(self._output.partial)
        self._file = io.BufferedRandom(self._disk, _BUFFER_BYTES)
        with self._errors():
            if edge:
                self._voxels = VoxelFilter(edge, request.path.parent)
                self._farthest = min(self._farthest, edge * (MOST_VOXELS - 1))
            head = first_head(self._format, self._state)
            self._head_bytes = len(head)
            self._file.write(head)
            self._compressor = self._format.compressor(self._file)

    @property
    def figures(self) -> MapFigures:
        """What was written so far."""
        state = self._state
        return MapFigures(
            self._path.name,
            state.scans,
            state.points,
            self._thinned,
            state.voxel_m,
            state.crs.name if state.crs else "",
            state.offset_m,
            *state.corners_m(),
        )

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that adds a scan."""
        return _PlaceJob(self, scan)

    def flush(self) -> ScanJob:
        """Return a job without work: only scans are written."""
        return ScanJob()

    def write_imu(self, samples: ImuSamples) -> None:
        """Ignore IMU samples."""

    def write_message(self, message: Message) -> None:
        """Ignore messages."""

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Complete the header, and move the file to its final path."""
        with self._errors():
            if self._compressor is not None:
                self._compressor.done()
            self._file.seek(0)
            self._file.write(self._format.head(self._state, self._head_bytes))
            self._file.close()
        self._close_voxels()
        self._output.sync()
        if last is not None:
            last(self._output.partial)
        self._output.publish()

    def abandon(self) -> None:
        """Close all files after an error."""
        with contextlib.suppress(OSError):
            self._file.close()
        self._close_voxels()
        self._output.close()

    def pack(self, scan: Scan) -> tuple[Records, F64Array]:
        """Return the records of a scan without coordinates, and these (p, 3), m. Any thread."""
        if scan.world_from_body is None:
            raise ExportError(
                f"scan {scan.index}: expected a pose for --accumulate, found none; please report"
            )
        rows: Any = slice(None)
        if scan.info.layout == "organized":
            rows = np.isfinite(scan.xyz[..., 0])
        rotation, position_m = scan.world_from_body[:3, :3], scan.world_from_body[:3, 3]
        # Sums of three products: the same in any thread and for any number of points.
        x, y, z = scan.xyz[rows].astype(np.float64).T
        records = self._format.records(scan, rows, len(x))
        placed = [
            a * x + b * y + c * z + m for (a, b, c), m in zip(rotation, position_m, strict=True)
        ]
        return records, np.stack(placed, axis=1)

    def place(self, scan: Scan, records: Records, xyz_m: F64Array) -> Records:
        """Return the records that are kept, with their coordinates. In order."""
        state = self._state
        if not state.scans and scan.world_from_body is not None:
            first_m = scan.world_from_body[:3, 3]
            if state.crs is not None:
                state.crs.check(first_m.tolist())
            state.offset_m = tuple(
                (np.rint(first_m / _OFFSET_STEP_M) * _OFFSET_STEP_M + 0.0).tolist()
            )
            state.start_ns = scan.start_ns
        state.scans += 1
        state.end_ns = scan.end_ns
        units: I64Array = np.rint((xyz_m - np.array(state.offset_m)) * UNITS_PER_M).astype(np.int64)
        if not len(units):
            return records
        low, high = units.min(axis=0), units.max(axis=0)
        farthest = int(max(-low.min(), high.max()))
        if farthest > self._farthest:
            raise ExportError(
                f"{self._path}: expected coordinates up to {self._farthest // UNITS_PER_M} m from "
                f"its offset, found {farthest // UNITS_PER_M} m in scan {scan.index}; write parts "
                "of the drive (--start, --end), or a .laz"
            )
        if self._voxels is not None:
            with export_errors(self._path):
                kept = self._voxels.first(units)
            self._thinned += len(units) - len(kept)
            records, units = records[kept], units[kept]
            if not len(units):
                return records
            low, high = units.min(axis=0), units.max(axis=0)
        if state.points:
            low, high = np.minimum(low, state.low), np.maximum(high, state.high)
        state.low, state.high = tuple(low.tolist()), tuple(high.tolist())
        state.points += len(units)
        state.second += int(is_second(records["return_type"]).sum())
        self._format.place(records, units, state)
        return records

    def save(self, records: Records) -> None:
        """Write records. In order."""
        if not len(records):
            return
        data = np.ascontiguousarray(records).view(np.uint8)
        with self._errors():
            if self._compressor is None:
                self._file.write(data.data)
            else:
                self._compressor.compress_many(data)

    def _close_voxels(self) -> None:
        if self._voxels is not None:
            self._voxels.close()

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """Errors of the disk as one line, also where lazrs has hidden them."""
        with export_errors(self._output.partial):
            try:
                yield
            except Exception as err:
                if self._disk.error is not None:
                    raise self._disk.error from err
                raise


class _Disk(io.FileIO):
    """A file that remembers the error of a write."""

    error: OSError | None = None

    def __init__(self, path: Path) -> None:
        super().__init__(path, "r+")

    def write(self, data: Any, /) -> int:
        """Write bytes."""
        try:
            return super().write(data)
        except OSError as err:
            self.error = err
            raise


class _PlaceJob(ScanJob):
    """Adds a scan to a map."""

    def __init__(self, writer: MapWriter, scan: Scan) -> None:
        self._writer = writer
        self._scan = scan

    def pack(self) -> None:
        self._records, self._xyz_m = self._writer.pack(self._scan)

    def append(self) -> None:
        self._records = self._writer.place(self._scan, self._records, self._xyz_m)

    def commit(self) -> None:
        self._writer.save(self._records)
