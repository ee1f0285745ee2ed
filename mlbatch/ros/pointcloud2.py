"""Clouds that drivers decoded: sensor_msgs/PointCloud2 and Livox CustomMsg to points with times.

Source: docs/sources/messages.md, sections 1 (CustomMsg), 4 (serialisation) and 8 (fields, times).
Every length is checked against the message's end before it is used. Times: `ros.point_times`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import U16Array
from mlbatch.ros.encoding import Cursor, MessageError
from mlbatch.ros.point_packets import CloudError, Points
from mlbatch.ros.point_rows import AXES, FIELD_NUMBERS, Rows, take_rows
from mlbatch.ros.point_times import CONVENTION, TIME_NAMES, CloudSample, PointRule, Zero, stamps
from mlbatch.types import Message

_Whole = TypeVar("_Whole", np.uint8, np.uint16)

_TYPES = {number: name for name, number in FIELD_NUMBERS.items()}
_MOST_FIELDS = 256
# Of the numbers in the fields.
_ALIGN = 4
# Names of a field by its role; the first that a cloud has counts.
_ROLES: Mapping[str, tuple[str, ...]] = {
    "time": TIME_NAMES,
    "intensity": ("intensity", "i", "reflectivity"),
    "ring": ("ring", "channel", "line"),
    "return_type": ("return_type",),
    "tag": ("tag",),
    "lidar_id": ("lidar_id",),
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


# Names of fields that may rise within a scan and are no times.
_NO_TIMES = (
    *AXES,
    "azimuth",
    *(name for role in _ROLES if role != "time" for name in _ROLES[role]),
)
# Times rise at nearly every step at which they change, or with the number of the point.
_MOST_FALLS = 0.05
_LEAST_CORRELATION = 0.9
_LEAST_RISES = 8

# More points share one time only where it is not theirs; columns have fewer.
_MOST_AT_ONCE = 1024


class FieldError(CloudError):
    """A field that the rig names and the cloud lacks."""


class _NoTimeError(Exception):
    """A cloud without its field of times; text: what was expected and found."""

    def __init__(self, text: str, kind: type[CloudError]) -> None:
        super().__init__(text)
        self.kind = kind


@dataclass(frozen=True, slots=True)
class Cloud:
    """A cloud; time_meaning: unit and zero of its times; frame: frame_id of its points.

    lidar_id: (n,) the lidar of each point, None where the message does not say; without_place:
    points left out at NaN, infinity or zero; without_time: those without a finite time.
    """

    points: Points
    lidar_id: U16Array | None
    time_meaning: str
    frame: str
    without_place: int
    without_time: int


@dataclass(frozen=True, slots=True)
class RawCloud:
    """Points of a message before conversion.

    rows: fields by role; stamp_ns, frame: of the header; lidar_id: of all points, None without.
    """

    rows: Rows
    zero: Zero
    stamp_ns: int
    frame: str
    lidar_id: int | None = None


# The rule for the points of a frame.
Rules: TypeAlias = Callable[[str], PointRule]


def by_convention(frame: str) -> PointRule:
    """The rule of every frame without a rig."""
    return CONVENTION


def read_cloud(message: Message, rules: Rules = by_convention) -> Cloud:
    """The points of a message; rules: by its frame_id; CloudError if they cannot be read."""
    raw = raw_cloud(message, rules)
    rule = rules(raw.frame)
    taken = take_rows(raw.rows)
    fields = taken.fields
    count = len(fields["time"])
    stamp_ns = np.empty(0, np.int64)
    meaning = ""
    if count:
        stamp_ns, meaning = stamps(fields["time"], raw.zero, rule, raw.rows["time"])
        if count > _MOST_AT_ONCE and stamp_ns.min() == stamp_ns.max():
            raise CloudError(
                f"field {raw.zero.field}: expected times of the points, found one for all {count} "
                "points of the cloud"
            )
    ring = _ring(fields, rule)
    return_type = _whole(fields, "return_type", np.uint8)
    tag = _whole(fields, "tag", np.uint8)
    points = Points(
        stamp_ns,
        taken.reals,
        ring,
        np.zeros(count, np.uint8) if return_type is None else return_type,
        np.zeros(count, np.uint8) if tag is None else tag,
    )
    without_place = len(raw.rows) - taken.placed
    lidar_id = _whole(fields, "lidar_id", np.uint16)
    if raw.lidar_id is not None:
        lidar_id = np.full(count, raw.lidar_id, np.uint16)
    return Cloud(points, lidar_id, meaning, raw.frame, without_place, taken.placed - count)


@dataclass(frozen=True, slots=True)
class CloudHead:
    """Lidars that a message names; lidar_ids: sorted, empty if it names none."""

    frame: str
    lidar_ids: tuple[int, ...]
    sample: CloudSample


def sample_cloud(message: Message, rules: Rules) -> CloudHead:
    """Frame, lidars and times of a message as they are stored; CloudError as in `read_cloud`."""
    raw = raw_cloud(message, rules)
    fields = take_rows(raw.rows).fields
    time = fields["time"]
    _ring(fields, rules(raw.frame))
    ids = _whole(fields, "lidar_id", np.uint16)
    lidar_ids = () if ids is None else tuple(np.unique(ids).tolist())
    if raw.lidar_id is not None:
        lidar_ids = (raw.lidar_id,)
    low = float(time.min()) if len(time) else 0.0
    high = float(time.max()) if len(time) else 0.0
    sample = CloudSample(message.host_ns, raw.stamp_ns, time.dtype, low, high, len(time), raw.zero)
    return CloudHead(raw.frame, lidar_ids, sample)


def raw_cloud(message: Message, rules: Rules) -> RawCloud:
    """The rows of a message, as they are stored; CloudError if they cannot be read."""
    try:
        return _READERS[message.topic.type](message, rules)
    except MessageError as err:
        raise CloudError(str(err)) from err


def _ring(fields: Mapping[str, npt.NDArray[Any]], rule: PointRule) -> U16Array | None:
    """The ring of each point; None where there is none, FieldError where the rig names another."""
    ring = _whole(fields, "ring", np.uint16)
    if rule.ring and ring is None:
        raise FieldError(
            f"{rule.at('ring')}expected a field of whole numbers from 0 to 65535, found others in "
            f"{rule.ring}; name another one, or remove the key"
        )
    return ring


def _whole(
    fields: Mapping[str, npt.NDArray[Any]], name: str, kind: type[_Whole]
) -> npt.NDArray[_Whole] | None:
    """A field of whole numbers that fit `kind`; None where there is none."""
    values = fields.get(name)
    if values is None or values.dtype.kind == "f":
        return None
    if values.dtype == kind:
        return values
    if len(values) and (values.min() < 0 or values.max() > np.iinfo(kind).max):
        return None
    return values.astype(kind)


# -- messages -------------------------------------------------------------------------------------


def _cursor(message: Message) -> Cursor:
    return Cursor(message.topic.encoding, message.data, 0, len(message.data))


def _custom(message: Message, rules: Rules) -> RawCloud:
    """The points of a Livox CustomMsg."""
    cursor = _cursor(message)
    stamp_ns, frame = cursor.header()
    base_ns = cursor.number("Q")
    base = "timebase"
    cursor.number("I")
    lidar_id = cursor.number("B")
    cursor.place(3, 1)
    count = cursor.number("I")
    step = _CUSTOM_STEPS[message.topic.encoding]
    at = cursor.place(step * (count - 1) + _CUSTOM_POINT.itemsize if count else 0, 1)
    rows: Rows = np.ndarray((count,), _CUSTOM_POINT, message.data, at, (step,))
    if base_ns == 0:
        base_ns = stamp_ns
        base = "the header's stamp"
    for key, given, own in (
        ("time", rules(frame).time, "offset_time"),
        ("ring", rules(frame).ring, "line"),
    ):
        if given not in ("", own):
            raise _nearest(_unknown_field(rules(frame), key, given, (own,)), given, (own,))
    zero = Zero("offset_time (uint32)", base_ns, base)
    return RawCloud(rows, zero, stamp_ns or base_ns, frame, lidar_id)


@dataclass(frozen=True, slots=True)
class _Field:
    """A sensor_msgs/PointField."""

    name: str
    offset: int
    type: int
    count: int


def _cloud2(message: Message, rules: Rules) -> RawCloud:
    """The points of a sensor_msgs/PointCloud2."""
    cursor = _cursor(message)
    stamp_ns, frame = cursor.header()
    height = cursor.number("I")
    width = cursor.number("I")
    fields = _field_list(cursor)
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
    try:
        layout, time, type_name = _layout(fields, step, rules(frame))
    except _NoTimeError as err:
        place = (message.data, at, (height, width), (row_step, step))
        rising = _rising_fields(fields.fields.values(), *place)
        raise err.kind(f"{err}; {_time_remedy(rising, err.kind)}") from err
    rows: Rows = np.ndarray((height, width), layout, message.data, at, (row_step, step))
    zero = Zero(f"{time.name} ({type_name})", stamp_ns, "the header's stamp")
    return RawCloud(rows.reshape(-1), zero, stamp_ns, frame)


@dataclass(frozen=True, slots=True, eq=False)
class _FieldList:
    """The fields of a PointCloud2 by name; content: their bytes in the message."""

    content: bytes
    fields: Mapping[str, _Field]


# Field lists of recent messages by encoding and the remainder of their first byte, newest last.
_known_lists: dict[tuple[bool, int], list[_FieldList]] = {}
_MOST_LISTS = 8


def _field_list(cursor: Cursor) -> _FieldList:
    """The next fields of a message; if equal to the message before, they are not read again.

    A list says itself where it ends: equal bytes are an equal list.
    """
    begin = cursor.at
    known = _known_lists.setdefault((cursor.is_cdr, (begin - cursor.origin) % _ALIGN), [])
    for one in known:
        end = begin + len(one.content)
        if end <= cursor.end and cursor.data[begin:end] == one.content:
            cursor.at = end
            return one
    fields = _fields(cursor)
    found = _FieldList(bytes(cursor.data[begin : cursor.at]), fields)
    known.append(found)
    del known[:-_MOST_LISTS]
    return found


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


# A message has the layout of the one before; the places of a rule are only for errors.
@lru_cache(maxsize=4 * _MOST_LISTS)
def _layout(known: _FieldList, step: int, rule: PointRule) -> tuple[np.dtype[np.void], _Field, str]:
    """The dtype of points, with fields named by role; the time field; and the name of its type."""
    fields = known.fields
    chosen = {axis: fields[axis] for axis in AXES if axis in fields}
    given = {"time": rule.time, "ring": rule.ring}
    for role, names in _ROLES.items():
        if given.get(role):
            names = (given[role],)
            if names[0] not in fields:
                error = _unknown_field(rule, role, names[0], tuple(fields))
                if role == "time":
                    raise _NoTimeError(error, FieldError)
                raise _nearest(error, names[0], tuple(fields))
        found = next((fields[name] for name in names if name in fields), None)
        if found is not None:
            chosen[role] = found
    present = ", ".join(fields) or "none"
    if not all(axis in chosen for axis in AXES):
        raise CloudError(f"expected fields x, y, z, found {present}; choose a topic of points")
    if "time" not in chosen:
        raise _NoTimeError(
            f"expected the time of each point in a field {', '.join(TIME_NAMES[:-1])} or "
            f"{TIME_NAMES[-1]}, found {present}",
            CloudError,
        )
    for role, field in chosen.items():
        _check(role, field, step)
    formats = ["<" + _TYPES[field.type] for field in chosen.values()]
    offsets = [field.offset for field in chosen.values()]
    layout = np.dtype(
        {"names": list(chosen), "formats": formats, "offsets": offsets, "itemsize": step}
    )
    time = chosen["time"]
    return layout, time, np.dtype(_TYPES[time.type]).name


def _check(role: str, field: _Field, step: int) -> None:
    """Refuse a field that contradicts its name."""
    if field.type not in _TYPES or (role in AXES and _TYPES[field.type][0] != "f"):
        expected = "7 or 8 (float)" if role in AXES else "1 to 8"
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


def _unknown_field(rule: PointRule, key: str, name: str, known: Sequence[str]) -> str:
    """The error for a field of the rig that the cloud lacks, without a remedy."""
    return (
        f"{rule.at(key)}expected a field of the cloud, one of {', '.join(known) or 'none'}, found "
        f"{name!r}"
    )


def _nearest(error: str, name: str, known: Sequence[str]) -> FieldError:
    """The error with the known field whose name is nearest as remedy."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
    remedy = f"the nearest one is {near[0]}" if near else "choose a topic of points"
    return FieldError(f"{error}; {remedy}")


def _time_remedy(rising: Sequence[str], kind: type[CloudError]) -> str:
    """Advice for a cloud without times of points."""
    instead = "record the raw packets, or clouds with times"
    if not rising:
        return f"none of them rises within the scan as times do: {instead}"
    what = f"{' or '.join(rising)} rises within the scan as times do"
    if kind is FieldError:
        return what
    return (
        f"{what}: if that is it, name it in the rig (points: {{time: {rising[0]}}}), or {instead}"
    )


def _rising_fields(
    fields: Iterable[_Field],
    data: bytes | memoryview,
    at: int,
    shape: tuple[int, int],
    strides: tuple[int, int],
) -> list[str]:
    """Names of fields whose values rise with the points of a cloud (height, width)."""
    found = []
    for field in fields:
        if field.name in _NO_TIMES or field.type not in _TYPES or field.count != 1:
            continue
        kind = np.dtype("<" + _TYPES[field.type])
        if field.offset + kind.itemsize > strides[1] or not shape[0] * shape[1]:
            continue
        values = np.ndarray(shape, kind, data, at + field.offset, strides)
        if _rises(values.reshape(-1).astype(np.float64)):
            found.append(field.name)
    return found


def _rises(values: npt.NDArray[np.float64]) -> bool:
    """Whether numbers rise as times do: mostly, or by their order."""
    values = values[np.isfinite(values)]
    steps = np.diff(values)
    rises = int(np.count_nonzero(steps > 0))
    falls = int(np.count_nonzero(steps < 0))
    if rises < _LEAST_RISES:
        return False
    if falls <= _MOST_FALLS * (rises + falls):
        return True
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.corrcoef(values, np.arange(len(values)))[0, 1] >= _LEAST_CORRELATION)


_READERS: Mapping[str, Callable[[Message, Rules], RawCloud]] = {
    "sensor_msgs/PointCloud2": _cloud2,
    "livox_ros_driver/CustomMsg": _custom,
    "livox_ros_driver2/CustomMsg": _custom,
}
# Message types of clouds, and their kind of point packets.
CLOUD_TYPES: Mapping[str, int] = {name: int(reads is _custom) for name, reads in _READERS.items()}
