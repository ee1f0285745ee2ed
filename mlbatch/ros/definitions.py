"""Message definitions: those that a recording carries, and our own for recordings without any.

Layouts: facts/messages.md, section 1; the syntax is that of .msg files (ROS 1 and ROS 2), whose
dependencies follow the main text after a line of `=` and one of `MSG: package/Type`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

from mlbatch.types import Topic

# Words that are no other message: bytes, alignment in CDR, code of `struct`. A time is two words.
PRIMITIVES: Mapping[str, tuple[int, int, str]] = {
    "bool": (1, 1, "?"),
    "byte": (1, 1, "B"),
    "char": (1, 1, "B"),
    "int8": (1, 1, "b"),
    "uint8": (1, 1, "B"),
    "int16": (2, 2, "h"),
    "uint16": (2, 2, "H"),
    "int32": (4, 4, "i"),
    "uint32": (4, 4, "I"),
    "int64": (8, 8, "q"),
    "uint64": (8, 8, "Q"),
    "float32": (4, 4, "f"),
    "float64": (8, 8, "d"),
    "time": (8, 4, "Ii"),
    "duration": (8, 4, "ii"),
}
STRINGS = ("string", "wstring")
_ALIASES = {
    "builtin_interfaces/Time": "time",
    "builtin_interfaces/Duration": "duration",
    "Header": "std_msgs/Header",
}
_RULE = re.compile(r"^=+[ \t]*\r?$", re.MULTILINE)
_FIELD = re.compile(r"^([\w/]+)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+(\w+)\s*(=?)", re.ASCII)
_BREAK = "=" * 80
# Definitions come with the recording. The longest of ROS have some 10 kB; no array is as long.
_MOST_CHARACTERS, _MOST_DIGITS = 400_000, 12


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message; count: None for a single value, -1 for a sequence, else elements."""

    name: str
    type: str
    count: int | None = None


Definitions: TypeAlias = Mapping[str, tuple[Field, ...]]
SEQUENCE = -1

# Types of recordings that carry none; a `;` ends a field. Headers stand below, since ROS 1 counts.
_OURS = """
ouster_ros/PacketMsg: uint8[] buf
ouster_msgs/PacketMsg: uint8[] buf
ouster_sensor_msgs/PacketMsg: uint8[] buf
velodyne_msgs/VelodyneScan: std_msgs/Header header; velodyne_msgs/VelodynePacket[] packets
velodyne_msgs/VelodynePacket: time stamp; uint8[1206] data
hesai_lidar/PandarScan: std_msgs/Header header; hesai_lidar/PandarPacket[] packets
hesai_lidar/PandarPacket: time stamp; uint8[] data; uint32 size
pandar_msgs/PandarScan: std_msgs/Header header; pandar_msgs/PandarPacket[] packets
pandar_msgs/PandarPacket: time stamp; uint8[1500] data; uint32 size
pandar_msgs/PandarJumboPacket: time stamp; uint8[] data; uint32 size
hesai_ros_driver/UdpFrame: std_msgs/Header header; hesai_ros_driver/UdpPacket[] packets
hesai_ros_driver/UdpPacket: time stamp; uint8[] data; uint32 size
nebula_msgs/NebulaPackets: std_msgs/Header header; nebula_msgs/NebulaPacket[] packets
nebula_msgs/NebulaPacket: time stamp; uint8[] data
rslidar_msg/RslidarPacket: std_msgs/Header header; uint8 is_difop; uint8 is_frame_begin; \
uint8[] data
rslidar_msgs/rslidarScan: std_msgs/Header header; rslidar_msgs/rslidarPacket[] packets
rslidar_msgs/rslidarPacket: time stamp; uint8[1248] data
robosense_msgs/RobosenseScan: std_msgs/Header header; robosense_msgs/RobosensePacket[] packets
robosense_msgs/RobosensePacket: time stamp; uint8[1248] data
robosense_msgs/RobosenseInfoPacket: string lidar_model; robosense_msgs/RobosensePacket packet
udp_msgs/UdpPacket: std_msgs/Header header; string address; uint16 src_port; uint8[] data
std_msgs/String: string data
std_msgs/MultiArrayDimension: string label; uint32 size; uint32 stride
std_msgs/MultiArrayLayout: std_msgs/MultiArrayDimension[] dim; uint32 data_offset
std_msgs/UInt8MultiArray: std_msgs/MultiArrayLayout layout; uint8[] data
geometry_msgs/Vector3: float64 x; float64 y; float64 z
geometry_msgs/Quaternion: float64 x; float64 y; float64 z; float64 w
geometry_msgs/Transform: geometry_msgs/Vector3 translation; geometry_msgs/Quaternion rotation
geometry_msgs/TransformStamped: std_msgs/Header header; string child_frame_id; \
geometry_msgs/Transform transform
tf2_msgs/TFMessage: geometry_msgs/TransformStamped[] transforms
tf/tfMessage: geometry_msgs/TransformStamped[] transforms
sensor_msgs/PointField: string name; uint32 offset; uint8 datatype; uint32 count
sensor_msgs/PointCloud2: std_msgs/Header header; uint32 height; uint32 width; \
sensor_msgs/PointField[] fields; bool is_bigendian; uint32 point_step; uint32 row_step; \
uint8[] data; bool is_dense
sensor_msgs/Imu: std_msgs/Header header; geometry_msgs/Quaternion orientation; \
float64[9] orientation_covariance; geometry_msgs/Vector3 angular_velocity; \
float64[9] angular_velocity_covariance; geometry_msgs/Vector3 linear_acceleration; \
float64[9] linear_acceleration_covariance
"""
_HEADERS = {
    "ros1": "uint32 seq\ntime stamp\nstring frame_id",
    "cdr": "time stamp\nstring frame_id",
}


def type_key(name: str) -> str:
    """One key for `pkg/msg/Type` of ROS 2 and `pkg/Type` of ROS 1."""
    package, _, rest = name.partition("/")
    return f"{package}/{rest.removeprefix('msg/')}" if rest else name


@lru_cache(maxsize=64)
def definitions_of(topic: Topic) -> Definitions:
    """All types that a topic's messages are made of; those of the recording win over ours."""
    if len(topic.definition) > _MOST_CHARACTERS:
        return ours(topic.encoding)
    if topic.format == "ros2idl":
        from mlbatch.ros.idl import parse_idl

        return {**ours(topic.encoding), **parse_idl(topic.definition)}
    return {**ours(topic.encoding), **parse(topic.definition, type_key(topic.type))}


def parse(text: str, root: str) -> dict[str, tuple[Field, ...]]:
    """Types of a .msg text with its dependencies; none for an empty text."""
    found: dict[str, tuple[Field, ...]] = {}
    for number, part in enumerate(_RULE.split(text)):
        name, body = root, part.strip()
        if number:
            first, _, body = body.partition("\n")
            name = type_key(first.removeprefix("MSG:").strip())
        # A stored text may be blank, which is not the same as a type without fields.
        if text.strip():
            found[name] = tuple(_fields(body, name.partition("/")[0]))
    return found


def _fields(text: str, package: str) -> Iterator[Field]:
    for line in text.splitlines():
        match = _FIELD.match(line.strip())
        # `=` follows the name of a constant, which takes no place in messages.
        if match is None or match[4]:
            continue
        array = match[2]
        digits = "" if array is None else array.strip("[]")
        many = int(digits[:_MOST_DIGITS]) if digits.isdigit() else SEQUENCE
        count = None if array is None else many
        yield Field(match[3], resolve(match[1], package), count)


def resolve(name: str, package: str) -> str:
    """The key of a type that a definition of `package` names."""
    key = type_key(name)
    if key in PRIMITIVES or key in STRINGS:
        return key
    return _ALIASES.get(key, key if "/" in key else f"{package}/{key}")


def _table() -> dict[str, str]:
    rows = (line.partition(": ") for line in _OURS.strip().splitlines())
    return {name: fields.replace("; ", "\n") for name, _, fields in rows}


@lru_cache(maxsize=len(_HEADERS))
def ours(encoding: str) -> dict[str, tuple[Field, ...]]:
    """The types that we know by heart."""
    texts = {**_table(), "std_msgs/Header": _HEADERS.get(encoding, _HEADERS["cdr"])}
    return {name: parse(text, name)[name] for name, text in texts.items()}


def definition_text(type_name: str) -> str:
    """Our definition of a ROS 2 type with its dependencies, "" where we have none."""
    texts = {**_table(), "std_msgs/Header": _HEADERS["cdr"]}
    texts = {
        name: text.replace("time ", "builtin_interfaces/Time ") for name, text in texts.items()
    }
    texts["builtin_interfaces/Time"] = "int32 sec\nuint32 nanosec"
    root = type_key(type_name)
    if root not in texts:
        return ""
    needed = [root]
    for name in needed:
        words = (line.partition(" ")[0].partition("[")[0] for line in texts[name].splitlines())
        needed += [word for word in dict.fromkeys(words) if word in texts and word not in needed]
    parts = [f"{texts[root]}\n"]
    parts += [f"{_BREAK}\nMSG: {name}\n{texts[name]}\n" for name in needed[1:]]
    return "".join(parts)


_SEPARATOR = "=" * 80

_FIELDS = {
    "builtin_interfaces/Time": ("int32 sec", "uint32 nanosec"),
    "std_msgs/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "geometry_msgs/Vector3": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/Quaternion": ("float64 x", "float64 y", "float64 z", "float64 w"),
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation",
        "geometry_msgs/Quaternion rotation",
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header",
        "string child_frame_id",
        "geometry_msgs/Transform transform",
    ),
    "tf2_msgs/TFMessage": ("geometry_msgs/TransformStamped[] transforms",),
    "sensor_msgs/PointField": (
        "uint8 INT8=1",
        "uint8 UINT8=2",
        "uint8 INT16=3",
        "uint8 UINT16=4",
        "uint8 INT32=5",
        "uint8 UINT32=6",
        "uint8 FLOAT32=7",
        "uint8 FLOAT64=8",
        "string name",
        "uint32 offset",
        "uint8 datatype",
        "uint32 count",
    ),
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header",
        "uint32 height",
        "uint32 width",
        "sensor_msgs/PointField[] fields",
        "bool is_bigendian",
        "uint32 point_step",
        "uint32 row_step",
        "uint8[] data",
        "bool is_dense",
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header",
        "geometry_msgs/Quaternion orientation",
        "float64[9] orientation_covariance",
        "geometry_msgs/Vector3 angular_velocity",
        "float64[9] angular_velocity_covariance",
        "geometry_msgs/Vector3 linear_acceleration",
        "float64[9] linear_acceleration_covariance",
    ),
}

# Numbers of the words that recorders from Jazzy on write (rmw/types.h).
_QOS_WORDS = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": (
        *("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown"),
        "best_available",
    ),
}
_QOS_LINE = re.compile(rf"\b({'|'.join(_QOS_WORDS)}): ([a-z_]+)")

# Codes of PointField for numpy types.
FIELD_CODES = {"u1": 2, "<u2": 4, "<u4": 6, "<f4": 7, "<f8": 8}


def is_known(name: str) -> bool:
    """Whether the definition of message `pkg/Type` is among ours."""
    return name in _FIELDS


def definition(name: str) -> str:
    """The definition of message `pkg/Type`, followed by all it is made of."""
    main, *others = _parts(name, [])
    return _lines(main) + "".join(f"{_SEPARATOR}\nMSG: {part}\n{_lines(part)}" for part in others)


def _lines(part: str) -> str:
    return "\n".join(_FIELDS[part]) + "\n"


def _parts(name: str, known: list[str]) -> list[str]:
    """`known` with `name` and the types of its fields added, each once."""
    known.append(name)
    for line in _FIELDS[name]:
        part = line.split()[0].split("[")[0]
        if part in _FIELDS and part not in known:
            _parts(part, known)
    return known


def qos(latched: bool) -> str:
    """QoS of a reliable topic as a YAML list; integers, since Humble reads no words.

    latched: transient local, so that late subscribers get `/tf_static`.
    """
    forever = "  sec: 9223372036\n    nsec: 854775807"
    return (
        "- history: 1\n"
        f"  depth: {1 if latched else 10}\n"
        "  reliability: 1\n"
        f"  durability: {1 if latched else 2}\n"
        f"  deadline:\n  {forever}\n"
        f"  lifespan:\n  {forever}\n"
        "  liveliness: 1\n"
        f"  liveliness_lease_duration:\n  {forever}\n"
        "  avoid_ros_namespace_conventions: false\n"
    )


def qos_in_numbers(text: str) -> str:
    """A recorder's QoS text with numbers for words, since Humble reads no words."""

    def number(match: re.Match[str]) -> str:
        policy, word = match.groups()
        words = _QOS_WORDS[policy]
        return f"{policy}: {words.index(word)}" if word in words else match[0]

    return _QOS_LINE.sub(number, text)
