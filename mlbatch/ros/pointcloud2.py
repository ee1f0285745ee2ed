"""Clouds that drivers decoded, as bags hold them: sensor_msgs/PointCloud2, Livox CustomMsg.

Source: facts/messages.md, sections 1 (CustomMsg), 4 (serialisation) and 8 (fields, their times).
Every length is checked against the message's end before anything is made of it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from mlbatch.ros.point_packets import CloudError, Points
from mlbatch.types import F32Array, I64Array, Message
from mlbatch.units import NS_PER_S

# A structured array; numpy has no type for the fields of a dtype.
Rows: TypeAlias = npt.NDArray[Any]
_Whole = TypeVar("_Whole", np.uint8, np.uint16)

# sensor_msgs/PointField: type by its number.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_FIELDS = 256
_AXES = ("x", "y", "z")
# What a point may carry: the first of these names that a cloud has.
_TIME_NAMES = ("t", "time", "timestamp", "time_stamp", "timestamps", "offset_time", "ts")
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
        *((axis, "<f4") for axis in _AXES),
        ("intensity", "u1"),
        ("tag", "u1"),
        ("ring", "u1"),
    ]
)
# In CDR every element begins at a multiple of four; the last has no padding behind it.
_CUSTOM_STEPS = {"cdr": 20, "ros1": 19}


@dataclass(frozen=True, slots=True)
class Cloud:
    """A cloud as it was read; verdict: what its times were taken for; frame: of its points.

    placeless: points left out at NaN, infinity or zero; timeless: those without a finite time.
    """

    points: Points
    verdict: str
    frame: str
    placeless: int
    timeless: int


@dataclass(frozen=True, slots=True)
class _Raw:
    """Points as they lie in a message; rows: fields by role; frame: of the points."""

    rows: Rows
    zero: Zero
    frame: str


class _Cursor:
    """Reads a message of known fields from its front on."""

    def __init__(self, message: Message) -> None:
        self.data = message.data
        self._aligned = message.topic.encoding == "cdr"
        self._origin = self.at = 4 if self._aligned else 0
        if self._aligned and self.data[:2] != b"\x00\x01":
            raise CloudError(
                "wanted a message of little-endian CDR (00 01 00 00), got "
                f"{self.data[:4].hex(' ') or 'nothing'}; convert the recording to that encoding"
            )

    def number(self, code: str) -> int:
        """A number; code: as in `struct`."""
        size = struct.calcsize(code)
        if self._aligned:
            self.at += (self._origin - self.at) % size
        place = self.place(size)
        value: int = struct.unpack_from("<" + code, self.data, place)[0]
        return value

    def place(self, size: int) -> int:
        """Where the next `size` bytes begin."""
        if self.at + size > len(self.data):
            raise CloudError(
                f"wanted {size} bytes at byte {self.at} of a message of {len(self.data)}, got its "
                "end; it was cut off, or is of another type"
            )
        self.at += size
        return self.at - size

    def few(self, most: int, what: str) -> int:
        """A length of which no sane message exceeds `most`."""
        count = self.number("I")
        if count > most:
            raise CloudError(f"wanted at most {most} {what}, got {count}; the cloud is damaged")
        return count

    def text(self) -> str:
        """A string; CDR counts the closing NUL."""
        size = self.number("I")
        at = self.place(size)
        return self.data[at : at + size].rstrip(b"\0").decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        """Stamp (ns; 0 for one that makes no sense) and frame of a std_msgs/Header."""
        if not self._aligned:
            self.number("I")
        seconds, nanoseconds = self.number("i"), self.number("I")
        makes_sense = seconds >= 0 and nanoseconds < NS_PER_S
        stamp_ns = seconds * NS_PER_S + nanoseconds if makes_sense else 0
        return stamp_ns, self.text().lstrip("/")


def read_cloud(message: Message) -> Cloud:
    """The points of a message; CloudError where they cannot be told."""
    raw = _READERS[message.topic.type](message)
    rows, time = raw.rows, raw.rows["time"]
    reals = _reals(rows)
    x, y, z, _ = reals
    with np.errstate(over="ignore", invalid="ignore"):
        squared = x * x + y * y + z * z
    placed = (squared > 0) & (squared < np.inf)
    keep = placed & np.isfinite(time) if time.dtype.kind == "f" else placed
    rows, count = rows[keep], int(np.count_nonzero(keep))
    stamp_ns, verdict = stamps(rows["time"], raw.zero) if count else (np.empty(0, np.int64), "")
    points = Points(
        stamp_ns,
        reals[:, keep],
        _whole(rows, "ring", np.uint16),
        *(
            np.zeros(count, np.uint8) if one is None else one
            for one in (_whole(rows, "return_type", np.uint8), _whole(rows, "tag", np.uint8))
        ),
    )
    placeless = len(keep) - int(np.count_nonzero(placed))
    return Cloud(points, verdict, raw.frame, placeless, len(keep) - count - placeless)


def _reals(rows: Rows) -> F32Array:
    """x, y, z and intensity, (4, n); intensity 0 where there is none that is finite."""
    reals = np.zeros((4, len(rows)), np.float32)
    # A place beyond all float32 is infinite, and is left out as such.
    with np.errstate(over="ignore", invalid="ignore"):
        for plane, name in zip(reals, (*_AXES, "intensity"), strict=True):
            if name in (rows.dtype.names or ()):
                plane[:] = rows[name]
    level = reals[3]
    level[~np.isfinite(level)] = 0
    return reals


def _whole(rows: Rows, name: str, kind: type[_Whole]) -> npt.NDArray[_Whole] | None:
    """A field of whole numbers that fit `kind`; None where there is none."""
    if name not in (rows.dtype.names or ()):
        return None
    values = rows[name]
    if values.dtype.kind == "f" or (values < 0).any() or (values > np.iinfo(kind).max).any():
        return None
    return values.astype(kind)


def _custom(message: Message) -> _Raw:
    """The points of a Livox CustomMsg."""
    cursor = _Cursor(message)
    stamp_ns, frame = cursor.header()
    base_ns, base = cursor.number("Q"), "timebase"
    cursor.number("I")
    cursor.place(4)
    count = cursor.number("I")
    step, size = _CUSTOM_STEPS[message.topic.encoding], _CUSTOM_POINT.itemsize
    at = cursor.place(step * (count - 1) + size if count else 0)
    rows: Rows = np.ndarray((count,), _CUSTOM_POINT, message.data, at, (step,))
    if base_ns == 0:
        base_ns, base = stamp_ns, "the header's stamp"
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
    cursor = _Cursor(message)
    stamp_ns, frame = cursor.header()
    height, width = cursor.number("I"), cursor.number("I")
    fields: dict[str, _Field] = {}
    for _ in range(cursor.few(_MOST_FIELDS, "fields")):
        name = cursor.text()
        field = _Field(name, cursor.number("I"), cursor.number("B"), cursor.number("I"))
        fields.setdefault(name, field)
    if cursor.number("B"):
        raise CloudError("wanted a cloud in little endian, got is_bigendian; convert the recording")
    step, row_step, size = cursor.number("I"), cursor.number("I"), cursor.number("I")
    at = cursor.place(size)
    row_step = row_step or width * step
    needed = (height - 1) * row_step + width * step if height and width else 0
    if needed > size or (height > 1 and row_step < width * step):
        raise CloudError(
            f"wanted {height} x {width} points of {step} bytes in rows of {row_step}, got {size} "
            "bytes of data; the cloud was cut off, or written wrongly"
        )
    layout, chosen = _layout(fields, step)
    rows: Rows = np.ndarray((height, width), layout, message.data, at, (row_step, step))
    type_name = np.dtype(_TYPES[chosen.type]).name
    zero = Zero(f"{chosen.name} ({type_name})", stamp_ns, "the header's stamp")
    return _Raw(rows.reshape(-1), zero, frame)


def _layout(fields: Mapping[str, _Field], step: int) -> tuple[np.dtype[np.void], _Field]:
    """The dtype of points with fields named by their roles; and the field of times."""
    chosen = {axis: fields[axis] for axis in _AXES if axis in fields}
    for role, names in _ROLES.items():
        found = next((fields[name] for name in names if name in fields), None)
        if found is not None:
            chosen[role] = found
    got = ", ".join(fields) or "none"
    if not all(axis in chosen for axis in _AXES):
        raise CloudError(f"wanted fields x, y, z, got {got}; choose a topic of points")
    if "time" not in chosen:
        raise CloudError(
            f"wanted the time of each point in a field {', '.join(_TIME_NAMES[:-1])} or "
            f"{_TIME_NAMES[-1]}, got {got}; record the raw packets, or clouds with times"
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
    """Refuse a field that cannot be what its name says."""
    if field.type not in _TYPES or (role in _AXES and _TYPES[field.type][0] != "f"):
        wanted = "7 or 8 (float)" if role in _AXES else "1 to 8"
        raise CloudError(
            f"field {field.name}: wanted datatype {wanted}, got {field.type}; convert the recording"
        )
    if field.count != 1:
        raise CloudError(
            f"field {field.name}: wanted count 1, got {field.count}; convert the recording"
        )
    end = field.offset + np.dtype(_TYPES[field.type]).itemsize
    if end > step:
        raise CloudError(
            f"field {field.name}: wanted it within the {step} bytes of a point, got its end at "
            f"byte {end}; the cloud was written wrongly"
        )


_READERS: Mapping[str, Callable[[Message], _Raw]] = {
    "sensor_msgs/PointCloud2": _cloud2,
    "livox_ros_driver/CustomMsg": _custom,
    "livox_ros_driver2/CustomMsg": _custom,
}
# Message types of clouds, and their number among the kinds of packets.
CLOUD_TYPES: Mapping[str, int] = {name: int(reads is _custom) for name, reads in _READERS.items()}


# Numbers of the type that a cloud's time field has.
Times: TypeAlias = npt.NDArray[Any]

_LIMIT_NS = 2**31 * NS_PER_S
# No turn takes longer; another unit than the one supposed would.
_LONGEST_S = 10
_FLOAT64_BYTES = 8


@dataclass(frozen=True, slots=True)
class Zero:
    """What times may count from; field: name and type; base: what base_ns is, in words."""

    field: str
    base_ns: int
    base: str


@dataclass(frozen=True, slots=True)
class _FloatTime:
    """What floating-point times mean whose largest is between two values; ns: of their unit."""

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
    """Stamps (ns) of points by their finite times (n > 0,); and what the times were taken for."""
    if time.dtype.kind != "f":
        # At most 32 bits, hence 4.3 s.
        return _after(zero, time.astype(np.int64)), f"{zero.field}, ns after {zero.base}"
    value = time.astype(np.float64)
    low, high = float(value.min()), float(value.max())
    meant = next((one for one in _FLOAT_TIMES if one.above < high < one.below), None)
    if meant is None or (meant.absolute and time.dtype.itemsize < _FLOAT64_BYTES):
        raise CloudError(
            f"field {zero.field}: wanted s after {zero.base} (below 1000), or float64 s or ns "
            f"since 1970, got {high:g}; its unit is not known, record the raw packets"
        )
    span_s = (high - low) * (meant.ns / NS_PER_S)
    if span_s > _LONGEST_S:
        raise CloudError(
            f"field {zero.field}: wanted times of one cloud within {_LONGEST_S} s, got "
            f"{span_s:g} s; its unit is not known, record the raw packets"
        )
    # Part by part: a float64 of nanoseconds since 1970 has a step of 256.
    whole = np.floor(value)
    ns = whole.astype(np.int64) * meant.ns
    ns += np.rint((value - whole) * meant.ns).astype(np.int64)
    if meant.absolute:
        return ns, f"{zero.field}, {meant.words}"
    words = "s up to" if high <= 0 > low else meant.words
    return _after(zero, ns), f"{zero.field}, {words} {zero.base}"


def _after(zero: Zero, offset_ns: I64Array) -> I64Array:
    if not 0 < zero.base_ns < _LIMIT_NS:
        raise CloudError(
            f"field {zero.field}: wanted times after {zero.base}, got {zero.base_ns} ns there; "
            "set the clock of its driver and record again"
        )
    return zero.base_ns + offset_ns
