"""Clouds that drivers decoded: sensor_msgs/PointCloud2 and Livox CustomMsg to points with times.

Source: docs/sources/messages.md, sections 1 (CustomMsg), 4 (serialisation) and 8 (fields, times).
Every length is checked against the message's end before it is used. Drivers agree neither on the
unit nor on the zero of the times of points, and state neither in the message: type and values of
the time field decide ("Detection rule" of section 8).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, I64Array
from mlbatch.ros.encoding import Cursor, MessageError
from mlbatch.ros.point_packets import CloudError, Points
from mlbatch.types import Message
from mlbatch.units import NS_PER_S

# A structured array; numpy has no type for the fields of a dtype.
Rows: TypeAlias = npt.NDArray[Any]
# Numbers of the type of a cloud's time field.
Times: TypeAlias = npt.NDArray[Any]
_Whole = TypeVar("_Whole", np.uint8, np.uint16)

# sensor_msgs/PointField: datatype by its number.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_FIELDS = 256
_AXES = ("x", "y", "z")
_TIME_NAMES = ("t", "time", "timestamp", "time_stamp", "timestamps", "offset_time", "ts")
# Names of a field by its role; the first that a cloud has counts.
_ROLES: Mapping[str, tuple[str, ...]] = {
    "time": _TIME_NAMES,
    "intensity": ("intensity", "i", "reflectivity"),
    "ring": ("ring", "channel", "line"),
    "return_type": ("return_type",),
    "tag": ("tag",),
}
_CUSTOM_POINT = np.dtype(
    [
        ("time", "<u4"),
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "u1"),
        ("tag", "u1"),
        ("ring", "u1"),
    ]
)
# In CDR every element begins at a multiple of four; the last has no padding behind it.
_CUSTOM_STEPS = {"cdr": 20, "ros1": 19}


@dataclass(frozen=True, slots=True)
class Cloud:
    """A cloud; time_meaning: unit and zero of its times; frame: frame_id of its points.

    without_place: points left out at NaN, infinity or zero; without_time: those without a finite
    time.
    """

    points: Points
    time_meaning: str
    frame: str
    without_place: int
    without_time: int


@dataclass(frozen=True, slots=True)
class Zero:
    """What times may count from; field: name and type; base: description of base_ns."""

    field: str
    base_ns: int
    base: str


@dataclass(frozen=True, slots=True)
class _Raw:
    """Points of a message before conversion; rows: fields by role; frame: frame_id."""

    rows: Rows
    zero: Zero
    frame: str


def read_cloud(message: Message) -> Cloud:
    """The points of a message; CloudError if they cannot be read."""
    try:
        raw = _READERS[message.topic.type](message)
    except MessageError as err:
        raise CloudError(str(err)) from err
    time = raw.rows["time"]
    reals = _reals(raw.rows)
    x, y, z, _ = reals
    with np.errstate(over="ignore", invalid="ignore"):
        squared = x * x + y * y + z * z
    placed = (squared > 0) & (squared < np.inf)
    keep = placed & np.isfinite(time) if time.dtype.kind == "f" else placed
    rows = raw.rows[keep]
    count = len(rows)
    stamp_ns, meaning = stamps(rows["time"], raw.zero) if count else (np.empty(0, np.int64), "")
    return_type = _whole(rows, "return_type", np.uint8)
    tag = _whole(rows, "tag", np.uint8)
    points = Points(
        stamp_ns,
        reals[:, keep],
        _whole(rows, "ring", np.uint16),
        np.zeros(count, np.uint8) if return_type is None else return_type,
        np.zeros(count, np.uint8) if tag is None else tag,
    )
    without_place = len(keep) - int(np.count_nonzero(placed))
    return Cloud(points, meaning, raw.frame, without_place, len(keep) - count - without_place)


def _reals(rows: Rows) -> F32Array:
    """x, y, z and intensity, (4, n); intensity 0 where there is no finite one."""
    reals = np.zeros((4, len(rows)), np.float32)
    # A place beyond all float32 is infinite, and is left out as such.
    with np.errstate(over="ignore", invalid="ignore"):
        for plane, name in zip(reals, (*_AXES, "intensity"), strict=True):
            if name in (rows.dtype.names or ()):
                plane[:] = rows[name]
    intensity = reals[3]
    intensity[~np.isfinite(intensity)] = 0
    return reals


def _whole(rows: Rows, name: str, kind: type[_Whole]) -> npt.NDArray[_Whole] | None:
    """A field of whole numbers that fit `kind`; None where there is none."""
    if name not in (rows.dtype.names or ()):
        return None
    values = rows[name]
    if values.dtype.kind == "f" or (values < 0).any() or (values > np.iinfo(kind).max).any():
        return None
    return values.astype(kind)


# -- messages -------------------------------------------------------------------------------------


def _cursor(message: Message) -> Cursor:
    return Cursor(message.topic.encoding, message.data, 0, len(message.data))


def _custom(message: Message) -> _Raw:
    """The points of a Livox CustomMsg."""
    cursor = _cursor(message)
    stamp_ns, frame = cursor.header()
    base_ns = cursor.number("Q")
    base = "timebase"
    cursor.number("I")
    cursor.place(4, 1)
    count = cursor.number("I")
    step = _CUSTOM_STEPS[message.topic.encoding]
    at = cursor.place(step * (count - 1) + _CUSTOM_POINT.itemsize if count else 0, 1)
    rows: Rows = np.ndarray((count,), _CUSTOM_POINT, message.data, at, (step,))
    if base_ns == 0:
        base_ns = stamp_ns
        base = "the header's stamp"
    return _Raw(rows, Zero("offset_time (uint32)", base_ns, base), frame)


@dataclass(frozen=True, slots=True)
class _Field:
    """A sensor_msgs/PointField."""

    name: str
    offset: int
    type: int
    count: int


def _cloud2(message: Message) -> _Raw:
    """The points of a sensor_msgs/PointCloud2."""
    cursor = _cursor(message)
    stamp_ns, frame = cursor.header()
    height = cursor.number("I")
    width = cursor.number("I")
    fields = _fields(cursor)
    if cursor.number("B"):
        raise CloudError(
            "expected a cloud in little endian, found is_bigendian; convert the recording"
        )
    step = cursor.number("I")
    row_step = cursor.number("I") or width * step
    size = cursor.number("I")
    at = cursor.place(size, 1)
    needed = (height - 1) * row_step + width * step if height and width else 0
    if needed > size or (height > 1 and row_step < width * step):
        raise CloudError(
            f"expected {height} x {width} points of {step} bytes in rows of {row_step}, found "
            f"{size} bytes of data; the cloud was cut off, or written wrongly"
        )
    layout, time = _layout(fields, step)
    rows: Rows = np.ndarray((height, width), layout, message.data, at, (row_step, step))
    type_name = np.dtype(_TYPES[time.type]).name
    zero = Zero(f"{time.name} ({type_name})", stamp_ns, "the header's stamp")
    return _Raw(rows.reshape(-1), zero, frame)


def _fields(cursor: Cursor) -> dict[str, _Field]:
    """The fields of a PointCloud2 by name; of several with one name the first."""
    count = cursor.number("I")
    if count > _MOST_FIELDS:
        raise CloudError(
            f"expected at most {_MOST_FIELDS} fields, found {count}; the cloud is damaged"
        )
    fields: dict[str, _Field] = {}
    for _ in range(count):
        # Some drivers write names with padding.
        name = cursor.text().rstrip("\0")
        offset = cursor.number("I")
        datatype = cursor.number("B")
        fields.setdefault(name, _Field(name, offset, datatype, cursor.number("I")))
    return fields


def _layout(fields: Mapping[str, _Field], step: int) -> tuple[np.dtype[np.void], _Field]:
    """The dtype of points, with fields named by role; and the time field."""
    chosen = {axis: fields[axis] for axis in _AXES if axis in fields}
    for role, names in _ROLES.items():
        found = next((fields[name] for name in names if name in fields), None)
        if found is not None:
            chosen[role] = found
    present = ", ".join(fields) or "none"
    if not all(axis in chosen for axis in _AXES):
        raise CloudError(f"expected fields x, y, z, found {present}; choose a topic of points")
    if "time" not in chosen:
        raise CloudError(
            f"expected the time of each point in a field {', '.join(_TIME_NAMES[:-1])} or "
            f"{_TIME_NAMES[-1]}, found {present}; record the raw packets, or clouds with times"
        )
    for role, field in chosen.items():
        _check(role, field, step)
    formats = ["<" + _TYPES[field.type] for field in chosen.values()]
    offsets = [field.offset for field in chosen.values()]
    layout = np.dtype(
        {"names": list(chosen), "formats": formats, "offsets": offsets, "itemsize": step}
    )
    return layout, chosen["time"]


def _check(role: str, field: _Field, step: int) -> None:
    """Refuse a field that contradicts its name."""
    if field.type not in _TYPES or (role in _AXES and _TYPES[field.type][0] != "f"):
        expected = "7 or 8 (float)" if role in _AXES else "1 to 8"
        raise CloudError(
            f"field {field.name}: expected datatype {expected}, found {field.type}; "
            "convert the recording"
        )
    if field.count != 1:
        raise CloudError(
            f"field {field.name}: expected count 1, found {field.count}; convert the recording"
        )
    end = field.offset + np.dtype(_TYPES[field.type]).itemsize
    if end > step:
        raise CloudError(
            f"field {field.name}: expected it within the {step} bytes of a point, found its end at "
            f"byte {end}; the cloud was written wrongly"
        )


_READERS: Mapping[str, Callable[[Message], _Raw]] = {
    "sensor_msgs/PointCloud2": _cloud2,
    "livox_ros_driver/CustomMsg": _custom,
    "livox_ros_driver2/CustomMsg": _custom,
}
# Message types of clouds, and their kind of point packets.
CLOUD_TYPES: Mapping[str, int] = {name: int(reads is _custom) for name, reads in _READERS.items()}


# -- times ----------------------------------------------------------------------------------------

_LIMIT_NS = 2**31 * NS_PER_S
# No revolution takes longer; times in another unit than the assumed one would.
_LONGEST_S = 10
_FLOAT64_BYTES = 8


@dataclass(frozen=True, slots=True)
class _FloatTime:
    """Meaning of floating-point times whose largest is between two values; ns: of their unit."""

    above: float
    below: float
    ns: int
    absolute: bool
    words: str


_FLOAT_TIMES = (
    _FloatTime(-1e3, 1e3, NS_PER_S, False, "s after"),
    _FloatTime(1e8, 1e11, NS_PER_S, True, "s since 1970"),
    _FloatTime(1e14, float(_LIMIT_NS), 1, True, "ns since 1970"),
)


def stamps(time: Times, zero: Zero) -> tuple[I64Array, str]:
    """Stamps (ns) of points by their finite times (n > 0,); and the meaning of the times."""
    if time.dtype.kind != "f":
        # At most 32 bits, hence 4.3 s.
        return _after(zero, time.astype(np.int64)), f"{zero.field}, ns after {zero.base}"
    value = time.astype(np.float64)
    low = float(value.min())
    high = float(value.max())
    meaning = next((one for one in _FLOAT_TIMES if one.above < high < one.below), None)
    if meaning is None or (meaning.absolute and time.dtype.itemsize < _FLOAT64_BYTES):
        raise CloudError(
            f"field {zero.field}: expected s after {zero.base} (below 1000), or float64 s or ns "
            f"since 1970, found {high:g}; its unit is not known, record the raw packets"
        )
    span_s = (high - low) * (meaning.ns / NS_PER_S)
    if span_s > _LONGEST_S:
        raise CloudError(
            f"field {zero.field}: expected times of one cloud within {_LONGEST_S} s, found "
            f"{span_s:g} s; its unit is not known, record the raw packets"
        )
    # In two parts: a float64 of nanoseconds since 1970 has a step of 256.
    whole = np.floor(value)
    ns = whole.astype(np.int64) * meaning.ns
    ns += np.rint((value - whole) * meaning.ns).astype(np.int64)
    if meaning.absolute:
        return ns, f"{zero.field}, {meaning.words}"
    words = "s up to" if high <= 0 > low else meaning.words
    return _after(zero, ns), f"{zero.field}, {words} {zero.base}"


def _after(zero: Zero, offset_ns: I64Array) -> I64Array:
    if not 0 < zero.base_ns < _LIMIT_NS:
        raise CloudError(
            f"field {zero.field}: expected times after {zero.base}, found {zero.base_ns} ns there; "
            "set the clock of its driver and record again"
        )
    return zero.base_ns + offset_ns
