"""Layouts of point records as tables, and how records are filled (docs/sources/outputs.md).

Fields are pieces of the compiled packer (`native/pack.c`); what only numpy computes is filled block
by block, so that the strided writes of a block stay in the processor's cache.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, F64Array, U8Array, U16Array
from mlbatch.decode.records import RecordPacker
from mlbatch.errors import ExportError
from mlbatch.types import (
    BYTE_INTENSITY,
    PACKED_ROOM,
    PackedPoints,
    RecordLayout,
    RecordPiece,
    Scan,
    SensorInfo,
)

Values: TypeAlias = npt.NDArray[np.generic]
Records: TypeAlias = npt.NDArray[np.void]
# Kinds of pieces that are copies; the piece of a field that is always zero.
_COPIES = ("point", "label", "reflectivity")
_ZERO = ("", 0)


class Points(NamedTuple):
    """Arrays to copy into records, in the order of the file: (p,), or (slots, n) if organized."""

    sensors: tuple[SensorInfo, ...]
    xyz: F32Array
    intensity: F32Array
    reflectivity: U16Array | None
    ring: U16Array
    lidar_id: U8Array

    def take(self, rows: slice) -> Points:
        """Return the points in `rows` of the first axis."""
        return Points(
            self.sensors,
            self.xyz[rows],
            self.intensity[rows],
            None if self.reflectivity is None else self.reflectivity[rows],
            self.ring[rows],
            self.lidar_id[rows],
        )


def _points_of(scan: Scan) -> Points:
    """Return the points of a scan; organized ones are transposed to rows of slots."""
    organized = scan.info.layout == "organized"
    return Points(
        scan.info.sensors,
        scan.xyz.transpose(1, 0, 2) if organized else scan.xyz,
        scan.intensity.T,
        None if scan.reflectivity is None else scan.reflectivity.T,
        scan.ring.T,
        scan.lidar_id.T,
    )


_BLOCK_POINTS = 8192
_MAX_U8 = 255


class Field(NamedTuple):
    """One field of a record: a piece, or values that only numpy computes."""

    name: str
    dtype: str  # little endian
    offset: int  # bytes
    piece: tuple[str, int] = _ZERO  # kind and source of a `RecordPiece`
    values: Callable[[Points], Values] | None = None  # of any type that converts to `dtype`

    @property
    def size(self) -> int:
        """Bytes."""
        return int(self.dtype[-1])


class Layout(NamedTuple):
    """Fields of a point record; bytes between fields are zero."""

    name: str
    step: int  # bytes of a record
    fields: tuple[Field, ...]
    # Members of `types.EXTRAS` that the fields need; BYTE_INTENSITY.
    extras: frozenset[str] = frozenset()

    @property
    def dtype(self) -> np.dtype[np.void]:
        """The record as a numpy type."""
        return np.dtype(
            {
                "names": [field.name for field in self.fields],
                "formats": [field.dtype for field in self.fields],
                "offsets": [field.offset for field in self.fields],
                "itemsize": self.step,
            }
        )

    @property
    def record(self) -> RecordLayout | None:
        """The record as a table for decoders; None if one of its fields is computed here only."""
        return None if any(field.values for field in self.fields) else self._record

    @property
    def _record(self) -> RecordLayout:
        """The fields that are pieces."""
        pieces: list[RecordPiece] = []
        for field in self.fields:
            kind, source = field.piece
            piece = RecordPiece(kind, field.offset, source, field.size)
            if pieces and _is_continued(pieces[-1], piece):
                pieces[-1] = pieces[-1]._replace(bytes=pieces[-1].bytes + piece.bytes)
            elif kind:
                pieces.append(piece)
        return RecordLayout(self.step, tuple(pieces))

    def ply_head(self, comments: Sequence[str], count: int) -> bytes:
        """Return the header of a PLY file of `count` vertices."""
        # Names of types as of 1994, which all readers know.
        types = {"<f4": "float", "<f8": "double", "<i4": "int", "<u2": "ushort", "u1": "uchar"}
        lines = [
            "ply",
            "format binary_little_endian 1.0",
            *(f"comment {line}" for line in comments),
            f"element vertex {count}",
            *(f"property {types[field.dtype]} {field.name}" for field in self.fields),
            "end_header",
        ]
        return ("\n".join(lines) + "\n").encode()

    def pcd_head(self, comments: Sequence[str], width: int, height: int = 1) -> bytes:
        """Return the header of a PCD file."""
        types = [np.dtype(field.dtype) for field in self.fields]
        lines = [
            "# .PCD v0.7 - Point Cloud Data file format",
            *(f"# {line}" for line in comments),
            "VERSION 0.7",
            f"FIELDS {' '.join(field.name for field in self.fields)}",
            f"SIZE {' '.join(str(one.itemsize) for one in types)}",
            f"TYPE {' '.join(one.kind.upper() for one in types)}",
            f"COUNT {' '.join('1' for _ in types)}",
            f"WIDTH {width}",
            f"HEIGHT {height}",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {width * height}",
            "DATA binary",
        ]
        return ("\n".join(lines) + "\n").encode()

    def pack(self, scan: Scan, out: Records) -> None:
        """Fill `out`, records of this layout: (p,), or (slots, n) of an organized scan."""
        if scan.range_m is None and any(field.piece[0] == "range_mm_u4" for field in self.fields):
            raise ExportError(
                "point layout: expected ranges in the scan, found none; please report this"
            )
        packer = RecordPacker(self._record, has_reflectivity=scan.reflectivity is not None)
        packer.pack(scan, out.reshape(-1).view(np.uint8))
        computed = [(field.name, field.values) for field in self.fields if field.values]
        if not computed:
            return
        points = _points_of(scan)
        rows, *rest = points.ring.shape
        block_rows = max(1, _BLOCK_POINTS // max(1, math.prod(rest)))
        for start in range(0, rows, block_rows):
            rows_of_block = slice(start, start + block_rows)
            block = points.take(rows_of_block)
            for name, values in computed:
                out[name][rows_of_block] = values(block)


class ScanRecords:
    """Scans as records: packed by the decoder, or here in a buffer that is used again."""

    def __init__(self, layout: Layout | RecordLayout) -> None:
        self._layout = layout
        self._buffer = np.zeros(0, np.uint8)

    def of(self, scan: Scan) -> PackedPoints:
        """Return the records of a scan; valid until the next call."""
        if scan.packed is not None:
            return scan.packed
        layout = self._layout
        if isinstance(layout, RecordLayout) and layout.plain and scan.reflectivity is None:
            layout = layout.plain
        shape = scan.time_ns.T.shape
        end = PACKED_ROOM + math.prod(shape) * layout.step
        if len(self._buffer) <= end:
            # Zeros: what is between fields is never written.
            self._buffer = np.zeros(end * 5 // 4, np.uint8)
        records = self._buffer[PACKED_ROOM:end]
        if isinstance(layout, Layout):
            layout.pack(scan, records.view(layout.dtype).reshape(shape))
            return PackedPoints(self._buffer, PACKED_ROOM, end, shape)
        packer = RecordPacker(layout)
        packer.pack(scan, records)
        return PackedPoints(self._buffer, PACKED_ROOM, end, shape, packer.totals)


def record_bytes(packed: PackedPoints) -> memoryview:
    """Return the records alone."""
    return packed.buffer[packed.begin : packed.end].data


def _is_continued(first: RecordPiece, second: RecordPiece) -> bool:
    """Return whether two pieces are one copy."""
    return (
        first.kind == second.kind
        and first.kind in _COPIES
        and first.offset + first.bytes == second.offset
        and first.source + first.bytes == second.source
    )


def _in_sensor(points: Points) -> list[F64Array]:
    """Return x, y and z, m, of every point in the frame of its sensor; poses are rigid."""
    poses = np.stack([sensor.body_from_sensor for sensor in points.sensors])
    sensor = points.lidar_id
    offset = [points.xyz[..., axis] - poses[:, axis, 3][sensor] for axis in range(3)]
    # The inverse of a rotation is its transpose: columns of the matrix are the sensor's axes.
    return [
        poses[:, 0, axis][sensor] * offset[0]
        + poses[:, 1, axis][sensor] * offset[1]
        + poses[:, 2, axis][sensor] * offset[2]
        for axis in range(3)
    ]


def _azimuth(points: Points) -> Values:
    """Return the azimuth, rad, from x to y."""
    x, y, _ = _in_sensor(points)
    return np.arctan2(y, x)


def _elevation(points: Points) -> Values:
    """Return the elevation, rad, upwards from the xy plane."""
    x, y, z = _in_sensor(points)
    angle: F64Array = np.arctan2(z, np.sqrt(x * x + y * y))
    return angle


def _distance(points: Points) -> Values:
    """Return the distance from the sensor's origin, m."""
    x, y, z = _in_sensor(points)
    return np.sqrt(x * x + y * y + z * z)


def _channel(points: Points) -> Values:
    bases = np.array([sensor.ring_base for sensor in points.sensors], dtype=np.uint16)
    base = bases[points.lidar_id]
    # Empty slots of an organized scan have ring 0 for every sensor.
    return np.where(points.ring < base, np.uint16(0), points.ring - base)


def _byte_intensity(points: Points) -> F32Array | U16Array:
    """Return what 8-bit layouts store as intensity: reflectivity where a sensor has it.

    Reflectivity has the range of 8 bits; the signal of the same sensors exceeds it.
    """
    if points.reflectivity is None:
        return points.intensity
    has_reflectivity = np.array([sensor.has_reflectivity for sensor in points.sensors])
    if has_reflectivity.all():
        return points.reflectivity
    reflectivity = points.reflectivity.astype(np.float32)
    return np.where(has_reflectivity[points.lidar_id], reflectivity, points.intensity)


def _intensity_u8(points: Points) -> Values:
    value: Values = np.clip(np.nan_to_num(_byte_intensity(points)), 0, _MAX_U8)
    return value


def clipped_points(scan: Scan) -> list[int]:
    """Return the number of points, by sensor, whose intensity is outside the range of 8 bits."""
    points = _points_of(scan)
    intensity = _byte_intensity(points)
    # Empty slots of organized scans are NaN, which compares as False.
    outside = (intensity < 0) | (intensity > _MAX_U8)
    counts: list[int] = np.bincount(
        points.lidar_id[outside], minlength=len(points.sensors)
    ).tolist()
    return counts


_XYZ = (
    Field("x", "<f4", 0, ("point", 0)),
    Field("y", "<f4", 4, ("point", 4)),
    Field("z", "<f4", 8, ("point", 8)),
)


def _intensity(offset: int) -> Field:
    return Field("intensity", "<f4", offset, ("point", 12))


def _ring(offset: int) -> Field:
    return Field("ring", "<u2", offset, ("label", 4))


def _time(offset: int) -> Field:
    return Field("time", "<f4", offset, ("seconds_f4", 0))


def _time_ns(name: str, offset: int) -> Field:
    return Field(name, "<u4", offset, ("label", 0))


def _return_type(offset: int) -> Field:
    return Field("return_type", "u1", offset, ("label", 6))


def _lidar_id(offset: int) -> Field:
    return Field("lidar_id", "u1", offset, ("label", 7))


_STANDARD = (*_XYZ, _intensity(12), _time(16), _ring(20), _return_type(22), _lidar_id(23))
_VELODYNE = (*_XYZ, _intensity(12), _ring(16), _time(18))
_OUSTER = (
    *_XYZ,
    _intensity(16),
    _time_ns("t", 20),
    Field("reflectivity", "<u2", 24, ("reflectivity", 0)),
    _ring(26),
    # Near infrared is not part of a scan; PCL needs the field, it is 0.
    Field("ambient", "<u2", 28),
    Field("range", "<u4", 32, ("range_mm_u4", 0)),
)
_HESAI = (
    *_XYZ,
    _intensity(12),
    _ring(16),
    Field("timestamp", "<f8", 18, ("stamp_f8", 0)),
)
_AUTOWARE = (
    *_XYZ,
    Field("intensity", "u1", 12, values=_intensity_u8),
    _return_type(13),
    Field("channel", "<u2", 14, values=_channel),
    Field("azimuth", "<f4", 16, values=_azimuth),
    Field("elevation", "<f4", 20, values=_elevation),
    Field("distance", "<f4", 24, values=_distance),
    _time_ns("time_stamp", 28),
)
_PLY = (
    *_XYZ,
    _intensity(12),
    Field("time", "<f8", 16, ("seconds_f8", 0)),
    Field("ring", "<i4", 24, ("ring_i4", 0)),
    _return_type(28),
    _lidar_id(29),
)

# Presets of `--point-layout`.
CLOUD_LAYOUTS = {
    layout.name: layout
    for layout in (
        Layout("standard", 24, _STANDARD),
        Layout("velodyne", 22, _VELODYNE),
        Layout("ouster", 48, _OUSTER, frozenset({"reflectivity", "range_m"})),
        Layout("hesai", 26, _HESAI),
        Layout("autoware", 32, _AUTOWARE, frozenset({"reflectivity", BYTE_INTENSITY})),
        Layout("kiss-icp", 16, (*_XYZ, _time(12))),
        Layout("minimal", 12, _XYZ),
    )
}
PLY_LAYOUT = Layout("ply", 30, _PLY)
# CloudCompare keeps properties whose name contains `scal`, and shows the rest of the name.
_SCALARS = tuple(field._replace(name=f"scalar_{field.name}") for field in _PLY[3:])
# small_gicp reads four floats per vertex, whatever the header says.
_FLOATS = (*_XYZ, _time(12))
# By the styles of `--ply-style`.
PLY_LAYOUTS = {
    "standard": PLY_LAYOUT,
    "cloudcompare": Layout("ply-cloudcompare", 30, (*_XYZ, *_SCALARS)),
    "float": Layout("ply-float", 16, _FLOATS),
}


def _map_layout(name: str, kind: str, end: int) -> Layout:
    """Points of a map, with times of the clock; kind: of x, y and z, which the writer fills in."""
    fields = (
        *(Field(axis, kind, at * end // 3) for at, axis in enumerate("xyz")),
        *(_intensity(end), Field("time", "<f8", end + 4, ("stamp_f8", 0))),
        *(_ring(end + 12), _return_type(end + 14), _lidar_id(end + 15)),
    )
    return Layout(name, end + 16, fields)


MAP_PLY = _map_layout("map-ply", "<f8", 24)
MAP_PCD = _map_layout("map-pcd", "<f4", 12)
# Rows of float32 alone: of KITTI, of nuScenes, and of its times.
ROWS_KITTI = Layout("kitti", 16, (*_XYZ, _intensity(12)))
ROWS_NUSCENES = Layout(
    "nuscenes", 20, (*_XYZ, _intensity(12), Field("ring", "<f4", 16, ("ring_f4", 0)))
)
ROWS_TIME = Layout("time", 8, (_time(0), Field("lidar_id", "<f4", 4, ("lidar_f4", 0))))
