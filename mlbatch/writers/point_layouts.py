"""Layouts of point records as tables, and how records are filled (docs/sources/outputs.md).

`Layout.pack` fills records of any layout block by block, so that the strided writes of a block stay
in the processor's cache. Decoders put the values of a point side by side in memory; where a record
has them side by side as well, they are copied as one wide word, in a fraction of the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array, U16Array, U32Array
from mlbatch.errors import ExportError
from mlbatch.types import BYTE_INTENSITY, RecordLayout, RecordPiece, Scan, SensorInfo
from mlbatch.units import MM_PER_M, NS_PER_S

Values: TypeAlias = npt.NDArray[np.generic]
# Types of wide words; what their parts are in memory.
REALS = "<c16"  # x, y, z, intensity: four float32
LABEL = "<u8"  # time_ns, ring, return_type, lidar_id
PAIR = "<u2"  # return_type, lidar_id
# Kinds of pieces that are copies; the piece of a field that is always zero.
_COPIES = ("point", "label", "reflectivity")
_ZERO = ("", 0)
# Offsets of the parts, bytes.
_PARTS = {REALS: (0, 4, 8, 12), LABEL: (0, 4, 6, 7)}


class Points(NamedTuple):
    """The point arrays of a scan in the order of the file: (p,), or (slots, n) when organized.

    reals, labels: the same values as wide words `REALS` and `LABEL`; None if the arrays are not
    side by side in memory.
    """

    sensors: tuple[SensorInfo, ...]
    start_ns: int
    xyz: F32Array
    intensity: F32Array
    reflectivity: U16Array | None
    range_m: F32Array | None
    time_ns: U32Array
    ring: U16Array
    return_type: U8Array
    lidar_id: U8Array
    reals: Values | None = None
    labels: Values | None = None

    def take(self, rows: slice) -> Points:
        """Return the points in `rows` of the first axis."""
        return Points(
            self.sensors,
            self.start_ns,
            self.xyz[rows],
            self.intensity[rows],
            None if self.reflectivity is None else self.reflectivity[rows],
            None if self.range_m is None else self.range_m[rows],
            self.time_ns[rows],
            self.ring[rows],
            self.return_type[rows],
            self.lidar_id[rows],
            None if self.reals is None else self.reals[rows],
            None if self.labels is None else self.labels[rows],
        )


def points_of(scan: Scan) -> Points:
    """Return the points of a scan; organized ones are transposed to rows of slots."""
    organized = scan.info.layout == "organized"
    reflectivity = scan.reflectivity
    range_m = scan.range_m
    x, y, z = (scan.xyz[..., axis] for axis in range(3))
    reals = _as_words(REALS, x, y, z, scan.intensity)
    labels = _as_words(LABEL, scan.time_ns, scan.ring, scan.return_type, scan.lidar_id)
    return Points(
        scan.info.sensors,
        scan.start_ns,
        scan.xyz.transpose(1, 0, 2) if organized else scan.xyz,
        scan.intensity.T,
        None if reflectivity is None else reflectivity.T,
        None if range_m is None else range_m.T,
        scan.time_ns.T,
        scan.ring.T,
        scan.return_type.T,
        scan.lidar_id.T,
        None if reals is None else reals.T,
        None if labels is None else labels.T,
    )


def _as_words(word: str, *parts: Values) -> Values | None:
    """Return arrays with items side by side as one array of wide words; None if they are not.

    The parts are views of one array, with a row of words for each row of items.
    """
    first = parts[0]
    base = first.base
    if not isinstance(base, np.ndarray) or not base.flags.c_contiguous:
        return None
    strides = _word_strides(first.shape, base, np.dtype(word).itemsize)
    if strides is None:
        return None
    if any(part.base is not base or part.strides != strides for part in parts):
        return None
    begin = base.__array_interface__["data"][0]
    offsets = [part.__array_interface__["data"][0] - begin for part in parts]
    if offsets != list(_PARTS[word]):
        return None
    words: Values = base.reshape(-1).view(word).reshape(base.shape[: first.ndim])
    return words[: len(first)]


def _word_strides(shape: tuple[int, ...], base: Values, size: int) -> tuple[int, ...] | None:
    """Return the strides of views of this shape if rows of `base` are words of `size` bytes."""
    depth = len(shape)
    if base.ndim < depth or base.shape[1:depth] != shape[1:]:
        return None
    strides = base.strides[:depth]
    return strides if strides and strides[-1] == size else None


Records: TypeAlias = npt.NDArray[np.void]
_Fill: TypeAlias = Callable[[Points], Values]

BLOCK_POINTS = 8192
# A float64 has 52 mantissa bits, a float32 the upper 23 of them: mask of the bits to keep.
_FLOAT32_BITS = np.uint64(2**64 - 2**29)
_MAX_U8 = 255


def seconds(time_ns: U32Array) -> F64Array:
    """Convert nanoseconds to the nearest float64 seconds."""
    return np.divide(time_ns, NS_PER_S, dtype=np.float64)


def seconds_toward_zero(time_ns: U32Array) -> F64Array:
    """Convert nanoseconds to seconds that are exact in float32 and never exceed the true time.

    Rounding up could put a point after the end of its scan. The division cannot cross a float32
    value: ns/1e9 is equal to it, or further away than a float64 rounds.
    """
    value = seconds(time_ns)
    bits = value.view(np.uint64)
    bits &= _FLOAT32_BITS
    return value


class Field(NamedTuple):
    """One field of a record."""

    name: str
    dtype: str  # little endian
    offset: int  # bytes
    values: Callable[[Points], Values]  # returns any type that converts to `dtype`
    # Kind and source of a `RecordPiece` of the same bytes; None: only numpy computes it.
    piece: tuple[str, int] | None = None

    @property
    def size(self) -> int:
        """Bytes."""
        return int(self.dtype[-1])


class WideWord(NamedTuple):
    """Several fields that are copied as one."""

    dtype: str
    parts: tuple[tuple[str, int, str], ...]  # name, offset in the word, type
    values: Callable[[Points], Values | None]  # None if the arrays are not side by side
    overwritten: str = ""  # part that is filled on its own after the copy

    def offset_in(self, fields: Sequence[Field]) -> int | None:
        """Return the offset of the word in a record, None if its parts are not side by side."""
        by_name = {field.name: field for field in fields}
        first = by_name.get(self.parts[0][0])
        if first is None:
            return None
        for name, offset, dtype in self.parts:
            field = by_name.get(name)
            if field is None or (field.offset - first.offset, field.dtype) != (offset, dtype):
                return None
        return first.offset


def _pair(points: Points) -> Values | None:
    """Return the last two of the eight bytes of a label: return type and sensor."""
    if points.labels is None:
        return None
    last: Values = np.right_shift(points.labels, np.uint64(48)).astype(PAIR)
    return last


_WIDE_WORDS = (
    WideWord(
        REALS,
        (("x", 0, "<f4"), ("y", 4, "<f4"), ("z", 8, "<f4"), ("intensity", 12, "<f4")),
        lambda points: points.reals,
    ),
    WideWord(
        LABEL,
        (("time", 0, "<f4"), ("ring", 4, "<u2"), ("return_type", 6, "u1"), ("lidar_id", 7, "u1")),
        lambda points: points.labels,
        overwritten="time",
    ),
    WideWord(PAIR, (("return_type", 0, "u1"), ("lidar_id", 1, "u1")), _pair),
)


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
        """The record as a table for engines; None if one of its fields is computed here only."""
        pieces: list[RecordPiece] = []
        for field in self.fields:
            if field.piece is None:
                return None
            kind, source = field.piece
            piece = RecordPiece(kind, field.offset, source, field.size)
            if pieces and _is_continued(pieces[-1], piece):
                pieces[-1] = pieces[-1]._replace(bytes=pieces[-1].bytes + piece.bytes)
            elif kind:
                pieces.append(piece)
        return RecordLayout(self.step, tuple(pieces))

    def pack(self, points: Points, out: Records) -> None:
        """Fill `out`, records of this layout in the shape of the point arrays."""
        rows, *rest = points.time_ns.shape
        block_rows = max(1, BLOCK_POINTS // max(1, math.prod(rest)))
        copies = [(out.view(place)["value"], values) for place, values in self._copies(points)]
        for start in range(0, rows, block_rows):
            rows_of_block = slice(start, start + block_rows)
            block = points.take(rows_of_block)
            for target, values in copies:
                target[rows_of_block] = values(block)

    def _copies(self, points: Points) -> list[tuple[np.dtype[np.void], _Fill]]:
        """Return the copies that fill records, in order: the place in a record, and its values."""
        fields = list(self.fields)
        copies = []
        for wide in _WIDE_WORDS:
            offset = wide.offset_in(fields)
            if offset is None or wide.values(points.take(slice(0))) is None:
                continue
            names = {name for name, _, _ in wide.parts} - {wide.overwritten}
            fields = [field for field in fields if field.name not in names]
            copies.append((self._place(wide.dtype, offset), cast(_Fill, wide.values)))
        return copies + [(self._place(f.dtype, f.offset), f.values) for f in fields]

    def _place(self, dtype: str, offset: int) -> np.dtype[np.void]:
        """Return a record type whose only field, `value`, is at an offset."""
        return np.dtype(
            {
                "names": ["value"],
                "formats": [dtype],
                "offsets": [offset],
                "itemsize": self.step,
            }
        )


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


def _reflectivity(points: Points) -> Values:
    return np.zeros_like(points.ring) if points.reflectivity is None else points.reflectivity


def _range_mm(points: Points) -> Values:
    if points.range_m is None:
        raise ExportError(
            "point layout: expected ranges in the scan, found none; please report this"
        )
    range_mm: F64Array = np.multiply(np.nan_to_num(points.range_m), MM_PER_M, dtype=np.float64)
    np.rint(range_mm, out=range_mm)
    return range_mm


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
    points = points_of(scan)
    intensity = _byte_intensity(points)
    # Empty slots of organized scans are NaN, which compares as False.
    outside = (intensity < 0) | (intensity > _MAX_U8)
    counts: list[int] = np.bincount(
        points.lidar_id[outside], minlength=len(points.sensors)
    ).tolist()
    return counts


def _seconds_absolute(points: Points) -> Values:
    # A float64 of seconds since 1970 resolves 0.24 us only: round once, in the last sum.
    whole_s, rest_ns = divmod(points.start_ns, NS_PER_S)
    stamp_ns: I64Array = np.add(points.time_ns, rest_ns, dtype=np.int64)
    stamp_s: F64Array = np.divide(stamp_ns, NS_PER_S, dtype=np.float64)
    return np.add(stamp_s, whole_s, out=stamp_s)


_XYZ = (
    Field("x", "<f4", 0, lambda points: points.xyz[..., 0], ("point", 0)),
    Field("y", "<f4", 4, lambda points: points.xyz[..., 1], ("point", 4)),
    Field("z", "<f4", 8, lambda points: points.xyz[..., 2], ("point", 8)),
)


def _intensity(offset: int) -> Field:
    return Field("intensity", "<f4", offset, lambda points: points.intensity, ("point", 12))


def _ring(offset: int) -> Field:
    return Field("ring", "<u2", offset, lambda points: points.ring, ("label", 4))


def _time(offset: int) -> Field:
    return Field(
        "time",
        "<f4",
        offset,
        lambda points: seconds_toward_zero(points.time_ns),
        ("seconds_f4", 0),
    )


def _time_ns(name: str, offset: int) -> Field:
    return Field(name, "<u4", offset, lambda points: points.time_ns, ("label", 0))


def _return_type(offset: int) -> Field:
    return Field("return_type", "u1", offset, lambda points: points.return_type, ("label", 6))


def _lidar_id(offset: int) -> Field:
    return Field("lidar_id", "u1", offset, lambda points: points.lidar_id, ("label", 7))


_STANDARD = (*_XYZ, _intensity(12), _time(16), _ring(20), _return_type(22), _lidar_id(23))
_VELODYNE = (*_XYZ, _intensity(12), _ring(16), _time(18))
_OUSTER = (
    *_XYZ,
    _intensity(16),
    _time_ns("t", 20),
    Field("reflectivity", "<u2", 24, _reflectivity, ("reflectivity", 0)),
    _ring(26),
    # Near infrared is not part of a scan; PCL needs the field, it is 0.
    Field("ambient", "<u2", 28, lambda points: np.zeros_like(points.ring), _ZERO),
    Field("range", "<u4", 32, _range_mm, ("range_mm_u4", 0)),
)
_HESAI = (
    *_XYZ,
    _intensity(12),
    _ring(16),
    Field("timestamp", "<f8", 18, _seconds_absolute, ("stamp_f8", 0)),
)
_AUTOWARE = (
    *_XYZ,
    Field("intensity", "u1", 12, _intensity_u8),
    _return_type(13),
    Field("channel", "<u2", 14, _channel),
    Field("azimuth", "<f4", 16, _azimuth),
    Field("elevation", "<f4", 20, _elevation),
    Field("distance", "<f4", 24, _distance),
    _time_ns("time_stamp", 28),
)
_PLY = (
    *_XYZ,
    _intensity(12),
    Field("time", "<f8", 16, lambda points: seconds(points.time_ns), ("seconds_f8", 0)),
    Field("ring", "<i4", 24, lambda points: points.ring, ("ring_i4", 0)),
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
# small_gicp reads four floats a vertex, whatever the header says.
_FLOATS = (*_XYZ, _time(12))
# By the styles of `--ply-style`.
PLY_LAYOUTS = {
    "standard": PLY_LAYOUT,
    "cloudcompare": Layout("ply-cloudcompare", 30, (*_XYZ, *_SCALARS)),
    "float": Layout("ply-float", 16, _FLOATS),
}
