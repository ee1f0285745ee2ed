"""Layouts of point records as tables, and how records are filled (docs/sources/outputs.md).

Fields are pieces of the compiled packer (`native/pack.c`), or computed by numpy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, F64Array, U16Array
from mlbatch.decode.records import RecordPacker
from mlbatch.errors import ExportError
from mlbatch.types import (
    BYTE_INTENSITY,
    PACKED_ROOM,
    PackedPoints,
    RecordLayout,
    RecordPiece,
    Scan,
)

Values: TypeAlias = npt.NDArray[np.generic]
Records: TypeAlias = npt.NDArray[np.void]
# Kinds of pieces that are copies.
_COPIES = ("point", "label", "reflectivity")


_MAX_U8 = 255


class Field(NamedTuple):
    """One field of a record: a piece, or values that only numpy computes."""

    name: str
    dtype: str  # little endian
    offset: int  # bytes
    piece: tuple[str, int] = ("", 0)  # kind and source of a `RecordPiece`; "": it is 0
    values: Callable[[Scan], Values] | None = None  # of any type that converts to `dtype`

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
        for field in self.fields:
            if field.values:
                out[field.name] = field.values(scan).T


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


def _in_sensor(scan: Scan) -> list[F64Array]:
    """Return x, y and z, m, of every point in the frame of its sensor; poses are rigid."""
    poses = np.stack([sensor.body_from_sensor for sensor in scan.info.sensors])
    sensor = scan.lidar_id
    offset = [scan.xyz[..., axis] - poses[:, axis, 3][sensor] for axis in range(3)]
    # The inverse of a rotation is its transpose: columns of the matrix are the sensor's axes.
    return [
        poses[:, 0, axis][sensor] * offset[0]
        + poses[:, 1, axis][sensor] * offset[1]
        + poses[:, 2, axis][sensor] * offset[2]
        for axis in range(3)
    ]


def _azimuth(scan: Scan) -> Values:
    """Return the azimuth, rad, from x to y."""
    x, y, _ = _in_sensor(scan)
    return np.arctan2(y, x)


def _elevation(scan: Scan) -> Values:
    """Return the elevation, rad, upwards from the xy plane."""
    x, y, z = _in_sensor(scan)
    angle: F64Array = np.arctan2(z, np.sqrt(x * x + y * y))
    return angle


def _distance(scan: Scan) -> Values:
    """Return the distance from the sensor's origin, m."""
    x, y, z = _in_sensor(scan)
    return np.sqrt(x * x + y * y + z * z)


def _channel(scan: Scan) -> Values:
    bases = np.array([sensor.ring_base for sensor in scan.info.sensors], dtype=np.uint16)
    base = bases[scan.lidar_id]
    # Empty slots of an organized scan have ring 0 for every sensor.
    return np.where(scan.ring < base, np.uint16(0), scan.ring - base)


def _byte_intensity(scan: Scan) -> F32Array | U16Array:
    """Return what 8-bit layouts store as intensity: reflectivity where a sensor has it.

    Reflectivity has the range of 8 bits; the signal of the same sensors exceeds it.
    """
    if scan.reflectivity is None:
        return scan.intensity
    has_reflectivity = np.array([sensor.has_reflectivity for sensor in scan.info.sensors])
    if has_reflectivity.all():
        return scan.reflectivity
    reflectivity = scan.reflectivity.astype(np.float32)
    return np.where(has_reflectivity[scan.lidar_id], reflectivity, scan.intensity)


def _intensity_u8(scan: Scan) -> Values:
    value: Values = np.clip(np.nan_to_num(_byte_intensity(scan)), 0, _MAX_U8)
    return value


def clipped_points(scan: Scan) -> list[int]:
    """Return the number of points, by sensor, whose intensity is outside the range of 8 bits."""
    intensity = _byte_intensity(scan)
    # Empty slots of organized scans are NaN, which compares as False.
    outside = (intensity < 0) | (intensity > _MAX_U8)
    owners = scan.lidar_id[outside]
    counts: list[int] = np.bincount(owners, minlength=len(scan.info.sensors)).tolist()
    return counts


# Values of fields; of no piece the writer fills in x, y and z, and all else is 0.
_VALUES = {
    value.name: value
    for value in (
        Field("x", "<f4", 0, ("point", 0)),
        Field("y", "<f4", 0, ("point", 4)),
        Field("z", "<f4", 0, ("point", 8)),
        Field("intensity", "<f4", 0, ("point", 12)),
        Field("time", "<f4", 0, ("seconds_f4", 0)),
        Field("time_f8", "<f8", 0, ("seconds_f8", 0)),
        Field("time_ns", "<u4", 0, ("label", 0)),
        Field("stamp", "<f8", 0, ("stamp_f8", 0)),
        Field("ring", "<u2", 0, ("label", 4)),
        Field("ring_i4", "<i4", 0, ("ring_i4", 0)),
        Field("ring_f4", "<f4", 0, ("ring_f4", 0)),
        Field("return_type", "u1", 0, ("label", 6)),
        Field("lidar_id", "u1", 0, ("label", 7)),
        Field("lidar_f4", "<f4", 0, ("lidar_f4", 0)),
        Field("reflectivity", "<u2", 0, ("reflectivity", 0)),
        Field("range_mm", "<u4", 0, ("range_mm_u4", 0)),
        Field("u2", "<u2", 0),
        Field("f4", "<f4", 0),
        Field("f8", "<f8", 0),
        Field("intensity_u8", "u1", 0, values=_intensity_u8),
        Field("channel", "<u2", 0, values=_channel),
        Field("azimuth", "<f4", 0, values=_azimuth),
        Field("elevation", "<f4", 0, values=_elevation),
        Field("distance", "<f4", 0, values=_distance),
    )
}


def _layout(name: str, text: str, extras: Sequence[str] = (), step: int = 0) -> Layout:
    """Return a layout of fields `name=value@offset` that follow each other.

    value: as above, where it is not the name; offset: after a gap; step: if bytes follow.
    """
    fields: list[Field] = []
    end = 0
    for word in text.split():
        named, _, offset = word.partition("@")
        field, _, value = named.partition("=")
        begin = int(offset or end)
        fields.append(_VALUES[value or field]._replace(name=field, offset=begin))
        end = begin + fields[-1].size
    return Layout(name, step or end, tuple(fields), frozenset(extras))


_STANDARD = "x y z intensity time ring return_type lidar_id"
# Presets of `--point-layout`. Near infrared (ambient) is not part of a scan; PCL needs the field.
CLOUD_LAYOUTS = {
    layout.name: layout
    for layout in (
        _layout("standard", _STANDARD),
        _layout("velodyne", "x y z intensity ring time"),
        _layout(
            "ouster",
            "x y z intensity@16 t=time_ns reflectivity ring ambient=u2 range=range_mm@32",
            ("reflectivity", "range_m"),
            48,
        ),
        _layout("hesai", "x y z intensity ring timestamp=stamp"),
        _layout(
            "autoware",
            "x y z intensity=intensity_u8 return_type channel azimuth elevation distance "
            "time_stamp=time_ns",
            ("reflectivity", BYTE_INTENSITY),
        ),
        _layout("kiss-icp", "x y z time"),
        _layout("minimal", "x y z"),
    )
}
PLY_LAYOUT = _layout("ply", "x y z intensity time=time_f8 ring=ring_i4 return_type lidar_id")
# By the styles of `--ply-style`.
PLY_LAYOUTS = {
    "standard": PLY_LAYOUT,
    # CloudCompare keeps properties whose name contains `scal`, and shows the rest of the name.
    "cloudcompare": Layout(
        "ply-cloudcompare",
        PLY_LAYOUT.step,
        (
            *PLY_LAYOUT.fields[:3],
            *(field._replace(name=f"scalar_{field.name}") for field in PLY_LAYOUT.fields[3:]),
        ),
    ),
    # small_gicp reads four floats per vertex, whatever the header says.
    "float": _layout("ply-float", "x y z time"),
}
# Points of a map, with times of the clock; the writer fills in x, y and z.
_OF_MAP = "intensity time=stamp ring return_type lidar_id"
MAP_PLY = _layout("map-ply", f"x=f8 y=f8 z=f8 {_OF_MAP}")
MAP_PCD = _layout("map-pcd", f"x=f4 y=f4 z=f4 {_OF_MAP}")
# Rows of float32 alone: of KITTI, of nuScenes, and of its times.
ROWS_KITTI = _layout("kitti", "x y z intensity")
ROWS_NUSCENES = _layout("nuscenes", "x y z intensity ring=ring_f4")
ROWS_TIME = _layout("time", "time lidar_id=lidar_f4")
