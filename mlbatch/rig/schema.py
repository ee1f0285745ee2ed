"""Keys of a rig file: how each value is read, checked and converted, and its default.

Format: docs/rig.md. All units of users are converted here.
"""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError, UsageError
from mlbatch.frames.transforms import from_quaternion, from_rpy_deg, rigid
from mlbatch.lidar.limits import MAX_TRANSLATION_M
from mlbatch.rig import convert_keys
from mlbatch.rig.convert_keys import RigOption
from mlbatch.rig.keys import (
    FLAG,
    NUMBER,
    OPTIONS,
    RANGE_M,
    TEXT,
    WORD,
    Form,
    Key,
    choice_form,
    mapping_form,
    names,
    numbers_form,
    text_form,
    whole_form,
)
from mlbatch.rig.recipes import DATASET_KEY
from mlbatch.rig.rig import (
    DEFAULT_BODY_FRAME,
    MAX_NAME,
    Rig,
    RigSensor,
    StreamSelector,
    Sweeps,
    UnknownExtrinsics,
    no_boxes,
)
from mlbatch.rig.yaml_tree import Node
from mlbatch.units import NS_PER_S, parse_rate

if TYPE_CHECKING:
    from mlbatch.rig.extrinsics_files import ExtrinsicsFiles
    from mlbatch.ros.point_times import PointRule

# `lidar_id` is a uint8.
MAX_SENSORS = 256
# Value that `inspect --write-rig` writes for extrinsics that nobody gave.
UNKNOWN = "unknown"
MAX_OFFSET_S = 2**31

_NAME = re.compile(rf"[A-Za-z_]\w{{0,{MAX_NAME - 1}}}", re.ASCII)
_FRAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_TEXT = re.compile(r"\S(.*\S)?")
# No blanks, no control characters, no surrogates (which no output can store).
_WORD = re.compile(r"[^\s\x00-\x1f\x7f-\x9f\ud800-\udfff]+")


def _word_key(
    name: str, what: str, about: str, pattern: re.Pattern[str] = _WORD, form: Form = WORD
) -> Key[str]:
    """A key whose value is text, "" without it; what: of an error."""
    return Key(name, lambda node: node.word(what, pattern), "", form, about)


def _choice_key(name: str, words: tuple[str, ...], about: str) -> Key[str]:
    """A key whose value is one of some words, "" without it."""
    return Key(name, lambda node: node.choice(words), "", choice_form(*words), about)


def _model(node: Node) -> str | None:
    name = node.word("auto or a name from `mlbatch sensors`", _TEXT)
    return None if name == "auto" else name


def _rate(node: Node) -> Fraction:
    try:
        return parse_rate(node.word("a number of Hz", _TEXT))
    except UsageError as err:
        raise node.error_here(str(err).removeprefix("rate: ")) from err


def _ip_address(node: Node) -> str:
    """Return an IP address in its usual spelling."""
    text = node.word("an IP address", _WORD)
    try:
        return str(ipaddress.ip_address(text))
    except ValueError as err:
        raise node.error("an IP address", node.shown, "write it as 192.168.1.201") from err


def _existing_file(node: Node) -> Path:
    path = node.file.parent / node.word("a file name", _TEXT)
    if not os.path.isfile(path):
        remedy = "give its path relative to the rig file"
        raise node.error("an existing file", f"none at {str(path)!r}", remedy)
    return path


def _offset_ns(node: Node) -> int:
    """Return a clock offset in ns, exact but for digits below 1 ns, which are rounded once."""
    offset_s = node.exact()
    if abs(offset_s) > MAX_OFFSET_S:
        raise node.error(f"at most {MAX_OFFSET_S} s either way", node.shown, "give seconds")
    return round(offset_s * NS_PER_S)


def _range_m(node: Node) -> float:
    value = node.number()
    if value < 0:
        raise node.error("a range of 0 m or more", node.shown, "give metres from the sensor")
    return value


def _options(node: Node) -> dict[str, str]:
    """Return decoder options as text; the sensor modules check them, so `on` stays `on`."""
    if node.kind != "mapping":
        raise node.error("a mapping of options", node.shown, "write {option: value}")
    return {key: value.word("one word", _WORD) for key, value in node.entries.items()}


def _stream(node: Node) -> StreamSelector:
    fields = _some_fields(node, names(_STREAM_KEYS))
    return StreamSelector(
        source_ip=_SOURCE_IP.of(fields),
        port=_PORT.of(fields),
        topic=_TOPIC.of(fields),
        serial=_SERIAL.of(fields),
        frame_id=_FRAME_ID.of(fields).lstrip("/"),
        lidar_id=_LIDAR_ID.of(fields),
    )


def _points(node: Node) -> PointRule:
    """Return how decoded clouds are read; the fields are checked with the first of them."""
    # Few rigs have it.
    from mlbatch.ros.point_times import UNITS_NS, PointRule

    fields = _some_fields(node, names(_POINTS_KEYS))
    return PointRule(
        time=_POINT_TIME.of(fields),
        unit_ns=UNITS_NS.get(_POINT_UNIT.of(fields), 0),
        origin=_POINT_ORIGIN.of(fields),
        ring=_POINT_RING.of(fields),
        places={key: value.place for key, value in fields.items()},
    )


def _sweeps(node: Node) -> Sweeps | None:
    """Return the files of a folder of sweeps, None where `points` names none."""
    fields = node.entries
    if "glob" not in fields:
        return None
    return Sweeps(
        _GLOB.of(fields), _DTYPE.of(fields), fields["glob"].place, tuple(_ARRAYS.of(fields).items())
    )


def _glob(node: Node) -> str:
    text = node.word("a pattern of files, as Ouster/*.bin", _WORD)
    parts = _NAMED_PARTS.findall(text)
    units = ", ".join(f"{{stamp:{unit}}}" for unit in ("s", "ms", "us", "ns", "iso"))
    if [part for part in parts if not _NAMED_PART.fullmatch(part)] or len(
        [part for part in parts if part != "{sensor}"]
    ) > 1:
        found = ", ".join(parts)
        raise node.error(f"one of {{stamp}}, {units}, and {{sensor}}", found, "write * for others")
    if text.startswith("/") or ".." in text.split("/"):
        remedy = "give the folder as recording, and the pattern relative to it"
        raise node.error("a pattern within the folder of the recording", node.shown, remedy)
    return text


def _dtype(node: Node) -> tuple[tuple[str, str], ...]:
    """Return name and type of each field of a point, in order, without gaps."""
    if node.kind != "mapping" or not node.entries:
        remedy = "write {x: f4, y: f4, z: f4, t: u4}, in the order of the file"
        raise node.error("a mapping of fields to numpy types", node.shown, remedy)
    return tuple((name, _field_type(value)) for name, value in node.entries.items())


def _field_type(node: Node) -> str:
    text = node.word("a numpy type", _WORD)
    found = _PADDING.fullmatch(text)
    if found is None:
        # `float32` and `<f4` are names of f4.
        try:
            kind = np.dtype(text)
        except TypeError:
            kind = np.dtype(object)
        word = f"{kind.kind}{kind.itemsize}"
        if kind.byteorder != ">" and word in FIELD_TYPES:
            return word
        remedy = "write the file with these types, or V3 for 3 bytes without meaning"
        expected = f"one of {', '.join(FIELD_TYPES)}, little endian"
        raise node.error(expected, node.shown, remedy)
    return f"V{int(found[1])}"


def _clock(node: Node) -> Mapping[str, Node]:
    return node.fields(names(_CLOCK_KEYS))


def _extrinsics(node: Node) -> F64Array | str | UnknownExtrinsics | ExtrinsicsFiles:
    """Return (4, 4) body_from_sensor, m, a frame of the recording, unknown, or files with it."""
    if node.kind == "scalar" and node.text == UNKNOWN:
        return UnknownExtrinsics(node.place)
    fields = _some_fields(node, names(_EXTRINSICS_KEYS))
    if "file" in fields:
        return _extrinsics_files(node, fields)
    frame = _FRAME_OF_EXTRINSICS.of(fields)
    if frame:
        return frame
    return _pose(fields)


def _extrinsics_files(node: Node, fields: Mapping[str, Node]) -> ExtrinsicsFiles:
    # Few rigs have it.
    from mlbatch.rig.extrinsics_files import ExtrinsicsFiles

    keys = _MATRIX_KEYS.of(fields)
    direction = _DIRECTION.of(fields)
    if direction and not keys:
        raise fields["direction"].error(
            "direction with key",
            "no key",
            "name the matrix as key; files with named frames state their direction",
        )
    return ExtrinsicsFiles(
        node,
        _FILES.of(fields),
        _FRAME_OF_EXTRINSICS.of(fields),
        _PARENT.of(fields),
        keys,
        direction,
        _MATRIX_UNIT.of(fields),
        _SENSOR_IN_FRAME.of(fields),
    )


def _files(node: Node) -> tuple[Path, ...]:
    """Return existing files, of a name or a list of names."""
    if node.kind != "list":
        return (_existing_file(node),)
    if not node.items:
        raise node.error("one or more files", node.shown, "give a file")
    return tuple(map(_existing_file, node.items))


def _matrix_keys(node: Node) -> tuple[str, ...]:
    """Return keys of matrices, of a name or a list of names."""
    items = node.items if node.kind == "list" and node.items else (node,)
    return tuple(item.word("the key of a matrix in the file", _WORD) for item in items)


def _sensor_in_frame(node: Node) -> F64Array:
    return _pose(_some_fields(node, names(_POSE_KEYS)))


def _pose(fields: Mapping[str, Node]) -> F64Array:
    """Return the (4, 4) transform, m, that translation and rotation or a matrix give."""
    origin = _TRANSLATION.of(fields)
    if "rotation_xyzw" in fields:
        xyzw = fields["rotation_xyzw"].numbers(4)
        return _located(fields["rotation_xyzw"], lambda: from_quaternion(origin, xyzw))
    if "matrix" in fields:
        return _matrix(fields["matrix"])
    return from_rpy_deg(origin, _ROTATION_RPY.of(fields))


def _translation(node: Node) -> list[float]:
    values = node.numbers(3)
    for item, value in zip(node.items, values, strict=True):
        _check_near(item, value)
    return values


def _matrix(node: Node) -> F64Array:
    rows = node.elements("4 rows of 4 numbers")
    if len(rows) not in (3, 4):
        raise node.error("4 rows (or 3, without 0, 0, 0, 1)", node.shown, "give all rows")
    matrix = np.array([row.numbers(4) for row in rows])
    transform = _located(node, lambda: rigid(matrix))
    for row in rows[:3]:
        _check_near(row.items[3], row.items[3].number())
    return transform


def _boxes(node: Node) -> F64Array:
    """Return boxes (k, 6): x0, y0, z0, x1, y1, z1 in m."""
    return np.array([_box(item) for item in node.elements("boxes")]).reshape(-1, 6)


def _box(node: Node) -> list[float]:
    values = node.numbers(6)
    for axis, low, high in zip("xyz", values[:3], values[3:], strict=True):
        if low >= high:
            expected = f"{axis}0 < {axis}1 in metres (x0, y0, z0, x1, y1, z1)"
            raise node.error(expected, f"{low:g} and {high:g}", "swap the corners")
    return values


def _sensors(node: Node) -> tuple[Node, ...]:
    """Return the entries; they are read with the body frame."""
    items = node.elements("sensors")
    if not 1 <= len(items) <= MAX_SENSORS:
        remedy = "list each sensor with `- name:`"
        raise node.error(f"1 to {MAX_SENSORS} sensors", node.shown, remedy)
    return items


# The keys of each mapping.

_SOURCE_IP = Key("source_ip", _ip_address, "", WORD, "source IP of the packets")
_PORT = Key("port", lambda node: node.whole(1, 65535), 0, whole_form(1, 65535), "destination port")
_TOPIC = _word_key("topic", "a topic without spaces", "topic of a bag")
# Text, since leading zeros count.
_SERIAL = _word_key("serial", "a serial number without spaces", "serial number in the packets")
# Of one of several lidars whose clouds share a topic.
_FRAME_ID = _word_key(
    "frame_id",
    "a frame_id without spaces",
    "frame of one of several lidars whose clouds share a topic",
)
_LIDAR_ID: Key[int | None] = Key(
    "lidar_id",
    lambda node: node.whole(0, 65535),
    None,
    whole_form(0, 65535),
    "number of one of several lidars whose clouds share a topic",
)
_STREAM_KEYS = (_SOURCE_IP, _PORT, _TOPIC, _SERIAL, _FRAME_ID, _LIDAR_ID)

_POINT_TIME = _word_key("time", "the name of a field", "field with the time of a point")
_POINT_UNIT = _choice_key("unit", ("s", "ms", "us", "ns"), "unit of that field")
_POINT_ORIGIN = _choice_key(
    "from",
    ("start", "end", "back", "absolute"),
    "the header's stamp is that of the first point, of the last one; times are ages; or from 1970",
)
_POINT_RING = _word_key("ring", "the name of a field", "field with the ring of a point")
# Of a sensor_msgs/PointField, and whole numbers of 64 bits.
FIELD_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")
_PADDING = re.compile(r"V([1-9]\d{0,3})", re.ASCII)
_NAMED_PARTS = re.compile(r"\{[^}]*\}?")
_NAMED_PART = re.compile(r"\{(sensor|stamp(:(s|ms|us|ns|iso))?)\}")
_GLOB = Key("glob", _glob, "", WORD, "files of sweeps in the folder of the recording")
_DTYPE: Key[tuple[tuple[str, str], ...]] = Key(
    "dtype",
    _dtype,
    (),
    {
        "type": "object",
        "additionalProperties": text_form(r"[<|=]?\w+"),
        "minProperties": 1,
    },
    "fields of a point in the files, and their numpy types, in order; PCD states its own",
)
_ARRAYS: Key[dict[str, str]] = Key(
    "arrays",
    _options,
    {},
    {"type": "object", "additionalProperties": WORD, "minProperties": 1},
    "array of a .npz file for each field of a point; points.0: its first column",
)
_POINTS_KEYS = (_POINT_TIME, _POINT_UNIT, _POINT_ORIGIN, _POINT_RING, _GLOB, _DTYPE, _ARRAYS)

_CLOCK_SOURCE = _choice_key(
    "source", ("sensor", "host"), "timestamps of packets, or their receive times"
)
_CLOCK_EPOCH = _choice_key(
    "epoch", ("utc", "tai", "gps"), "what the timestamps count; converted to UTC"
)
_CLOCK_OFFSET = Key(
    "offset_s",
    _offset_ns,
    0,
    {"type": "number", "minimum": -MAX_OFFSET_S, "maximum": MAX_OFFSET_S},
    "added to the timestamps, s",
)
_CLOCK_KEYS = (_CLOCK_SOURCE, _CLOCK_EPOCH, _CLOCK_OFFSET)

_TRANSLATION = Key(
    "translation_m", _translation, [0.0, 0.0, 0.0], numbers_form(3), "x, y, z, m, body frame"
)
_ROTATION_RPY = Key(
    "rotation_rpy_deg",
    lambda node: node.numbers(3),
    [0.0, 0.0, 0.0],
    numbers_form(3),
    "roll, pitch, yaw about the fixed axes x, y, z, degrees",
)
_ROTATION_XYZW: Key[list[float] | None] = Key(
    "rotation_xyzw", lambda node: node.numbers(4), None, numbers_form(4), "unit quaternion"
)
_MATRIX: Key[F64Array | None] = Key(
    "matrix",
    _matrix,
    None,
    {"type": "array", "items": numbers_form(4), "minItems": 3, "maxItems": 4},
    "body_from_sensor, 4 x 4 or 3 x 4, m",
)
_FRAME_OF_EXTRINSICS = _word_key(
    "frame",
    "the name of a frame",
    "frame of the sensor in the file, or in the recording's transforms",
)
_POSE_KEYS = (_TRANSLATION, _ROTATION_RPY, _ROTATION_XYZW)
_SOME_WORDS: Form = {"anyOf": [WORD, {"type": "array", "items": WORD, "minItems": 1}]}
_FILES: Key[tuple[Path, ...]] = Key(
    "file",
    _files,
    (),
    {"anyOf": [TEXT, {"type": "array", "items": TEXT, "minItems": 1}]},
    "file or files with the extrinsics, relative to this file",
)
_PARENT = _word_key("parent", "the name of a frame", "frame of the file that is the body frame")
_MATRIX_KEYS: Key[tuple[str, ...]] = Key(
    "key", _matrix_keys, (), _SOME_WORDS, "key of a matrix in the file; several are multiplied"
)
_DIRECTION = _choice_key(
    "direction", ("body_from_sensor", "sensor_from_body"), "what the matrix maps"
)
_MATRIX_UNIT = _choice_key("matrix_unit", ("m", "mm"), "unit of their translations")
# Keys of streams and extrinsics that need another one.
_NEEDS = {
    "frame_id": "topic",
    "lidar_id": "topic",
    "parent": "file",
    "key": "direction",
    "direction": "file",
    "matrix_unit": "key",
    "sensor_in_frame": "file",
    "dtype": "glob",
    "arrays": "glob",
}
# Keys of streams and extrinsics that exclude others.
_EXCLUDES = {
    "rotation_xyzw": ("rotation_rpy_deg",),
    "matrix": ("translation_m", "rotation_rpy_deg", "rotation_xyzw"),
    "frame": ("translation_m", "rotation_rpy_deg", "rotation_xyzw", "matrix"),
    "topic": ("source_ip", "port"),
    "file": ("translation_m", "rotation_rpy_deg", "rotation_xyzw", "matrix"),
    "key": ("frame", "parent"),
    "arrays": ("dtype",),
}
_SENSOR_IN_FRAME: Key[F64Array | None] = Key(
    "sensor_in_frame",
    _sensor_in_frame,
    None,
    mapping_form(_POSE_KEYS, excludes=_EXCLUDES, may_be_empty=False),
    "pose of the sensor in the frame of the file",
)
_EXTRINSICS_KEYS = (
    *_POSE_KEYS,
    _MATRIX,
    _FRAME_OF_EXTRINSICS,
    _FILES,
    _PARENT,
    _MATRIX_KEYS,
    _DIRECTION,
    _MATRIX_UNIT,
    _SENSOR_IN_FRAME,
)
_EXTRINSICS_FORM: Form = {
    "anyOf": [
        {"const": UNKNOWN},
        mapping_form(_EXTRINSICS_KEYS, excludes=_EXCLUDES, needs=_NEEDS, may_be_empty=False),
    ]
}

# A name fits ROS topics, frames and file names.
_SENSOR_NAME = _word_key(
    "name",
    f"a name of at most {MAX_NAME} letters, digits and _, not a digit first",
    "name in topics, folders and frames",
    _NAME,
    text_form(rf"[A-Za-z_][A-Za-z0-9_]{{0,{MAX_NAME - 1}}}"),
)
_MODEL: Key[str | None] = Key("model", _model, None, TEXT, "auto, or a name of `mlbatch sensors`")
_STREAM: Key[StreamSelector | None] = Key(
    "stream",
    _stream,
    None,
    mapping_form(_STREAM_KEYS, excludes=_EXCLUDES, needs=_NEEDS, may_be_empty=False),
    "its packets; default: any that match its calibration",
)
_METADATA: Key[Path | None] = Key(
    "metadata", _existing_file, None, TEXT, "metadata or calibration, relative to this file"
)
_EXTRINSICS: Key[F64Array | str | UnknownExtrinsics | ExtrinsicsFiles | None] = Key(
    "extrinsics", _extrinsics, None, _EXTRINSICS_FORM, "body_from_sensor; default: the recording's"
)
_CLOCK: Key[Mapping[str, Node]] = Key("clock", _clock, {}, mapping_form(_CLOCK_KEYS), "its clock")
_MIN_RANGE: Key[float | None] = Key("min_range_m", _range_m, None, RANGE_M, "drop nearer points, m")
_MAX_RANGE: Key[float | None] = Key(
    "max_range_m", _range_m, None, RANGE_M, "drop farther points, m"
)
_OPTIONAL = Key("optional", Node.flag, False, FLAG, "may be absent from a recording")
_DECODE: Key[dict[str, str]] = Key("decode", _options, {}, OPTIONS, "options of its decoder")
_POINTS: Key[PointRule | None] = Key(
    "points",
    _points,
    None,
    mapping_form(_POINTS_KEYS, needs=_NEEDS, may_be_empty=False),
    "how decoded clouds are read; only with a topic, or files of sweeps",
)
_SENSOR_KEYS = (
    _SENSOR_NAME,
    _MODEL,
    _STREAM,
    _METADATA,
    _EXTRINSICS,
    _CLOCK,
    _MIN_RANGE,
    _MAX_RANGE,
    _OPTIONAL,
    _DECODE,
    _POINTS,
)

# Fleets put the name of the robot before a slash.
_BODY_FRAME = _word_key(
    "body_frame",
    "a frame name of letters, digits, _ and / that does not start with a digit",
    "frame of all points",
    _FRAME,
    text_form(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*"),
)
_RATE: Key[Fraction | None] = Key(
    "rate_hz",
    _rate,
    None,
    {"anyOf": [{**NUMBER, "exclusiveMinimum": 0}, text_form(r"[0-9./]+")]},
    "scans per second: 10, 29.97, 10/3",
)
_SENSORS: Key[tuple[Node, ...]] = Key(
    "sensors",
    _sensors,
    (),
    {
        "type": "array",
        "items": mapping_form(_SENSOR_KEYS, required=("name",)),
        "minItems": 1,
        "maxItems": MAX_SENSORS,
    },
    "sensors in the order of lidar_id",
)
_BOXES = Key(
    "exclude_boxes_m",
    _boxes,
    no_boxes(),
    {"type": "array", "items": numbers_form(6)},
    "boxes x0, y0, z0, x1, y1, z1, m, body frame, without points",
)
_CONVERT: Key[tuple[RigOption, ...]] = Key(
    "convert",
    convert_keys.read_options,
    (),
    convert_keys.FORM,
    "options of `mlbatch convert`; the command line overrides them",
)
_RIG_KEYS = (_BODY_FRAME, _RATE, _SENSORS, _BOXES, _CONVERT, DATASET_KEY)
_REQUIRED = ("sensors",)


def rig_schema() -> dict[str, object]:
    """JSON schema of a rig file; what it cannot state is checked when a rig is read."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Rig of mlbatch",
        **mapping_form(_RIG_KEYS, required=_REQUIRED),
    }


def rig_from(root: Node) -> Rig:
    """Return the rig that a tree describes; RigError for the first mistake."""
    fields = root.fields(names(_RIG_KEYS), required=_REQUIRED)
    body_frame = _BODY_FRAME.of(fields) or DEFAULT_BODY_FRAME
    rig = Rig(
        body_frame=body_frame,
        rate=_RATE.of(fields),
        sensors=tuple(_sensor(item, body_frame) for item in _SENSORS.of(fields)),
        exclude_boxes_m=_BOXES.of(fields),
        options=_CONVERT.of(fields),
        dataset=DATASET_KEY.of(fields),
    )
    _check_distinct(fields["sensors"], rig)
    return rig


def _rpy_deg(fields: Mapping[str, Node]) -> tuple[float, ...]:
    """Return roll, pitch and yaw of the extrinsics as given, or none."""
    node = fields.get("extrinsics")
    if node is None or "rotation_rpy_deg" not in node.entries:
        return ()
    return tuple(_ROTATION_RPY.of(node.entries))


def _sensor(node: Node, body_frame: str) -> RigSensor:
    fields = node.fields(names(_SENSOR_KEYS), required=("name",))
    clock = _CLOCK.of(fields)
    stream = _STREAM.of(fields)
    sweeps = _sweeps(fields["points"]) if "points" in fields else None
    if sweeps is not None:
        if "stream" in fields:
            found = f"glob as well (line {fields['points'].entries['glob'].line})"
            raise fields["stream"].error("a stream without glob", found, "keep one of the two")
        sweeps = sweeps._replace(glob=sweeps.glob.replace("{sensor}", _SENSOR_NAME.of(fields)))
        stream = StreamSelector(topic=sweeps.glob)
    given = _EXTRINSICS.of(fields)
    extrinsics, files = _of_files(given, body_frame, "" if stream is None else stream.serial)
    sensor = RigSensor(
        name=_SENSOR_NAME.of(fields),
        model=_MODEL.of(fields),
        stream=stream,
        metadata=_METADATA.of(fields),
        extrinsics=extrinsics,
        extrinsics_files=files,
        rotation_rpy_deg=_rpy_deg(fields),
        clock=_CLOCK_SOURCE.of(clock) or None,
        epoch=_CLOCK_EPOCH.of(clock) or None,
        offset_ns=_CLOCK_OFFSET.of(clock),
        min_range_m=_MIN_RANGE.of(fields),
        max_range_m=_MAX_RANGE.of(fields),
        optional=_OPTIONAL.of(fields),
        decode=_DECODE.of(fields),
        points=_POINTS.of(fields),
        sweeps=sweeps,
    )
    if sensor.points is not None and (sensor.stream is None or not sensor.stream.topic):
        points = fields["points"]
        remedy = (
            "give the topic of its clouds as stream: {topic: ...}, files of sweeps as glob, or "
            "remove points"
        )
        raise points.error("a sensor on a topic", "none", remedy)
    low_m = sensor.min_range_m or 0.0
    high_m = sensor.max_range_m
    if high_m is not None and high_m <= low_m:
        value = fields["max_range_m"]
        remedy = "give the larger range as maximum"
        raise value.error(f"more than {low_m:g} m", value.shown, remedy)
    return sensor


def _of_files(
    given: F64Array | str | UnknownExtrinsics | ExtrinsicsFiles | None,
    body_frame: str,
    serial: str,
) -> tuple[F64Array | str | UnknownExtrinsics | None, tuple[Path, ...]]:
    """Return extrinsics, read from files where the rig names some; and these files."""
    if given is None or isinstance(given, (str, np.ndarray, UnknownExtrinsics)):
        return given, ()
    matrix = given.pose(body_frame, serial)
    for value in matrix[:3, 3].tolist():
        if not abs(value) <= MAX_TRANSLATION_M:
            expected = f"at most {MAX_TRANSLATION_M:g} m from the body origin"
            raise given.node.error(expected, f"{value:g} m", "correct the file")
    return matrix, given.files


def _check_distinct(node: Node, rig: Rig) -> None:
    """Refuse two sensors with one name or stream, and a sensor named as the body frame."""
    seen: dict[str | StreamSelector, Node] = {}
    for item, sensor in zip(node.items, rig.sensors, strict=True):
        name = item.entries["name"]
        if sensor.name == rig.body_frame:
            raise name.error("a name that is not the body frame", name.shown, "rename the sensor")
        if sensor.name in seen:
            raise _repeated(name, "a name", seen[sensor.name], "rename one of the two sensors")
        seen[sensor.name] = name
        if sensor.stream is not None:
            stream = item.entries["stream" if sensor.sweeps is None else "points"]
            if sensor.stream in seen:
                remedy = "give each sensor its own source_ip, port, topic, serial or glob"
                raise _repeated(stream, "a stream", seen[sensor.stream], remedy)
            seen[sensor.stream] = stream


def _repeated(node: Node, what: str, first: Node, remedy: str) -> RigError:
    found = f"that of {first.path} (line {first.line}) again"
    return node.error(f"{what} of its own", found, remedy)


def _some_fields(node: Node, known: Sequence[str]) -> Mapping[str, Node]:
    """Return the entries of a mapping that must not be empty; check keys that exclude others."""
    fields = node.fields(known)
    if not fields:
        raise node.error(f"at least one of {', '.join(known)}", "none", "add one of them")
    for key, others in _EXCLUDES.items():
        for other in others:
            if key in fields and other in fields:
                found = f"{other} as well (line {fields[other].line})"
                raise fields[key].error(f"{key} without {other}", found, "keep one of the two")
    for key, other in _NEEDS.items():
        if key in fields and key in known and other not in fields:
            raise fields[key].error(f"{key} with {other}", f"no {other}", f"add the {other}")
    return fields


def _check_near(node: Node, value_m: float) -> None:
    if abs(value_m) > MAX_TRANSLATION_M:
        expected = f"at most {MAX_TRANSLATION_M:g} m from the body origin"
        raise node.error(expected, node.shown, "give metres in the body frame, not in the world")


def _located(node: Node, build: Callable[[], F64Array]) -> F64Array:
    """Return the result of `build`; its error gets the position of `node`."""
    try:
        return build()
    except RigError as err:
        raise node.error_here(str(err)) from err
