"""Keys of a rig file: how each value is read, checked and converted, and its default.

Format: docs/rig.md. All units of users are converted here.
"""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError, UsageError
from mlbatch.frames.transforms import from_quaternion, from_rpy_deg, rigid
from mlbatch.lidar.limits import MAX_TRANSLATION_M
from mlbatch.rig.convert_keys import CONVERT, read_options
from mlbatch.rig.keys import (
    FLAG,
    NUMBER,
    OPTIONS,
    RANGE_M,
    TEXT,
    WORD,
    Form,
    Key,
    Section,
    choice_form,
    numbers_form,
    text_form,
    whole_form,
)
from mlbatch.rig.recipes import DATASET_KEY
from mlbatch.rig.rig import (
    DATASET,
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


# Of a sensor_msgs/PointField, and whole numbers of 64 bits.
FIELD_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")
_PADDING = re.compile(r"V([1-9]\d{0,3})", re.ASCII)
_NAMED_PARTS = re.compile(r"\{[^}]*\}?")
_NAMED_PART = re.compile(r"\{(sensor|stamp(:(s|ms|us|ns|iso))?)\}")


def _word_key(
    name: str, what: str, about: str, pattern: re.Pattern[str] = _WORD, form: Form = WORD
) -> Key:
    """A key whose value is text, "" without it; what: of an error."""
    return Key(name, lambda node: node.word(what, pattern), form, about, "")


def _choice_key(name: str, words: tuple[str, ...], about: str) -> Key:
    """A key whose value is one of some words, "" without it."""
    return Key(name, lambda node: node.choice(words), choice_form(*words), about, "")


def _whole_key(name: str, low: int, high: int, about: str, default: int | None) -> Key:
    """A key whose value is a whole number."""
    return Key(name, lambda node: node.whole(low, high), whole_form(low, high), about, default)


def _numbers_key(name: str, count: int, about: str) -> Key:
    """A key whose value is a list of numbers."""
    return Key(name, lambda node: node.numbers(count), numbers_form(count), about)


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
    values = STREAM.read(node)
    return StreamSelector(**values | {"frame_id": values["frame_id"].lstrip("/")})


def _points(node: Node) -> tuple[PointRule, Sweeps | None]:
    """Return how decoded clouds are read, and files of sweeps if `points` names some.

    The fields are checked with the first cloud.
    """
    # Few rigs have it.
    from mlbatch.ros.point_times import UNITS_NS, PointRule

    values = POINTS.read(node)
    rule = PointRule(
        time=values["time"],
        unit_ns=UNITS_NS.get(values["unit"], 0),
        origin=values["from"],
        ring=values["ring"],
        places={key: value.place for key, value in node.entries.items()},
    )
    if not values["glob"]:
        return rule, None
    arrays = tuple(values["arrays"].items())
    return rule, Sweeps(values["glob"], values["dtype"], node.entries["glob"].place, arrays)


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


def _clock(node: Node) -> dict[str, object]:
    """Return fields of a `RigSensor`."""
    values = CLOCK.read(node)
    source, epoch = values["source"] or None, values["epoch"] or None
    return {"clock": source, "epoch": epoch, "offset_ns": values["offset_s"]}


def _extrinsics(node: Node) -> F64Array | str | UnknownExtrinsics | ExtrinsicsFiles:
    """Return (4, 4) body_from_sensor, m, a frame of the recording, unknown, or files with it."""
    if node.kind == "scalar" and node.text == UNKNOWN:
        return UnknownExtrinsics(node.place)
    values = EXTRINSICS.read(node)
    if not values["file"]:
        return values["frame"] or _pose(node, values)
    # Few rigs have it.
    from mlbatch.rig.extrinsics_files import ExtrinsicsFiles

    if values["direction"] and not values["key"]:
        raise node.entries["direction"].error(
            "direction with key",
            "no key",
            "name the matrix as key; files with named frames state their direction",
        )
    words = ("file", "frame", "parent", "key", "direction", "matrix_unit", "sensor_in_frame")
    return ExtrinsicsFiles(node, *(values[name] for name in words))


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
    return _pose(node, SENSOR_IN_FRAME.read(node))


def _pose(node: Node, values: Mapping[str, Any]) -> F64Array:
    """Return the (4, 4) transform, m, that translation and rotation or a matrix give."""
    origin, xyzw = values["translation_m"], values["rotation_xyzw"]
    if xyzw is not None:
        return _located(node.entries["rotation_xyzw"], lambda: from_quaternion(origin, xyzw))
    matrix: F64Array | None = values.get("matrix")
    return from_rpy_deg(origin, values["rotation_rpy_deg"]) if matrix is None else matrix


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


# -- sections -------------------------------------------------------------------------------------

_OF_ONE = "of one of several lidars whose clouds share a topic"
STREAM = Section(
    (
        Key("source_ip", _ip_address, WORD, "source IP of the packets", ""),
        _whole_key("port", 1, 65535, "destination port", 0),
        _word_key("topic", "a topic without spaces", "topic of a bag"),
        # Text, since leading zeros count.
        _word_key("serial", "a serial number without spaces", "serial number in the packets"),
        _word_key("frame_id", "a frame_id without spaces", f"frame {_OF_ONE}"),
        _whole_key("lidar_id", 0, 65535, f"number {_OF_ONE}", None),
    ),
    excludes={"topic": ("source_ip", "port")},
    needs={"frame_id": "topic", "lidar_id": "topic"},
    may_be_empty=False,
)
POINTS = Section(
    (
        _word_key("time", "the name of a field", "field with the time of a point"),
        _choice_key("unit", ("s", "ms", "us", "ns"), "unit of that field"),
        _choice_key(
            "from",
            ("start", "end", "back", "absolute"),
            "the header's stamp is that of the first point, of the last one; times are ages; or "
            "from 1970",
        ),
        _word_key("ring", "the name of a field", "field with the ring of a point"),
        Key("glob", _glob, WORD, "files of sweeps in the folder of the recording", ""),
        Key(
            "dtype",
            _dtype,
            {
                "type": "object",
                "additionalProperties": text_form(r"[<|=]?\w+"),
                "minProperties": 1,
            },
            "fields of a point in the files, and their numpy types, in order; PCD states its own",
            (),
        ),
        Key(
            "arrays",
            _options,
            {"type": "object", "additionalProperties": WORD, "minProperties": 1},
            "array of a .npz file for each field of a point; points.0: its first column",
            {},
        ),
    ),
    excludes={"arrays": ("dtype",)},
    needs={"dtype": "glob", "arrays": "glob"},
    may_be_empty=False,
)
CLOCK = Section(
    (
        _choice_key("source", ("sensor", "host"), "timestamps of packets, or their receive times"),
        _choice_key("epoch", ("utc", "tai", "gps"), "what the timestamps count; converted to UTC"),
        Key(
            "offset_s",
            _offset_ns,
            {"type": "number", "minimum": -MAX_OFFSET_S, "maximum": MAX_OFFSET_S},
            "added to the timestamps, s",
            0,
        ),
    )
)
_NOWHERE = (0.0, 0.0, 0.0)
_POSE_KEYS = (
    Key("translation_m", _translation, numbers_form(3), "x, y, z, m, body frame", _NOWHERE),
    _numbers_key(
        "rotation_rpy_deg", 3, "roll, pitch, yaw about the fixed axes x, y, z, degrees"
    )._replace(default=_NOWHERE),
    _numbers_key("rotation_xyzw", 4, "unit quaternion"),
)
_ONE_ROTATION = {"rotation_xyzw": ("rotation_rpy_deg",)}
_BY_NUMBERS = ("translation_m", "rotation_rpy_deg", "rotation_xyzw")
SENSOR_IN_FRAME = Section(_POSE_KEYS, excludes=_ONE_ROTATION, may_be_empty=False)
EXTRINSICS = Section(
    (
        *_POSE_KEYS,
        Key(
            "matrix",
            _matrix,
            {"type": "array", "items": numbers_form(4), "minItems": 3, "maxItems": 4},
            "body_from_sensor, 4 x 4 or 3 x 4, m",
        ),
        _word_key(
            "frame",
            "the name of a frame",
            "frame of the sensor in the file, or in the recording's transforms",
        ),
        Key(
            "file",
            _files,
            {"anyOf": [TEXT, {"type": "array", "items": TEXT, "minItems": 1}]},
            "file or files with the extrinsics, relative to this file",
            (),
        ),
        _word_key("parent", "the name of a frame", "frame of the file that is the body frame"),
        Key(
            "key",
            _matrix_keys,
            {"anyOf": [WORD, {"type": "array", "items": WORD, "minItems": 1}]},
            "key of a matrix in the file; several are multiplied",
            (),
        ),
        _choice_key("direction", ("body_from_sensor", "sensor_from_body"), "what the matrix maps"),
        _choice_key("matrix_unit", ("m", "mm"), "unit of their translations"),
        Key(
            "sensor_in_frame",
            _sensor_in_frame,
            SENSOR_IN_FRAME.form,
            "pose of the sensor in the frame of the file",
        ),
    ),
    excludes={
        **_ONE_ROTATION,
        "matrix": _BY_NUMBERS,
        "frame": (*_BY_NUMBERS, "matrix"),
        "file": (*_BY_NUMBERS, "matrix"),
        "key": ("frame", "parent"),
    },
    needs={
        "parent": "file",
        "key": "direction",
        "direction": "file",
        "matrix_unit": "key",
        "sensor_in_frame": "file",
    },
    may_be_empty=False,
)
SENSOR = Section(
    (
        # A name fits ROS topics, frames and file names.
        _word_key(
            "name",
            f"a name of at most {MAX_NAME} letters, digits and _, not a digit first",
            "name in topics, folders and frames",
            _NAME,
            text_form(rf"[A-Za-z_][A-Za-z0-9_]{{0,{MAX_NAME - 1}}}"),
        ),
        Key("model", _model, TEXT, "auto, or a name of `mlbatch sensors`"),
        Key(
            "stream",
            _stream,
            STREAM.form,
            "its packets; default: any that match its calibration",
        ),
        Key("metadata", _existing_file, TEXT, "metadata or calibration, relative to this file"),
        Key(
            "extrinsics",
            _extrinsics,
            {"anyOf": [{"const": UNKNOWN}, EXTRINSICS.form]},
            "body_from_sensor; default: the recording's",
        ),
        Key("clock", _clock, CLOCK.form, "its clock", {}),
        Key("min_range_m", _range_m, RANGE_M, "drop nearer points, m"),
        Key("max_range_m", _range_m, RANGE_M, "drop farther points, m"),
        Key("optional", Node.flag, FLAG, "may be absent from a recording", False),
        Key("decode", _options, OPTIONS, "options of its decoder", {}),
        Key(
            "points",
            _points,
            POINTS.form,
            "how decoded clouds are read; only with a topic, or files of sweeps",
            (None, None),
        ),
    ),
    required=("name",),
)
RIG = Section(
    (
        # Fleets put the name of the robot before a slash.
        _word_key(
            "body_frame",
            "a frame name of letters, digits, _ and / that does not start with a digit",
            "frame of all points",
            _FRAME,
            text_form(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*"),
        ),
        Key(
            "rate_hz",
            _rate,
            {"anyOf": [{**NUMBER, "exclusiveMinimum": 0}, text_form(r"[0-9./]+")]},
            "scans per second: 10, 29.97, 10/3",
        ),
        Key(
            "sensors",
            _sensors,
            {"type": "array", "items": SENSOR.form, "minItems": 1, "maxItems": MAX_SENSORS},
            "sensors in the order of lidar_id",
        ),
        Key(
            "exclude_boxes_m",
            _boxes,
            {"type": "array", "items": numbers_form(6)},
            "boxes x0, y0, z0, x1, y1, z1, m, body frame, without points",
            no_boxes(),
        ),
        Key(
            "convert",
            read_options,
            CONVERT.form,
            "options of `mlbatch convert`; the command line overrides them",
            (),
        ),
        DATASET_KEY,
    ),
    required=("sensors",),
)


def rig_schema() -> dict[str, object]:
    """JSON schema of a rig file; what it cannot state is checked when a rig is read."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Rig of mlbatch",
        **RIG.form,
    }


def rig_from(root: Node) -> Rig:
    """Return the rig that a tree describes; RigError for the first mistake."""
    values = RIG.read(root)
    body_frame = values["body_frame"] or DEFAULT_BODY_FRAME
    rig = Rig(
        body_frame=body_frame,
        rate=values["rate_hz"],
        sensors=tuple(_sensor(item, body_frame) for item in values["sensors"]),
        exclude_boxes_m=values["exclude_boxes_m"],
        options=values["convert"],
        dataset=values[DATASET],
    )
    _check_distinct(root.entries["sensors"], rig)
    return rig


def _sensor(node: Node, body_frame: str) -> RigSensor:
    values = SENSOR.read(node)
    fields = node.entries
    points, sweeps = values.pop("points")
    clock = values.pop("clock")
    if sweeps is not None:
        if "stream" in fields:
            found = f"glob as well (line {fields['points'].entries['glob'].line})"
            raise fields["stream"].error("a stream without glob", found, "keep one of the two")
        sweeps = sweeps._replace(glob=sweeps.glob.replace("{sensor}", values["name"]))
        values["stream"] = StreamSelector(topic=sweeps.glob)
    stream = values["stream"]
    given = values.pop("extrinsics")
    extrinsics, files = _of_files(given, body_frame, "" if stream is None else stream.serial)
    rotation = fields["extrinsics"].entries.get("rotation_rpy_deg") if given is not None else None
    sensor = RigSensor(
        **values,
        **clock,
        extrinsics=extrinsics,
        extrinsics_files=files,
        rotation_rpy_deg=() if rotation is None else tuple(rotation.numbers(3)),
        points=points,
        sweeps=sweeps,
    )
    if points is not None and (stream is None or not stream.topic):
        remedy = (
            "give the topic of its clouds as stream: {topic: ...}, files of sweeps as glob, or "
            "remove points"
        )
        raise fields["points"].error("a sensor on a topic", "none", remedy)
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
