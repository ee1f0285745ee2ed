"""Point records: which field lies where and how it is filled (facts/outputs.md, sections 2, 3, 5).

A layout is a table; `Layout.pack` fills records of any layout block by block, so that the strided
writes of a block stay in the processor's cache.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, cast

import numpy as np
import numpy.typing as npt

from mlbatch.errors import ExportError
from mlbatch.types import (
    F32Array,
    F64Array,
    I64Array,
    Scan,
    SensorInfo,
    U8Array,
    U16Array,
    U32Array,
)
from mlbatch.units import MM_PER_M, NS_PER_S

Values: TypeAlias = npt.NDArray[np.generic]
# Four float32 as one item, whatever they mean; time_ns, ring, return type and sensor as one; the
# last two of them as one.
REALS, LABEL, PAIR = "<c16", "<u8", "<u2"
_PARTS = {REALS: (0, 4, 8, 12), LABEL: (0, 4, 6, 7)}


@dataclass(frozen=True, slots=True)
class Points:
    """The point arrays of a scan in the order of the file: (p,), or (slots, n) when organized.

    reals: x, y, z and intensity, labels: time_ns, ring, return_type and lidar_id of every point in
    one word, None where they do not lie side by side.
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
        """The points in `rows` of the first axis."""
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
    """The points of a scan; organized ones are turned so that a column is a column of the image."""
    turned = scan.info.layout == "organized"
    reflectivity, range_m = scan.reflectivity, scan.range_m
    x, y, z = (scan.xyz[..., axis] for axis in range(3))
    reals = _as_one(REALS, x, y, z, scan.intensity)
    labels = _as_one(LABEL, scan.time_ns, scan.ring, scan.return_type, scan.lidar_id)
    return Points(
        scan.info.sensors,
        scan.start_ns,
        scan.xyz.transpose(1, 0, 2) if turned else scan.xyz,
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


def _as_one(word: str, *parts: Values) -> Values | None:
    """Arrays whose items lie side by side in one array, as items of this type; None if they don't.

    That array is what they are all views of: its rows are words, or end with the parts of one.
    """
    base, first, size = parts[0].base, parts[0], np.dtype(word).itemsize
    if not isinstance(base, np.ndarray) or not base.flags.c_contiguous:
        return None
    steps = _steps(first.shape, base, size)
    if steps != first.strides or any(part.base is not base for part in parts):
        return None
    begin = base.__array_interface__["data"][0]
    at = [part.__array_interface__["data"][0] - begin for part in parts]
    if at != list(_PARTS[word]) or any(part.strides != steps for part in parts):
        return None
    words: Values = base.reshape(-1).view(word).reshape(base.shape[: first.ndim])
    return words[: len(first)]


def _steps(shape: tuple[int, ...], base: Values, size: int) -> tuple[int, ...] | None:
    """Steps of views of this shape if the base's rows are words of this size, else None."""
    deep = len(shape)
    if base.ndim < deep or base.shape[1:deep] != shape[1:]:
        return None
    steps = base.strides[:deep]
    return steps if steps and steps[-1] == size else None


Records: TypeAlias = npt.NDArray[np.void]
_Fill: TypeAlias = Callable[[Points], Values]

BLOCK_POINTS = 8192
# The lowest 29 of the 52 mantissa bits of a float64 are those a float32 has no room for.
_FLOAT32_BITS = np.uint64(2**64 - 2**29)
_MAX_U8 = 255


def seconds(time_ns: U32Array) -> F64Array:
    """Nanoseconds as the nearest float64 seconds."""
    return np.divide(time_ns, NS_PER_S, dtype=np.float64)


def seconds_toward_zero(time_ns: U32Array) -> F64Array:
    """Seconds that a float32 holds exactly and that never exceed the true time.

    Rounding up could put a point past its scan's end. The division cannot cross a float32 value:
    ns/1e9 lies on it or further away than a float64 rounds.
    """
    value = seconds(time_ns)
    bits = value.view(np.uint64)
    bits &= _FLOAT32_BITS
    return value


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a record; `dtype` little endian, `values` gives its values in any type."""

    name: str
    dtype: str
    offset: int
    values: Callable[[Points], Values]


@dataclass(frozen=True, slots=True)
class Wide:
    """Several fields that move as one; `values` gives None where a scan does not allow it.

    parts: name, offset and type of each; spoilt: that which is filled on its own after the move.
    """

    dtype: str
    parts: tuple[tuple[str, int, str], ...]
    values: Callable[[Points], Values | None]
    spoilt: str = ""

    def at(self, fields: Sequence[Field]) -> int | None:
        """Offset in records of these fields, None where the parts do not lie so."""
        places = {field.name: field for field in fields}
        first = places.get(self.parts[0][0])
        for name, offset, dtype in self.parts:
            field = places.get(name)
            if first is None or field is None:
                return None
            if (field.offset - first.offset, field.dtype) != (offset, dtype):
                return None
        return None if first is None else first.offset


def _pair(points: Points) -> Values | None:
    """Return type and sensor: the last two of the eight bytes of a label."""
    if points.labels is None:
        return None
    last: Values = np.right_shift(points.labels, np.uint64(48)).astype(PAIR)
    return last


_PAIR_PARTS = (("return_type", 0, "u1"), ("lidar_id", 1, "u1"))
_WIDE = (
    Wide(
        REALS,
        (("x", 0, "<f4"), ("y", 4, "<f4"), ("z", 8, "<f4"), ("intensity", 12, "<f4")),
        lambda points: points.reals,
    ),
    Wide(
        LABEL,
        (("time", 0, "<f4"), ("ring", 4, "<u2"), ("return_type", 6, "u1"), ("lidar_id", 7, "u1")),
        lambda points: points.labels,
        spoilt="time",
    ),
    Wide(PAIR, _PAIR_PARTS, _pair),
)


@dataclass(frozen=True, slots=True)
class Layout:
    """Fields of a point record of `step` bytes; bytes between fields are zero.

    extras: those of `types.EXTRAS` that the fields are made of.
    """

    name: str
    step: int
    fields: tuple[Field, ...]
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

    def pack(self, points: Points, out: Records) -> None:
        """Fill `out`, records of this layout in the shape of the point arrays."""
        rows, *rest = points.time_ns.shape
        step = max(1, BLOCK_POINTS // max(1, math.prod(rest)))
        moves = [(out.view(place)["value"], values) for place, values in self._moves(points)]
        for start in range(0, rows, step):
            block = points.take(slice(start, start + step))
            for target, values in moves:
                target[start : start + step] = values(block)

    def _moves(self, points: Points) -> list[tuple[np.dtype[np.void], _Fill]]:
        """What fills records one after the other: the place of a field in a record, its values."""
        left = list(self.fields)
        moves = []
        for wide in _WIDE:
            offset = wide.at(left)
            if offset is None or wide.values(points.take(slice(0))) is None:
                continue
            names = {name for name, _, _ in wide.parts} - {wide.spoilt}
            left = [field for field in left if field.name not in names]
            moves.append((self._place(wide.dtype, offset), cast(_Fill, wide.values)))
        return moves + [(self._place(f.dtype, f.offset), f.values) for f in left]

    def _place(self, dtype: str, offset: int) -> np.dtype[np.void]:
        """A record in which nothing but one place is known."""
        return np.dtype(
            {
                "names": ["value"],
                "formats": [dtype],
                "offsets": [offset],
                "itemsize": self.step,
            }
        )


def _in_sensor(points: Points) -> list[F64Array]:
    """x, y and z, m, of every point in the frame of its sensor; poses are rigid."""
    poses = np.stack([sensor.body_from_sensor for sensor in points.sensors])
    which = points.lidar_id
    offset = [points.xyz[..., axis] - poses[:, axis, 3][which] for axis in range(3)]
    # The inverse of a rotation is its transpose: columns of the matrix are the sensor's axes.
    return [
        poses[:, 0, axis][which] * offset[0]
        + poses[:, 1, axis][which] * offset[1]
        + poses[:, 2, axis][which] * offset[2]
        for axis in range(3)
    ]


def _azimuth(points: Points) -> Values:
    """rad, from x to y."""
    x, y, _ = _in_sensor(points)
    return np.arctan2(y, x)


def _elevation(points: Points) -> Values:
    """rad, upwards from the xy plane."""
    x, y, z = _in_sensor(points)
    angle: F64Array = np.arctan2(z, np.sqrt(x * x + y * y))
    return angle


def _distance(points: Points) -> Values:
    """m, from the sensor's origin."""
    x, y, z = _in_sensor(points)
    return np.sqrt(x * x + y * y + z * z)


def _channel(points: Points) -> Values:
    bases = np.array([sensor.ring_base for sensor in points.sensors], dtype=np.uint16)
    base = bases[points.lidar_id]
    # Empty slots of an organized scan have ring 0 whatever the sensor.
    return np.where(points.ring < base, np.uint16(0), points.ring - base)


def _reflectivity(points: Points) -> Values:
    return np.zeros_like(points.ring) if points.reflectivity is None else points.reflectivity


def _range_mm(points: Points) -> Values:
    if points.range_m is None:
        raise ExportError("point layout with ranges: wanted them decoded, got none; please report")
    range_mm: F64Array = np.multiply(np.nan_to_num(points.range_m), MM_PER_M, dtype=np.float64)
    np.rint(range_mm, out=range_mm)
    return range_mm


def _intensity_u8(points: Points) -> Values:
    return np.clip(np.nan_to_num(points.intensity), 0, _MAX_U8)


def _seconds_absolute(points: Points) -> Values:
    # A float64 of seconds since 1970 only resolves 0.24 us: it is rounded once, in the last sum.
    whole_s, rest_ns = divmod(points.start_ns, NS_PER_S)
    stamp_ns: I64Array = np.add(points.time_ns, rest_ns, dtype=np.int64)
    stamp_s: F64Array = np.divide(stamp_ns, NS_PER_S, dtype=np.float64)
    return np.add(stamp_s, whole_s, out=stamp_s)


_XYZ = (
    Field("x", "<f4", 0, lambda points: points.xyz[..., 0]),
    Field("y", "<f4", 4, lambda points: points.xyz[..., 1]),
    Field("z", "<f4", 8, lambda points: points.xyz[..., 2]),
)


def _intensity(offset: int) -> Field:
    return Field("intensity", "<f4", offset, lambda points: points.intensity)


def _ring(offset: int, dtype: str = "<u2") -> Field:
    return Field("ring", dtype, offset, lambda points: points.ring)


def _time(offset: int) -> Field:
    return Field("time", "<f4", offset, lambda points: seconds_toward_zero(points.time_ns))


def _time_ns(name: str, offset: int) -> Field:
    return Field(name, "<u4", offset, lambda points: points.time_ns)


def _return_type(offset: int) -> Field:
    return Field("return_type", "u1", offset, lambda points: points.return_type)


def _lidar_id(offset: int) -> Field:
    return Field("lidar_id", "u1", offset, lambda points: points.lidar_id)


_STANDARD = (*_XYZ, _intensity(12), _time(16), _ring(20), _return_type(22), _lidar_id(23))
_VELODYNE = (*_XYZ, _intensity(12), _ring(16), _time(18))
_OUSTER = (
    *_XYZ,
    _intensity(16),
    _time_ns("t", 20),
    Field("reflectivity", "<u2", 24, _reflectivity),
    _ring(26),
    # Near infrared light is not part of a scan; the field must be there for PCL, at 0.
    Field("ambient", "<u2", 28, lambda points: np.zeros_like(points.ring)),
    Field("range", "<u4", 32, _range_mm),
)
_HESAI = (*_XYZ, _intensity(12), _ring(16), Field("timestamp", "<f8", 18, _seconds_absolute))
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
    Field("time", "<f8", 16, lambda points: seconds(points.time_ns)),
    _ring(24, "<i4"),
    _return_type(28),
    _lidar_id(29),
)

# Presets of `--point-layout`: facts/outputs.md, section 3.
CLOUD_LAYOUTS = {
    layout.name: layout
    for layout in (
        Layout("standard", 24, _STANDARD),
        Layout("velodyne", 22, _VELODYNE),
        Layout("ouster", 48, _OUSTER, frozenset({"reflectivity", "range_m"})),
        Layout("hesai", 26, _HESAI),
        Layout("autoware", 32, _AUTOWARE),
        Layout("kiss-icp", 16, (*_XYZ, _time(12))),
        Layout("minimal", 12, _XYZ),
    )
}
# Section 5 of the same page.
PLY_LAYOUT = Layout("ply", 30, _PLY)
