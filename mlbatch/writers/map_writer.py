"""A map: the points of all scans in one file, placed by the poses of the scans, in constant memory.

Coordinates are whole millimetres from an offset: LAS stores both, PLY their sum as float64, and PCD
float32, since PCL reads no other. With voxels only the first point in each is kept, in the order of
the scans. Sources: those of `las_encoder.py`, `formats/ply.py` and `formats/pcd.py`.
"""

from __future__ import annotations

import contextlib
import importlib
import mmap
import tempfile
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

import mlbatch
from mlbatch.arrays import I64Array
from mlbatch.clocks.timescale import TAI, UTC
from mlbatch.errors import ExportError, RigError, UsageError, install_extra, one_line
from mlbatch.motion.se3 import rotated
from mlbatch.reports.report import MapFigures
from mlbatch.types import RunInfo, Scan, Summary
from mlbatch.units import NS_PER_S
from mlbatch.writers.atomic import export_errors, prepare
from mlbatch.writers.base import ScanJob, ScanWriter
from mlbatch.writers.las_encoder import EXTRA_BYTES, RECORD, VLR_NUMBER, VLR_USER, load_lazrs
from mlbatch.writers.point_layouts import MAP_PCD, MAP_PLY, ScanRecords, record_bytes

UNITS_PER_M = 1000
# The offset is the first pose, rounded to so many m: 0 in local frames.
_OFFSET_STEP_M = 1000.0
# Layouts of records by suffix; None: of LAS.
_LAYOUTS = {".laz": None, ".las": None, ".ply": MAP_PLY, ".pcd": MAP_PCD}
# Types of extra bytes by their numbers in LAS.
_TYPES = {1: "u1", 3: "u2", 5: "u4", 9: "f4"}


class MapWriter(ScanWriter):
    """Writes the map of a run; figures: of what is in it."""

    def __init__(
        self, path: Path, voxel_m: float, crs: str | None, overwrite: bool, fsync: bool
    ) -> None:
        """voxel_m: a whole number of mm, 0: no voxels; crs: as EPSG:NNNN."""
        self._suffix = path.suffix.lower()
        if self._suffix not in _LAYOUTS:
            text = (
                f"--accumulate: expected the name of a .laz, .las, .ply or .pcd file, found {path}"
            )
            raise UsageError(f"{text}; write --accumulate map.laz")
        self._layout = _LAYOUTS[self._suffix]
        self._laspy: Any = None
        for name in ("lazrs", "laspy") if self._layout is None else ():
            self._laspy = load_lazrs(f"--accumulate {path}", name)
        self._crs = MapCrs(crs) if crs else None
        self.figures = MapFigures(path.name, voxel_m, self._crs.name if self._crs else "")
        self._records = ScanRecords(self._layout or RECORD)
        self._las: Any = None
        self._info = RunInfo((), "", "", "")
        edge = round(voxel_m * UNITS_PER_M)
        # int32, and where float32 still has millimetres.
        farthest = 2**14 * UNITS_PER_M if self._layout is MAP_PCD else 2**31
        self._farthest = min(farthest, (edge or 2**31) * MOST_VOXELS)
        self._output = prepare(path, overwrite, folder=False, fsync=fsync)
        self._file = self._output.partial.open("r+b")
        with export_errors(path):
            self._voxels = VoxelFilter(edge, path.parent) if edge else None

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that adds a scan."""
        return _AddJob(self, scan)

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Complete the header, and move the file to its final path."""
        with self.errors():
            if self._las is not None:
                self._las.close()
            else:
                self._file.seek(0)
                self._file.write(self._head())
            self._file.close()
        self._output.sync()
        if last is not None:
            last(self._output.partial)
        self._output.publish()
        self.abandon()

    def abandon(self) -> None:
        """Close all files; one without a scan is removed."""
        with contextlib.suppress(OSError):
            self._file.close()
        if self._voxels is not None:
            self._voxels.close()
        if not self.figures.scans:
            self._output.partial.unlink(missing_ok=True)
        self._output.close()

    def add(self, scan: Scan) -> None:
        """Add the points of a scan. In order."""
        figures, pose = self.figures, scan.world_from_body
        if pose is None:
            raise ExportError(f"scan {scan.index}: expected a pose, found none; please report this")
        rotation, position_m = pose[None, :3, :3], pose[:3, 3]
        if not figures.scans:
            if self._crs is not None:
                self._crs.check(*position_m[:2].tolist())
            offset_m = np.rint(position_m / _OFFSET_STEP_M) * _OFFSET_STEP_M + 0.0
            figures.offset_m = tuple(offset_m.tolist())
            self._begin(scan)
        figures.scans += 1
        if not len(scan.xyz):
            return
        from_offset_m = position_m - np.array(figures.offset_m)
        xyz_m = rotated(rotation, scan.xyz.astype(np.float64)) + from_offset_m
        units: I64Array = np.rint(xyz_m * UNITS_PER_M).astype(np.int64)
        farthest = int(np.abs(units).max())
        if farthest >= self._farthest:
            raise ExportError(
                f"{self._output.target}: expected points below {self._farthest // UNITS_PER_M} m "
                f"from its offset, found {farthest // UNITS_PER_M} m in scan {scan.index}; write "
                "parts of the drive (--start, --end), or a .laz without --voxel"
            )
        records = np.asarray(record_bytes(self._records.of(scan))).reshape(len(units), -1)
        if self._voxels is not None:
            kept = self._voxels.first(units)
            figures.thinned += len(units) - len(kept)
            units, records = units[kept], records[kept]
        if len(units):
            self._save(units, records.copy())

    def _begin(self, scan: Scan) -> None:
        """Write a header; points and corners are added at the end."""
        self._info = info = scan.info
        if self._layout is not None:
            self._file.write(self._head())
            return
        laspy = self._laspy
        header = laspy.LasHeader(version="1.4", point_format=6)
        for name, kind, text, _ in EXTRA_BYTES[: None if scan.reflectivity is not None else -1]:
            about = "ns after start of its scan" if name == "time_ns" else text
            header.add_extra_dim(laspy.ExtraBytesParams(name, _TYPES[kind], about))
        header.scales, header.offsets = [1 / UNITS_PER_M] * 3, list(self.figures.offset_m)
        header.global_encoding.wkt = True
        header.global_encoding.gps_time_type = int(info.timescale in (UTC, TAI))
        # As of scans: equal runs give equal bytes.
        header.creation_date = datetime.fromtimestamp(scan.start_ns // NS_PER_S, timezone.utc)
        lines = "\n".join(self._lines()).encode()
        header.vlrs.append(laspy.VLR(VLR_USER, VLR_NUMBER + 1, "map", lines))
        if self._crs is not None:
            header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "OGC WKT", self._crs.wkt))
        is_laz, backend = self._suffix == ".laz", laspy.LazBackend.Lazrs
        self._las = laspy.LasWriter(self._file, header, is_laz, backend, closefd=False)

    def _save(self, units: I64Array, records: Any) -> None:
        """Write points; units: (p, 3); records: (p, bytes), to be completed."""
        figures, layout = self.figures, self._layout
        offset = np.rint(np.array(figures.offset_m) * UNITS_PER_M)
        low_m, high_m = ((ends + offset) / UNITS_PER_M for ends in (units.min(0), units.max(0)))
        figures.low_m = tuple(np.minimum(low_m, figures.low_m or low_m).tolist())
        figures.high_m = tuple(np.maximum(high_m, figures.high_m or high_m).tolist())
        figures.points += len(units)
        if layout is None:
            point_format = self._las.header.point_format
            points = records.reshape(-1).view(point_format.dtype())
            points["X"], points["Y"], points["Z"] = units.T
            self._las.write_points(self._laspy.PackedPointRecord(points, point_format))
            return
        points = records.reshape(-1).view(layout.dtype)
        added = offset if layout is MAP_PLY else 0
        points["x"], points["y"], points["z"] = ((units + added) / UNITS_PER_M).T
        self._file.write(points.data)

    def _head(self) -> bytes:
        """The header of PLY or PCD; a comment keeps its length, whatever the number of points."""
        count = self.figures.points
        is_pcd = self._layout is MAP_PCD
        # PCD has the number twice.
        lines = [*self._lines(), "." * (12 - len(str(count))) * (1 + is_pcd)]
        return MAP_PCD.pcd_head(lines, count) if is_pcd else MAP_PLY.ply_head(lines, count)

    def _lines(self) -> list[str]:
        """Lines of text in the header of a map."""
        figures, info = self.figures, self._info
        return [
            f"mlbatch {mlbatch.__version__}: a map",
            *(f"{name} {one_line(value)}" for name, value in info.variants),
            f"offset_m {' '.join(f'{m:.0f}' for m in figures.offset_m)}",
            *(["add offset_m to x y z"] if self._layout is MAP_PCD else []),
            f"voxel_m {figures.voxel_m:g}",
            f"crs {figures.crs or 'none'}",
            f"timescale {info.timescale}",
            f"lidar_id from 0: {' '.join(sensor.name for sensor in info.sensors)}",
        ]

    @contextlib.contextmanager
    def errors(self) -> Iterator[None]:
        """Errors of the disk as one line."""
        with export_errors(self._output.partial):
            try:
                yield
            except RuntimeError:
                # That of lazrs hides errors of the disk, which more bytes meet again.
                self._file.write(bytes(1 << 20))
                raise


class _AddJob(ScanJob):
    """Adds a scan to a map."""

    def __init__(self, writer: MapWriter, scan: Scan) -> None:
        self._writer = writer
        self._scan = scan

    def commit(self) -> None:
        with self._writer.errors():
            self._writer.add(self._scan)


# Poses so near to the origin, m, are usually those of a local frame.
_LOCAL_M = 10_000.0
# Systems are used beyond their area, but less far, degrees.
_BEYOND_DEG = (20.0, 10.0)


class MapCrs:
    """A projected system in metres, looked up by pyproj; x is easting, y northing, z up."""

    def __init__(self, name: str) -> None:
        """name: EPSG:NNNN; UsageError for another or an unknown one, and without pyproj."""
        try:
            pyproj = importlib.import_module("pyproj")
        except ImportError as err:
            raise UsageError(
                f"--crs: expected the package pyproj, found none ({err}); {install_extra('crs')}"
            ) from err
        _, _, code = name.upper().partition("EPSG:")
        try:
            crs: Any = pyproj.CRS.from_epsg(code)
            # OGC 01-009 (WKT 1), which ends with a zero in LAS.
            self.wkt = crs.to_wkt("WKT1_GDAL").encode() + b"\0"
        except pyproj.exceptions.CRSError as err:
            text = f"--crs: expected a known EPSG:NNNN, found {name!r}; write --crs EPSG:32633"
            raise UsageError(text) from err
        self.name = f"EPSG:{code}"
        plane = crs.sub_crs_list[0] if crs.is_compound else crs
        if not plane.is_projected or {axis.unit_name for axis in crs.axis_info} != {"metre"}:
            found = f"{plane.type_name} in {crs.axis_info[0].unit_name} ({crs.name})"
            text = f"--crs: expected a projected system in metres, found {found}"
            raise UsageError(f"{text}; give that of the poses")
        self._area = crs.area_of_use
        self._to_degrees = pyproj.Transformer.from_crs(plane, plane.geodetic_crs, always_xy=True)

    def check(self, x: float, y: float) -> None:
        """RigError for a position in m that is far from where the system is used."""
        east, north = self._to_degrees.transform(x, y)
        wider, higher = (0.0, 0.0) if max(abs(x), abs(y)) < _LOCAL_M else _BEYOND_DEG
        area = self._area
        # Areas may enclose 180 degrees.
        width = (area.east - area.west) % 360.0 or 360.0
        is_known = area.south - higher <= north <= area.north + higher
        if not (is_known and (east - area.west + wider) % 360.0 <= width + 2.0 * wider):
            raise RigError(
                f"--crs {self.name}: expected poses with eastings and northings of {area.name}, "
                f"found x {x:.1f}, y {y:.1f} m; give their system, or none for a local frame"
            )


# Bits of a coordinate in a block, and of that of a block, around the origin of the map.
_SHIFT, _AXIS_BITS = 5, 21
_BLOCK_BYTES = 1 << (3 * _SHIFT - 3)
MOST_VOXELS = 1 << (_AXIS_BITS - 1 + _SHIFT)
# The file grows by so many blocks. After so many scans all pages are unmapped: those in use return.
_GROWTH, _SCANS = 4096, 64


class VoxelFilter:
    """Remembers which voxels have a point, in constant memory.

    Voxels are bits in blocks of 32 x 32 x 32, 4 KB each, in a temporary file that is mapped into
    memory: a scan touches the blocks in the range of its lidars, the system keeps the others on
    the disk. Memory that grows is 16 bytes per block.
    """

    def __init__(self, edge: int, folder: Path) -> None:
        """edge: in units of the coordinates; folder: of the temporary file."""
        self._edge = edge
        self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
        # Numbers of blocks, increasing, and their places in the file.
        self._keys: I64Array = np.zeros(0, np.int64)
        self._places: I64Array = np.zeros(0, np.int64)
        self._map: mmap.mmap | None = None
        self._scans = 0

    def first(self, units: I64Array) -> I64Array:
        """Return the indexes, increasing, of the points (n, 3) that are the first in their voxel.

        units: less than MOST_VOXELS voxels from the origin. OSError where the disk is full.
        """
        cells = units // self._edge
        x, y, z = ((cells >> _SHIFT) + (1 << (_AXIS_BITS - 1))).T
        keys, block = np.unique((((x << _AXIS_BITS) | y) << _AXIS_BITS) | z, return_inverse=True)
        a, b, c = (cells & ((1 << _SHIFT) - 1)).T
        voxels = (self._places_of(keys)[block] << (3 * _SHIFT)) | (a << (2 * _SHIFT))
        voxels, first = np.unique(voxels | (b << _SHIFT) | c, return_index=True)
        self._scans += 1
        if self._map is None or self._scans % _SCANS == 0:
            self._map = mmap.mmap(self._file.fileno(), 0)
        bits = np.frombuffer(self._map, np.uint8)
        mask = np.left_shift(1, voxels & 7).astype(np.uint8)
        is_new = (bits[voxels >> 3] & mask) == 0
        # Several voxels share a byte.
        np.bitwise_or.at(bits, voxels[is_new] >> 3, mask[is_new])
        return np.sort(first[is_new])

    def close(self) -> None:
        """Remove the temporary file."""
        self._map = None
        self._file.close()

    def _places_of(self, keys: I64Array) -> I64Array:
        """Places of the blocks with keys (k,), increasing; new ones are empty."""
        at = self._keys.searchsorted(keys)
        is_new = np.append(self._keys, -1)[at] != keys
        if not is_new.any():
            return self._places[at]
        count = len(self._keys)
        end = count + int(is_new.sum())
        self._keys = np.insert(self._keys, at[is_new], keys[is_new])
        self._places = np.insert(self._places, at[is_new], np.arange(count, end))
        while self._file.tell() < end * _BLOCK_BYTES:
            # Written, since a mapped page without a place on the disk would end the process.
            self._file.write(bytes(_GROWTH * _BLOCK_BYTES))
            self._map = None
        return self._places[self._keys.searchsorted(keys)]
