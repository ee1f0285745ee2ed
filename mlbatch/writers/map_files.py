"""Files of a map: one cloud in LAS, LAZ, PLY or PCD, whose header is written again at the end.

Coordinates are whole millimetres from an offset: LAS stores both, PLY their sum as float64, and PCD
the coordinates as float32, since PCL reads no other, with the offset in a comment. Sources: those
of `las_encoder.py`, `formats/ply.py` and `formats/pcd.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import mlbatch
from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.errors import UsageError, one_line
from mlbatch.types import RunInfo, Scan
from mlbatch.units import NS_PER_S
from mlbatch.writers.las_encoder import (
    VLR_USER,
    LasHead,
    described,
    gps_shift_s,
    las_header,
    lazrs_items,
    load_lazrs,
    vlr,
)
from mlbatch.writers.map_crs import MapCrs

Records = npt.NDArray[np.void]
UNITS_PER_M = 1000
# Return number, and number of returns in the upper four bits, by return type.
_RETURNS = np.array([0x11, 0x11, 0x11, 0x21, 0x22, 0x21, 0x22, 0x11], np.uint8)
_MAP_VLR = 2
# Comments may become so much longer until the header is written again.
_ROOM_BYTES = 256


def _seconds(scan: Scan, shift_s: int = 0) -> F64Array:
    """Times of points on the timescale less `shift_s`, s."""
    whole_s, rest_ns = divmod(scan.start_ns, NS_PER_S)
    seconds: F64Array = (scan.time_ns + np.int64(rest_ns)) / NS_PER_S
    return seconds + (whole_s - shift_s)


def is_second(return_type: npt.NDArray[Any]) -> BoolArray:
    """Whether points (p,) are the farther of two returns."""
    found: BoolArray = (_RETURNS[return_type] & 15) == 2
    return found


# Attributes of the points of a scan, by the names of fields.
_VALUES: Mapping[str, Callable[[Scan], npt.NDArray[Any]]] = {
    "intensity": lambda scan: scan.intensity,
    "intensity_f32": lambda scan: scan.intensity,
    "intensity_u16": lambda scan: np.clip(np.rint(np.nan_to_num(scan.intensity)), 0, 65535),
    "reflectivity": lambda scan: (
        np.zeros_like(scan.ring) if scan.reflectivity is None else scan.reflectivity
    ),
    "time": _seconds,
    "gps_time": lambda scan: _seconds(scan, gps_shift_s(scan.info.timescale, scan.start_ns)),
    "ring": lambda scan: scan.ring,
    "returns": lambda scan: _RETURNS[scan.return_type],
    "return_type": lambda scan: scan.return_type,
    "lidar_id": lambda scan: scan.lidar_id,
    "source": lambda scan: scan.lidar_id.astype(np.uint16) + np.uint16(1),
}
_LABELS = [("return_type", "u1"), ("lidar_id", "u1")]
_PLY = np.dtype(
    [("xyz", "<f8", 3), ("intensity", "<f4"), ("time", "<f8"), ("ring", "<i4"), *_LABELS]
)
_PCD = np.dtype(
    [("xyz", "<f4", 3), ("intensity", "<f4"), ("time", "<f8"), ("ring", "<u2"), *_LABELS]
)
# Point data record format 6, then extra bytes; `unused`: flags, class and user data, scan angle.
_LAS_FIELDS = [
    *(("xyz", "<i4", 3), ("intensity_u16", "<u2"), ("returns", "u1"), ("unused", "V5")),
    *(("source", "<u2"), ("gps_time", "<f8")),
    *(("ring", "<u2"), ("return_type", "u1"), ("intensity_f32", "<f4")),
]
_LAS_EXTRA = ["ring", "return_type", "intensity_f32"]
_REFLECTIVITY = "reflectivity"
_PLY_TYPES = {"<f4": "float", "<f8": "double", "<i4": "int", "|u1": "uchar"}
_UNITS = "x y z m; time s; intensity as sent by the sensor"


@dataclass(slots=True)
class MapState:
    """What a header says; low, high: corners in units from the offset; second: farther returns."""

    info: RunInfo
    crs: MapCrs | None
    voxel_m: float
    offset_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    start_ns: int = 0
    end_ns: int = 0
    scans: int = 0
    points: int = 0
    second: int = 0
    low: tuple[int, ...] = (0, 0, 0)
    high: tuple[int, ...] = (0, 0, 0)

    def corners_m(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Both corners, with the offset."""
        low_m, high_m = (
            tuple(
                round(unit / UNITS_PER_M + m, 3)
                for unit, m in zip(ends, self.offset_m, strict=True)
            )
            for ends in (self.low, self.high)
        )
        return low_m, high_m

    def lines(self) -> list[str]:
        """The header as lines of text."""
        names = " ".join(sensor.name for sensor in self.info.sensors)
        return [
            f"mlbatch {mlbatch.__version__}",
            f"map of {self.scans} scans from start_ns {self.start_ns} to end_ns {self.end_ns}",
            *(f"{name} {one_line(value)}" for name, value in self.info.variants),
            f"offset_m {' '.join(f'{m:.0f}' for m in self.offset_m)}",
            f"voxel_m {self.voxel_m:g}",
            f"crs {self.crs.name if self.crs else 'none'}",
            f"timescale {self.info.timescale}",
            f"units: {_UNITS}",
            f"lidar_id from 0: {names}",
        ]


class MapFormat(NamedTuple):
    """A format; farthest_m: of a coordinate from the offset; lazrs: compresses records, or None.

    head: the header of a state, and the size that it is padded to.
    """

    dtype: np.dtype[np.void]
    farthest_m: float
    head: Callable[[MapState, int], bytes]
    lazrs: Any = None

    def records(self, scan: Scan, rows: Any, count: int) -> Records:
        """Return the points of a scan without coordinates; rows: those that are no empty slot."""
        records: Records = np.zeros(count, self.dtype)
        for name in self.dtype.names or ():
            if name in _VALUES:
                records[name] = _VALUES[name](scan)[rows]
        return records

    def place(self, records: Records, units: I64Array, state: MapState) -> None:
        """Fill the coordinates of records (p,); units: (p, 3) from the offset."""
        kind = self.dtype["xyz"].base.str
        if kind == "<f8":
            units = units + np.array(state.offset_m, np.int64) * UNITS_PER_M
        records["xyz"] = units if kind == "<i4" else units / UNITS_PER_M

    def compressor(self, file: Any) -> Any:
        """Return what compresses records into a file; None where they are not compressed."""
        if self.lazrs is None:
            return None
        return self.lazrs.LasZipCompressor(file, lazrs_items(self.lazrs, self.dtype.itemsize))


def map_format(path: Path, has_reflectivity: bool) -> MapFormat:
    """Return the format by the suffix of a map; UsageError for another."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        return MapFormat(_PLY, 1e9, _ply_head)
    if suffix == ".pcd":
        # Beyond, float32 has no millimetres.
        return MapFormat(_PCD, 2.0**14, _pcd_head)
    if suffix not in (".las", ".laz"):
        raise UsageError(
            f"--accumulate: expected the name of a .laz, .las, .ply or .pcd file, found {path}; "
            "write --accumulate map.laz"
        )
    lazrs = load_lazrs(f"--accumulate {path}") if suffix == ".laz" else None
    extra = [(_REFLECTIVITY, "<u2")] if has_reflectivity else []
    dtype = np.dtype([*_LAS_FIELDS, *extra])
    items = None if lazrs is None else lazrs_items(lazrs, dtype.itemsize)

    def head(state: MapState, size: int) -> bytes:
        return _las_head(state, size, dtype, items)

    return MapFormat(dtype, (2**31 - 1) / UNITS_PER_M, head, lazrs)


def first_head(file_format: MapFormat, state: MapState) -> bytes:
    """Return the header of an empty map, with room for what is known at the end."""
    return file_format.head(state, len(file_format.head(state, 0)) + _ROOM_BYTES)


def _las_head(state: MapState, size: int, dtype: np.dtype[np.void], items: Any) -> bytes:
    extra = [*_LAS_EXTRA, *([_REFLECTIVITY] if _REFLECTIVITY in (dtype.names or ()) else [])]
    low_m, high_m = state.corners_m()
    fields = LasHead(
        state.info.timescale,
        state.start_ns,
        (state.points, state.second),
        low_m,
        high_m,
        dtype.itemsize,
        1 / UNITS_PER_M,
        state.offset_m,
    )
    vlrs = [vlr("LASF_Spec", 4, "Extra Bytes Record", described(extra))]
    if state.crs is not None:
        # OGC 01-009 (WKT 1), which ends with a zero.
        vlrs.append(vlr("LASF_Projection", 2112, "OGC WKT", state.crs.wkt.encode() + b"\0"))
    text = "\n".join(state.lines()).encode()

    def with_text(padding: int) -> bytes:
        padded = text + b" " * padding
        return las_header(fields, [*vlrs, vlr(VLR_USER, _MAP_VLR, "map", padded)], items)

    return with_text(max(0, size - len(with_text(0))))


def _ply_head(state: MapState, size: int) -> bytes:
    fields = _scalars(_PLY)
    head = ["ply", "format binary_little_endian 1.0", *_prefixed("comment", state)]
    tail = [
        f"element vertex {state.points}",
        *(f"property {_PLY_TYPES[kind.str]} {name}" for name, kind in fields),
        "end_header",
    ]
    return _padded(head, tail, "comment ", size)


def _pcd_head(state: MapState, size: int) -> bytes:
    fields = _scalars(_PCD)
    text = "# add offset_m to x y z: float32 would lose it"
    head = ["# .PCD v0.7 - Point Cloud Data file format", *_prefixed("#", state), text]
    kinds = {"f": "F", "u": "U"}
    tail = [
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, _ in fields)}",
        f"SIZE {' '.join(str(kind.itemsize) for _, kind in fields)}",
        f"TYPE {' '.join(kinds[kind.kind] for _, kind in fields)}",
        f"COUNT {' '.join('1' for _ in fields)}",
        f"WIDTH {state.points}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {state.points}",
        "DATA binary",
    ]
    return _padded(head, tail, "# ", size)


def _scalars(dtype: np.dtype[np.void]) -> Sequence[tuple[str, np.dtype[Any]]]:
    """Names and types of fields, with x, y and z apart."""
    names = [name for name in dtype.names or () if name != "xyz"]
    axes = [(axis, dtype["xyz"].base) for axis in "xyz"]
    return [*axes, *((name, dtype[name]) for name in names)]


def _prefixed(prefix: str, state: MapState) -> list[str]:
    return [f"{prefix} {line}" for line in state.lines()]


def _padded(head: list[str], tail: list[str], comment: str, size: int) -> bytes:
    """Return lines of a header of at least `size` bytes: a comment between them is padded."""
    padding = size - len("\n".join([*head, comment, *tail, ""]).encode())
    return "\n".join([*head, comment + " " * max(0, padding), *tail, ""]).encode()
