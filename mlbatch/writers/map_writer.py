"""A map: the points of all scans in one file, placed by the poses of the scans, in constant memory.

Coordinates are whole millimetres from an offset: LAS stores both, PLY their sum as float64, and PCD
float32, since PCL reads no other, with the offset in a comment. With voxels only the first point in
each is kept, in the order of the scans. Sources: those of `las_encoder.py`, `formats/ply.py` and
`formats/pcd.py`.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mlbatch
from mlbatch.arrays import F64Array, I64Array
from mlbatch.clocks.timescale import TAI, UTC
from mlbatch.errors import ExportError, UsageError, one_line
from mlbatch.motion.se3 import rotated
from mlbatch.report.map_figures import MapFigures
from mlbatch.types import ImuSamples, Message, RecordLayout, RunInfo, Scan, Summary
from mlbatch.units import NS_PER_S
from mlbatch.writers.atomic import export_errors, prepare
from mlbatch.writers.base import ScanJob
from mlbatch.writers.las_encoder import EXTRA_BYTES, RECORD, VLR_USER, load_lazrs
from mlbatch.writers.map_crs import MapCrs
from mlbatch.writers.point_layouts import MAP_PCD, MAP_PLY, Layout, ScanRecords, record_bytes
from mlbatch.writers.voxel_filter import MOST_VOXELS, VoxelFilter

UNITS_PER_M = 1000
# The offset is the first pose, rounded to so many m: 0 in local frames.
_OFFSET_STEP_M = 1000.0
# Layout of points, and the farthest from the offset, m: float32 has no millimetres beyond.
_FORMATS: dict[str, tuple[Layout | RecordLayout, float]] = {
    ".laz": (RECORD, 2**31 / UNITS_PER_M),
    ".las": (RECORD, 2**31 / UNITS_PER_M),
    ".ply": (MAP_PLY, 1e7),
    ".pcd": (MAP_PCD, 2.0**14),
}
# Forms of extra bytes by their numbers in LAS, and the number of the record with text.
_FORMS = {1: "u1", 3: "u2", 5: "u4", 9: "f4"}
_MAP_VLR = 2


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
        path = request.path
        self._suffix = path.suffix.lower()
        if self._suffix not in _FORMATS:
            raise UsageError(
                "--accumulate: expected the name of a .laz, .las, .ply or .pcd file, found "
                f"{path}; write --accumulate map.laz"
            )
        layout, farthest_m = _FORMATS[self._suffix]
        self._laspy: Any = None
        if layout is RECORD:
            for name in ("lazrs", "laspy"):
                self._laspy = load_lazrs(f"--accumulate {path}", name)
        self._crs = MapCrs(request.crs) if request.crs else None
        self.figures = MapFigures(path.name, request.voxel_m, self._crs.name if self._crs else "")
        self._path = path
        self._info = info
        self._records = ScanRecords(layout)
        self._layout = layout
        self._las: Any = None
        edge = round(request.voxel_m * UNITS_PER_M)
        self._farthest = min(farthest_m * UNITS_PER_M, (edge or 1e9) * MOST_VOXELS) - 1
        self._output = prepare(path, request.overwrite, folder=False, fsync=request.fsync)
        self._disk = _Disk(self._output.partial, "r+")
        self._file = io.BufferedRandom(self._disk)
        with export_errors(path):
            self._voxels = VoxelFilter(edge, path.parent) if edge else None

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that adds a scan."""
        return _AddJob(self, scan)

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
            if self._las is not None:
                self._las.close()
            elif isinstance(self._layout, Layout):
                self._file.seek(0)
                self._file.write(self._head(self._layout))
            self._file.close()
        self._output.sync()
        if last is not None:
            last(self._output.partial)
        self._output.publish()
        self.abandon()

    def abandon(self) -> None:
        """Close all files."""
        with contextlib.suppress(OSError):
            self._file.close()
        if self._voxels is not None:
            self._voxels.close()
        self._output.close()

    def add(self, scan: Scan) -> None:
        """Add the points of a scan. In order."""
        figures, pose = self.figures, scan.world_from_body
        if pose is None:
            raise ExportError(f"scan {scan.index}: expected a pose, found none; please report this")
        if not figures.scans:
            self._begin(scan, pose[:3, 3])
        figures.scans += 1
        xyz_m = rotated(pose[None, :3, :3], scan.xyz.astype(np.float64))
        from_offset_m = pose[:3, 3] - np.array(figures.offset_m)
        units: I64Array = np.rint((xyz_m + from_offset_m) * UNITS_PER_M).astype(np.int64)
        farthest = int(np.abs(units).max(initial=0))
        if farthest > self._farthest:
            raise ExportError(
                f"{self._path}: expected coordinates up to {self._farthest // UNITS_PER_M:.0f} m "
                f"from its offset, found {farthest // UNITS_PER_M} m in scan {scan.index}; write "
                "parts of the drive (--start, --end), or a .laz without --voxel"
            )
        data = np.frombuffer(record_bytes(self._records.of(scan)), np.uint8)
        records = data.reshape(len(units), -1)
        with self._errors():
            if self._voxels is not None:
                kept = self._voxels.first(units)
                figures.thinned += len(units) - len(kept)
                units, records = units[kept], records[kept]
            if len(units):
                self._save(units, records.copy())

    def _begin(self, scan: Scan, position_m: F64Array) -> None:
        """Choose the offset; write a header."""
        if self._crs is not None:
            self._crs.check(position_m.tolist())
        offset_m = np.rint(position_m / _OFFSET_STEP_M) * _OFFSET_STEP_M + 0.0
        self.figures.offset_m = tuple(offset_m.tolist())
        with self._errors():
            if isinstance(self._layout, Layout):
                self._file.write(self._head(self._layout))
            else:
                self._las = self._las_writer(scan)

    def _save(self, units: I64Array, records: Any) -> None:
        """Write points; units: (p, 3); records: (p, bytes), to be completed."""
        figures, layout = self.figures, self._layout
        offset = np.array(figures.offset_m, np.int64) * UNITS_PER_M
        low, high = ((ends + offset) / UNITS_PER_M for ends in (units.min(0), units.max(0)))
        figures.low_m = tuple(np.minimum(low, figures.low_m or low).tolist())
        figures.high_m = tuple(np.maximum(high, figures.high_m or high).tolist())
        figures.points += len(units)
        if isinstance(layout, Layout):
            points = records.reshape(-1).view(layout.dtype)
            for axis, name in enumerate("xyz"):
                added = offset[axis] if layout is MAP_PLY else 0
                points[name] = (units[:, axis] + added) / UNITS_PER_M
            self._file.write(points.data)
            return
        point_format = self._las.header.point_format
        points = records.reshape(-1).view(point_format.dtype())
        for axis, name in enumerate("XYZ"):
            points[name] = units[:, axis]
        self._las.write_points(self._laspy.PackedPointRecord(points, point_format))

    def _las_writer(self, scan: Scan) -> Any:
        """What writes LAS, or LAZ, from the first scan on; laspy has no types."""
        laspy = self._laspy
        header = laspy.LasHeader(version="1.4", point_format=6)
        names = EXTRA_BYTES[: None if scan.reflectivity is not None else -1]
        texts = {"time_ns": "ns after start of its scan"}
        header.add_extra_dims(
            [
                laspy.ExtraBytesParams(name, _FORMS[kind], texts.get(name, text))
                for name, kind, text, _ in names
            ]
        )
        header.scales, header.offsets = [1 / UNITS_PER_M] * 3, list(self.figures.offset_m)
        header.global_encoding.wkt = True
        header.global_encoding.gps_time_type = int(self._info.timescale in (UTC, TAI))
        header.generating_software = f"mlbatch {mlbatch.__version__}"
        # As of scans: equal runs give equal bytes.
        day = datetime.fromtimestamp(scan.start_ns // NS_PER_S, timezone.utc)
        header.creation_date = day.date()
        lines = "\n".join(self._lines()).encode()
        header.vlrs.append(laspy.VLR(VLR_USER, _MAP_VLR, "map", lines))
        if self._crs is not None:
            # OGC 01-009 (WKT 1), which ends with a zero.
            wkt = self._crs.wkt.encode() + b"\0"
            header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "OGC WKT", wkt))
        is_laz = self._suffix == ".laz"
        backend = laspy.LazBackend.Lazrs if is_laz else None
        return laspy.LasWriter(self._file, header, is_laz, backend, closefd=False)

    def _head(self, layout: Layout) -> bytes:
        """The header of PLY or PCD; a comment keeps its length, whatever the number of points."""
        count = self.figures.points
        copies = 1 if layout is MAP_PLY else 2
        lines = [*self._lines(), "." * (copies * (12 - len(str(count))))]
        return layout.ply_head(lines, count) if copies == 1 else layout.pcd_head(lines, count)

    def _lines(self) -> list[str]:
        """What the header says, as text."""
        figures = self.figures
        return [
            f"mlbatch {mlbatch.__version__}: a map",
            *(f"{name} {one_line(value)}" for name, value in self._info.variants),
            f"offset_m {' '.join(f'{m:.0f}' for m in figures.offset_m)}",
            *(["add offset_m to x y z"] if self._layout is MAP_PCD else []),
            f"voxel_m {figures.voxel_m:g}",
            f"crs {figures.crs or 'none'}",
            f"timescale {self._info.timescale}",
            "units: x y z m; time s; intensity as sent by the sensor",
            f"lidar_id from 0: {' '.join(sensor.name for sensor in self._info.sensors)}",
        ]

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

    def write(self, data: Any, /) -> int:
        """Write bytes."""
        try:
            return super().write(data)
        except OSError as err:
            self.error = err
            raise


class _AddJob(ScanJob):
    """Adds a scan to a map."""

    def __init__(self, writer: MapWriter, scan: Scan) -> None:
        self._writer = writer
        self._scan = scan

    def commit(self) -> None:
        self._writer.add(self._scan)
